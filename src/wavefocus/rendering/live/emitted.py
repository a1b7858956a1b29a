"""Signals of live sources, as samples at the bank's rate."""

from dataclasses import dataclass

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.signals import Noise, Signal, signal_size
from wavefocus.storage.errors import InputError

MAX_SIGNAL_S = 60.0


@dataclass(frozen=True, slots=True)
class Emitted:
    """A signal that a source emits from its first sample on, at the bank's rate."""

    signal: Signal
    values: Float64Array
    repeat: bool

    def at(self, since: int, samples: int) -> Float64Array:
        """Values from so many samples after the first on, float64 (samples,)."""
        size = len(self.values)
        if self.repeat:
            since %= size
            if since + samples > size:
                return np.take(self.values, np.arange(since, since + samples), mode="wrap")
        values = self.values[since : since + samples]
        return values if len(values) == samples else np.pad(values, (0, samples - len(values)))


def live_samples(signal: Signal, rate_hz: float) -> Float64Array:
    """Samples of a signal for a live source.

    Raises InputError: the signal cannot be made at this rate, or is too long.
    """
    samples, _ = signal_size(signal, rate_hz)
    if not samples <= MAX_SIGNAL_S * rate_hz:
        raise InputError(
            f"a signal of {samples / rate_hz:.4g} s is too long; live sources take up to {MAX_SIGNAL_S:g} s"
        )
    return signal.samples(rate_hz)


def default_signal(bank: GreenSource) -> Signal:
    """Noise of the bank's band, 1 s; of 50 to 450 Hz, as far as the rate allows, where the band is not stated."""
    half_hz = float(bank.sample_rate_hz) / 2.0
    low_hz, high_hz = bank.band_hz or (min(50.0, half_hz / 4.0), min(450.0, half_hz))
    return Noise((low_hz, min(high_hz, half_hz)), 1.0)
