"""The signal that one actuator plays in a sequential record."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError


class Sweeps(Protocol):
    """Sweeps that follow each other, each with silence after it; what an estimator needs of them."""

    @property
    def sample_rate_hz(self) -> float:
        """Rate in Hz."""
        ...

    @property
    def start_hz(self) -> float:
        """Lowest frequency in Hz."""
        ...

    @property
    def stop_hz(self) -> float:
        """Highest frequency in Hz."""
        ...

    @property
    def averages(self) -> int:
        """Number of sweeps in a record."""
        ...

    @property
    def decay_samples(self) -> int:
        """Samples of silence after each sweep."""
        ...

    @property
    def decay_s(self) -> float:
        """Silence after each sweep in seconds."""
        ...

    def base_v(self) -> NDArray[np.float64]:
        """One sweep and its silence in volts."""
        ...


@dataclass(frozen=True, slots=True)
class Excitation:
    """A linear sweep followed by silence, played `averages` times without a gap.

    A linear sweep spreads its energy evenly over the band, which for white noise gives Green's functions
    3 dB better than a logarithmic one.

    sample_rate_hz: Rate of the bank in Hz, > 0.
    start_hz, stop_hz: Band of the sweep in Hz, 0 < start < stop < half the sample rate.
    duration_s: Length of one sweep in seconds, > 0.
    decay_s: Silence after each sweep in seconds, >= 0; at least as long as the response.
    amplitude_v: Peak of the sweep in volts, > 0.
    averages: Number of sweeps in a record, >= 1.
    fade_s: Length of each half-cosine fade in seconds, 0 to half of `duration_s`.

    Raises InputError: a value outside the range above.
    """

    sample_rate_hz: float
    start_hz: float
    stop_hz: float
    duration_s: float
    decay_s: float
    amplitude_v: float
    averages: int
    fade_s: float = 0.01

    def __post_init__(self) -> None:
        for name in ("sample_rate_hz", "start_hz", "stop_hz", "duration_s", "amplitude_v"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"sweep {name} is {value:g}; allowed is a finite number above 0")
        if not (math.isfinite(self.decay_s) and self.decay_s >= 0):
            raise InputError(f"sweep decay_s is {self.decay_s:g}; allowed is 0 or more")
        if self.start_hz >= self.stop_hz:
            raise InputError(f"sweep start_hz is {self.start_hz:g}; allowed is less than stop_hz, {self.stop_hz:g}")
        if self.stop_hz >= self.sample_rate_hz / 2:
            raise InputError(
                f"sweep stop_hz is {self.stop_hz:g}; allowed is less than half the sample rate, "
                f"{self.sample_rate_hz / 2:g}"
            )
        if isinstance(self.averages, bool) or int(self.averages) != self.averages or self.averages < 1:
            raise InputError(f"capture averages is {self.averages!r}; allowed is a whole number of 1 or more")
        if not 0 <= self.fade_s <= self.duration_s / 2:
            raise InputError(
                f"sweep fade_s is {self.fade_s:g}; allowed is 0 to half of duration_s, {self.duration_s / 2:g}"
            )
        if (self.stop_hz - self.start_hz) * self.duration_s < 4:
            raise InputError(
                f"sweep duration_s is {self.duration_s:g}; allowed is at least "
                f"{4 / (self.stop_hz - self.start_hz):g} for a band of {self.stop_hz - self.start_hz:g} Hz"
            )

    @property
    def sweep_samples(self) -> int:
        """Samples of one sweep."""
        return round(self.duration_s * self.sample_rate_hz)

    @property
    def decay_samples(self) -> int:
        """Samples of silence after each sweep."""
        return round(self.decay_s * self.sample_rate_hz)

    @property
    def period_samples(self) -> int:
        """Samples of one sweep and its silence."""
        return self.sweep_samples + self.decay_samples

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency of the sweep in Hz."""
        return (self.start_hz, self.stop_hz)

    def base_v(self) -> NDArray[np.float64]:
        """One sweep and its silence in volts, shape (period_samples,); peak `amplitude_v`, mean exactly 0."""
        samples = self.sweep_samples
        time_s = np.arange(samples) / self.sample_rate_hz
        slope = (self.stop_hz - self.start_hz) / (2 * self.duration_s)
        envelope = np.ones(samples)
        fade = round(self.fade_s * self.sample_rate_hz)
        if fade:
            ramp = np.sin(np.pi / 2 * (np.arange(fade) + 0.5) / fade) ** 2
            envelope[:fade] = ramp
            envelope[samples - fade :] *= ramp[::-1]
        sweep = envelope * np.sin(2 * np.pi * (self.start_hz + slope * time_s) * time_s)
        # A coil must not hold a direct voltage; the sweep's tiny mean goes where the envelope hides it.
        sweep -= envelope * (sweep.sum() / envelope.sum())
        base = np.zeros(self.period_samples)
        base[:samples] = sweep * (self.amplitude_v / np.abs(sweep).max())
        return base

    def signal_v(self) -> NDArray[np.float64]:
        """The whole record's drive in volts, shape (averages * period_samples,)."""
        return np.tile(self.base_v(), self.averages)
