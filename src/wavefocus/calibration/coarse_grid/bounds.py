"""Errors and bounds of a model between positions, by positions that it was not fitted to."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from wavefocus.calibration import Complex128Array, Float64Array
from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import evenly_spread

MIN_CHECKS, SURE_CHECKS = 12, 24
"""Positions that state a bound of 90 %, and of 95 %: a quantile L needs at least 1 / (1 - L) of them, 10 and 20 (Lee,
Barber, Willett, arXiv 2306.06342), and some more to vary little from draw to draw."""
JUDGED = 64
"""Frequencies at which errors are judged; they may come and go within 25 Hz."""


def judged(
    model: Any,
    check_mm: Float64Array,
    check_transfer: Complex128Array,
    noise: Float64Array,
    resolution_hz: float,
    each: Callable[[Sequence[int], Callable[[int], tuple[float, float, float]]], list[tuple[float, float, float]]],
) -> dict[str, Any]:
    """Errors and bounds, by fields of `RimWaves`, by positions that were not fitted to (split conformal prediction).

    With d what was measured at check places, p the model's values, s its deviations there and nu the noise's,

        r = sqrt(max(|d - p|^2 - c nu^2, 0)) / s,   c = log(1 / (1 - L)),

    the bound is the L quantile of r over places, actuators and the frequencies within `resolution_hz`, times s. c takes
    the noise away, which is in d and not in the plate: of complex normal errors the L quantile of |d - p|^2 is c times
    its mean. Where the noise is more than half of what is missed, that would lean on its exact level, and c is 0: the
    bound is too wide there. It speaks of random places over the surface, never of one place.

    Pooled over places and actuators alike: R. Dunn, L. Wasserman, A. Ramdas, arXiv 1809.07441.

    model: `RimWaves`, or what has its `frequency_hz`, `values` and `deviations`.
    noise, float64 (check positions, actuators).
    """
    stated = 0.95 if len(check_mm) >= SURE_CHECKS else 0.9

    def factors(number: int) -> tuple[float, float, float]:
        near = np.flatnonzero(np.abs(model.frequency_hz - model.frequency_hz[number]) <= resolution_hz * 1.001)
        near = np.union1d(near, [number])
        missed = np.square(np.abs(model.values(check_mm, near.tolist()) - check_transfer[near]))
        variance, noise_power = np.square(model.deviations(check_mm, [number])[0]), np.square(noise)
        by_noise = float(noise_power.mean() / max(float(missed.mean()), 1e-300))
        c = np.log(1.0 / (1.0 - stated)) if by_noise <= MOST else 0.0
        score = np.maximum(missed - c * noise_power, 0.0) / variance
        bound = float(np.sqrt(np.quantile(score, stated, method="higher")))
        return typical(missed - noise_power, variance), bound, by_noise

    at = evenly_spread(len(model.frequency_hz), JUDGED).tolist()
    error_scale, bound_scale, by_noise = (
        between(model.frequency_hz, at, part) for part in np.array(each(at, factors)).T
    )
    return {
        "error_scale": error_scale, "bound_scale": bound_scale, "by_noise": by_noise, "stated": stated,
        "judged_by": "check positions",
    }  # fmt: skip


def typical(square: Float64Array, variance: Float64Array) -> float:
    """Errors over what was expected, L2 over the actuators, the last axis; the median of all places and frequencies."""
    share = np.maximum(square.sum(axis=-1), 0.0) / variance.sum(axis=-1)
    return float(np.sqrt(np.median(share)))


def between(frequency_hz: Float64Array, judged_at: list[int], values: Float64Array) -> Float64Array:
    """Factors at some frequencies, interpolated to all over the logarithm of frequency."""
    octave = np.log2(frequency_hz)
    return np.asarray(np.exp(np.interp(octave, octave[judged_at], np.log(np.maximum(values, 1e-6)))))
