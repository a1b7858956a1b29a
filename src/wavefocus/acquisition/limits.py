"""How far a sentinel position drifted, and what the limits of drift say of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration import Float32Array
from wavefocus.calibration.numerics import parabola_vertex
from wavefocus.config.messages.codec import Instant, Number

if TYPE_CHECKING:  # pydantic, which status does without
    from wavefocus.config.limits import DriftLimits


@dataclass(frozen=True, slots=True)
class DriftFigures:
    """How a re-measured sentinel differs from the first measurement.

    level_db: Energy now over energy then, in dB.
    delay_samples: Lag of the largest cross-correlation, refined by a parabola; positive when the response comes later
        now.
    correlation: Cross-correlation at that lag over the root of both energies, 0 to 1.
    noise_db: How far noise alone may move the level, in dB.
    """

    level_db: float
    delay_samples: float
    correlation: float
    noise_db: float = 0.0

    def verdict(self, limits: DriftLimits) -> str:
        """``"steady"``, ``"warn"`` or ``"stop"``."""
        for word, level_db, delay_samples, correlation in (
            ("stop", limits.stop_level_db, limits.stop_delay_samples, limits.stop_correlation),
            ("warn", limits.warn_level_db, limits.warn_delay_samples, limits.warn_correlation),
        ):
            beyond = abs(self.level_db) > level_db + self.noise_db or abs(self.delay_samples) > delay_samples
            if beyond or self.correlation < correlation:
                return word
        return "steady"

    def speaks_against(self, limits: DriftLimits) -> bool:
        """Whether what was measured since the last steady measurement has another scale, or is of another plate."""
        return self.verdict(limits) == "stop" or abs(self.level_db) > limits.warn_level_db + self.noise_db

    def cause(self, limits: DriftLimits) -> str:
        """What such figures come from; empty where they are steady.

        The shape of a response changes from place to place, so that a low correlation is another place (or another
        plate); a gain changes only the level, a clock or a filter only the delay.
        """
        word = self.verdict(limits)
        if word == "steady":
            return ""
        stop = word == "stop"
        if self.correlation < (limits.stop_correlation if stop else limits.warn_correlation):
            return "plate or mirror moved"
        if abs(self.delay_samples) > (limits.stop_delay_samples if stop else limits.warn_delay_samples):
            return "timing changed"
        return "level changed"

    def __str__(self) -> str:
        return (
            f"level {self.level_db:+.2f} dB, delay {self.delay_samples:+.2f} samples, "
            f"correlation {self.correlation:.3f}"
        )


# Responses with less signal-to-noise ratio say nothing of a drift, unless none has more.
CLEAR_DB = 10.0


def compare_sentinel(
    then: Float32Array,
    now: Float32Array,
    snr_then_db: Float32Array | None = None,
    snr_now_db: Float32Array | None = None,
    *,
    band_hz: tuple[float, float] | None = None,
    sample_rate_hz: float = 1.0,
) -> DriftFigures:
    """Compare two measurements of one position.

    then, now, float32 (actuators, taps): Green's functions of the first and of the new measurement.
    snr_then_db, snr_now_db, float32 (actuators,): Their signal-to-noise ratios, NaN where unknown; by default, and
        where unknown, without noise. The share that noise has in energies and correlation is taken out of them.
    band_hz: Measured band; what a fit leaves outside of it says nothing of the plate.
    sample_rate_hz: Of the Green's functions.

    Returns figures pooled over the clear responses, so that the strong ones, which carry the information, decide.
    """
    first, second = then.astype(np.float64), now.astype(np.float64)
    snr_db = [
        np.full(len(first), np.inf) if snr_db is None else np.nan_to_num(snr_db.astype(np.float64), nan=np.inf)
        for snr_db in (snr_then_db, snr_now_db)
    ]
    # A response that has vanished since is not noise: what was clear then decides.
    clear = snr_db[0] >= min(CLEAR_DB, float(np.max(snr_db[0], initial=-np.inf)))
    first, second = first[clear], second[clear]
    length = 2 * first.shape[1]
    cycles = np.arange(length // 2 + 1) / length
    low, high = (0.0, 0.5) if band_hz is None else (edge_hz / sample_rate_hz for edge_hz in band_hz)
    within = (cycles >= low) & (cycles <= high)
    spectra = [np.fft.rfft(green, length, axis=1) * within for green in (first, second)]
    energies, noise = [], []
    for part, ratio_db in zip(spectra, snr_db, strict=True):
        each = np.sum(np.fft.irfft(part, length, axis=1) ** 2, axis=1)
        energies.append(float(each.sum()))
        noise.append(float(np.sum(each / (1.0 + 10.0 ** (0.1 * ratio_db[clear])))) / max(energies[-1], 1e-300))
    energy_then, energy_now = energies
    if energy_then == 0.0 or energy_now == 0.0:
        return DriftFigures(-np.inf if energy_now == 0.0 else np.inf, 0.0, 0.0)
    spectrum = np.sum(np.conj(spectra[0]) * spectra[1], axis=0)
    lagged = np.fft.irfft(spectrum, length)
    peak = int(np.argmax(lagged))
    delay = peak + parabola_vertex(lagged[peak - 1], lagged[peak], lagged[(peak + 1) % length])
    delay -= 0 if peak < length // 2 else length
    signal_then, signal_now = (
        energy * (1.0 - share) for energy, share in zip(energies, np.minimum(noise, 0.9).tolist(), strict=True)
    )
    return DriftFigures(
        level_db=10.0 * np.log10(signal_now / signal_then),
        delay_samples=float(delay),
        correlation=min(float(lagged[peak] / np.sqrt(signal_then * signal_now)), 1.0),
        noise_db=10.0 * np.log10(1.0 + sum(noise)),
    )


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """The sentinel position measured again, against its first measurement.

    at: When, with a time zone.
    level_db, delay_samples, correlation: See `DriftFigures`.
    verdict: ``"steady"``, ``"warn"`` or ``"stop"``.
    suspect: Positions measured since it was last steady, where the verdict is to stop.
    """

    at: Instant
    level_db: Number
    delay_samples: Number
    correlation: Number
    verdict: str
    suspect: tuple[int, ...] = ()
