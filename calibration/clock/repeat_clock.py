"""The ratio of the clocks from a signal that repeats, whatever it is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum
from calibration.clock.decimation import Thinned, Thinning
from calibration.clock.resampling import KERNEL_HALF, resampled

Float64Array = NDArray[np.float64]

# Lags looked at are so many thinned samples apart: a thirtieth of a period of the highest frequency.
LAG_STEP = 0.1
# Step over which a derivative is taken, in thinned samples.
DERIVATIVE_STEP = 0.02
MOST_STEPS = 8
# Fewer thinned samples than this are not enough.
LEAST_SAMPLES = 32


@dataclass(frozen=True, slots=True)
class RepeatFit:
    """How a recording repeats itself.

    ratio: DAQ rate over playback rate.
    sigma_ppm: Standard deviation of that in parts per million, from what does not repeat.
    misfit: Energy that does not repeat over that which could.
    """

    ratio: float
    sigma_ppm: float
    misfit: float


def fit_repeats(thinned: Thinned, thinning: Thinning, period: float, samples: int, max_ppm: float) -> RepeatFit | None:
    """Compare a recording with itself some periods later.

    thinned: One recording of a signal that repeats throughout it.
    thinning: How it was thinned.
    period: The period in playback samples.
    samples: Length of the unthinned recording.
    max_ppm: Largest clock skew in parts per million.

    Returns RepeatFit or None: None where the recording is hardly longer than a period.
    """
    values = thinned.values[0, thinned.inside].astype(np.float64)
    values = values - values.mean()
    best: tuple[float, int, int] | None = None
    for periods in range(1, math.floor(samples / period) + 1):
        longest = periods * period * (1 + 1e-6 * max_ppm) / thinning.step
        common = values.size - math.ceil(longest) - 2 * KERNEL_HALF
        worth = periods * math.sqrt(max(common, 0))
        if common >= LEAST_SAMPLES and (best is None or worth > best[0]):
            best = worth, periods, common
    if best is None:
        return None
    _, periods, common = best
    lag = periods * period / thinning.step
    first = values[KERNEL_HALF : KERNEL_HALF + common]

    def later(by: float) -> Float64Array:
        return np.asarray(resampled(values[None], KERNEL_HALF + by, 1.0, common)[0])

    lag = _coarse_lag(values, first, lag, math.ceil(1e-6 * max_ppm * lag / LAG_STEP))
    left, slope = later(lag) - first, np.zeros(common)
    for _ in range(MOST_STEPS):
        slope = (later(lag + DERIVATIVE_STEP) - later(lag - DERIVATIVE_STEP)) / (2 * DERIVATIVE_STEP)
        steep = float(slope @ slope)
        if steep == 0:
            return None
        moved = float(np.clip(-(slope @ left) / steep, -LAG_STEP, LAG_STEP))
        lag += moved
        left = later(lag) - first
        if abs(moved) < 1e-7 * lag:
            break
    ratio = lag * thinning.step / (periods * period)
    sigma = math.sqrt(float(left @ left) / common / steep) / lag
    energy = float(first @ first) + 1e-300
    return RepeatFit(ratio, 1e6 * sigma, float(left @ left) / energy)


def _coarse_lag(values: Float64Array, first: Float64Array, lag: float, reach: int) -> float:
    """The lag at which `first`, which begins `KERNEL_HALF` after the values, comes back best; by a correlation."""
    tried = lag + LAG_STEP * np.arange(-reach, reach + 1)
    length = scipy.fft.next_fast_len(values.size + first.size, real=True)
    cross = scipy.fft.rfft(values, length) * scipy.fft.rfft(first, length).conj()
    # All bins but the first count twice, for the negative frequencies.
    turn = 2 * np.pi * LAG_STEP / length
    cross = 2 * cross * np.exp(2j * np.pi / length * (KERNEL_HALF + tried[0]) * np.arange(cross.size))
    cross[0] /= 2
    correlation = fourier_sum(cross.conj(), turn, 0, tried.size).real / length
    energy = np.concatenate([[0.0], np.cumsum(np.square(values))])
    begin = np.clip(np.round(tried).astype(np.int64) + KERNEL_HALF, 0, values.size - first.size)
    return float(tried[int(np.argmin(energy[begin + first.size] - energy[begin] - 2 * correlation))])
