"""Drift: the sentinel position measured again, against what the bank holds of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# A sentinel that agrees less than this is another plate, another place or another level:
# at the default noise a re-measured position correlates above 0.999.
STOP_CORRELATION = 0.9
STOP_LEVEL_DB = 3.0
WARN_CORRELATION = 0.98
WARN_LEVEL_DB = 0.5


@dataclass(frozen=True, slots=True)
class DriftFigures:
    """How a re-measured sentinel differs from the first measurement.

    Parameters
    ----------
    level_db : float
        Energy now over energy then, in dB.
    delay_samples : float
        Lag of the largest cross-correlation, refined by a parabola; positive when the
        response comes later now.
    correlation : float
        Cross-correlation at that lag over the root of both energies, 0 to 1.
    """

    level_db: float
    delay_samples: float
    correlation: float

    @property
    def verdict(self) -> str:
        """``"steady"``, ``"warn"`` or ``"stop"``."""
        if self.correlation < STOP_CORRELATION or abs(self.level_db) > STOP_LEVEL_DB:
            return "stop"
        if self.correlation < WARN_CORRELATION or abs(self.level_db) > WARN_LEVEL_DB:
            return "warn"
        return "steady"


def compare_sentinel(then: NDArray[np.float32], now: NDArray[np.float32]) -> DriftFigures:
    """Compare two measurements of one position.

    Parameters
    ----------
    then, now : float32 array, shape (actuators, taps)
        Green's functions of the first and of the new measurement.

    Returns
    -------
    DriftFigures
        Pooled over all actuators, so that the strong responses, which carry the
        information, decide.
    """
    first, second = then.astype(np.float64), now.astype(np.float64)
    energy_then, energy_now = float(np.sum(first**2)), float(np.sum(second**2))
    if energy_then == 0.0 or energy_now == 0.0:
        return DriftFigures(-np.inf if energy_now == 0.0 else np.inf, 0.0, 0.0)
    length = 2 * first.shape[1]
    spectrum = np.sum(np.conj(np.fft.rfft(first, length)) * np.fft.rfft(second, length), axis=0)
    lagged = np.fft.irfft(spectrum, length)
    peak = int(np.argmax(lagged))
    before, centre, after = lagged[peak - 1], lagged[peak], lagged[(peak + 1) % length]
    curvature = before - 2.0 * centre + after
    offset = 0.0 if curvature == 0.0 else 0.5 * (before - after) / curvature
    delay = peak + offset if peak < length // 2 else peak + offset - length
    return DriftFigures(
        level_db=10.0 * np.log10(energy_now / energy_then),
        delay_samples=float(delay),
        correlation=float(centre / np.sqrt(energy_then * energy_now)),
    )
