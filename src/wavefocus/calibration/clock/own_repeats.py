"""The clock of a recording from its own repeats, whatever repeats in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Float64Array
from wavefocus.calibration.clock.resampling import KERNEL_HALF, Decimated, resampled
from wavefocus.calibration.numerics import fourier_sum

MAX_STEPS = 8
# Lags looked at are so many decimated samples apart: a thirtieth of a period of the highest frequency.
LAG_STEP = 0.1
# Step over which a derivative is taken, in decimated samples.
DERIVATIVE_STEP = 0.02
# A clock fitted to the signal's own repeats must be as sure as this; 1 ppm would cost 1 dB at -63 dB.
MAX_SIGMA_PPM = 0.3
MAX_MISFIT = 0.03
# Fewer decimated samples than this are not enough.
MIN_SAMPLES = 32


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

    @property
    def is_sure(self) -> bool:
        """Whether it repeats so well that its own clock can be used."""
        return self.sigma_ppm < MAX_SIGMA_PPM and self.misfit < MAX_MISFIT


def fit_repeats(decimated: Decimated, period: float, samples: int, max_ppm: float) -> RepeatFit | None:
    """Compare a recording with itself some periods later.

    decimated: One recording of a signal that repeats throughout it.
    period: The period in playback samples.
    samples: Length of the undecimated recording.
    max_ppm: Largest clock skew in parts per million.

    Returns RepeatFit or None: None where the recording is hardly longer than a period.
    """
    values = decimated.values[0, decimated.inside].astype(np.float64)
    values = values - values.mean()
    best: tuple[float, int, int] | None = None
    for periods in range(1, math.floor(samples / period) + 1):
        longest = periods * period * (1 + 1e-6 * max_ppm) / decimated.step
        common = values.size - math.ceil(longest) - 2 * KERNEL_HALF
        worth = periods * math.sqrt(max(common, 0))
        if common >= MIN_SAMPLES and (best is None or worth > best[0]):
            best = worth, periods, common
    if best is None:
        return None
    _, periods, common = best
    lag = periods * period / decimated.step
    first = values[KERNEL_HALF : KERNEL_HALF + common]

    def later(by: float) -> Float64Array:
        return np.asarray(resampled(values[None], KERNEL_HALF + by, 1.0, common)[0])

    lag = _coarse_lag(values, first, lag, math.ceil(1e-6 * max_ppm * lag / LAG_STEP))
    left, slope = later(lag) - first, np.zeros(common)
    for _ in range(MAX_STEPS):
        slope = (later(lag + DERIVATIVE_STEP) - later(lag - DERIVATIVE_STEP)) / (2 * DERIVATIVE_STEP)
        steep = float(slope @ slope)
        if steep == 0:
            return None
        moved = float(np.clip(-(slope @ left) / steep, -LAG_STEP, LAG_STEP))
        lag += moved
        left = later(lag) - first
        if abs(moved) < 1e-7 * lag:
            break
    ratio = lag * decimated.step / (periods * period)
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
