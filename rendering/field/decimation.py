"""Signals at a fraction of their rate: low-passed and every D-th sample kept, by matrix products."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from storage.errors import InputError

Float64Array = NDArray[np.float64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

PASSED = 0.8
"""Frequencies up to this share of half the lower rate are passed."""
STOPBAND_DB = 80.0
LARGEST_FACTOR = 64


class Decimation:
    """Low-passes signals (a windowed sinc, symmetrical about each sample) and keeps every D-th sample.

    What lies between `passed_hz` and half the lower rate is weakened, and so is what folds onto that from as far
    above; what folds onto `passed_hz` and below is less by 80 dB.

    Parameters
    ----------
    rate_hz : float
        Rate of the signals.
    lower_hz : float
        Rate wanted, an integer fraction of theirs.

    Raises
    ------
    InputError
        The rate wanted is not such a fraction.
    """

    factor: int
    """D."""
    passed_hz: float
    """What is passed to one part in ten thousand."""

    def __init__(self, rate_hz: float, lower_hz: float) -> None:
        # Beyond any rate that is allowed, quotients are not finite.
        ratio = rate_hz / lower_hz if lower_hz >= rate_hz / (2 * LARGEST_FACTOR) else 0.0
        self.factor = round(ratio)
        if not (1 <= self.factor <= LARGEST_FACTOR and abs(ratio - self.factor) <= 1e-9 * self.factor):
            raise InputError(
                f"rate_hz is {lower_hz:g}; allowed are {rate_hz:g} Hz over a whole number of at most {LARGEST_FACTOR}"
            )
        self.passed_hz = PASSED * rate_hz / self.factor / 2.0 if self.factor > 1 else rate_hz / 2.0
        width = (1.0 - PASSED) / self.factor
        half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / 2.0 / self.factor))
        self.half = half if self.factor > 1 else 0
        """Samples at the lower rate that the low-pass reaches on either side."""
        at = np.arange(-self.half * self.factor, self.half * self.factor + 1)
        kernel = np.sinc(at / self.factor) / self.factor * np.kaiser(len(at), 0.1102 * (STOPBAND_DB - 8.7))
        self._kernel: Float64Array = kernel / kernel.sum()
        # So long a frame that what it makes reaches over into one other at either end, half and half.
        self._outputs = 2 * self.half + 1
        frame = self._outputs * self.factor
        outputs = np.arange(-self.half, self._outputs + self.half + 1)
        offset = outputs[None, :] * self.factor - np.arange(frame)[:, None]
        reach = self.half * self.factor
        weights = self._kernel[np.clip(offset + reach, 0, 2 * reach)]
        self._matrix: Float64Array = np.where(np.abs(offset) <= reach, weights, 0.0)
        self._single = self._matrix.astype(np.float32)

    def samples(self, count: int) -> int:
        """Samples at the lower rate of a signal of `count`, its ends included."""
        return -(-count // self.factor) + 2 * self.half + 1

    def lower(self, signals: RealArray) -> RealArray:
        """Signals (n, samples) at the lower rate, (n, `samples`); the first is `half` before the signals' first."""
        if self.factor == 1:
            padded = np.zeros((len(signals), signals.shape[1] + 1), dtype=signals.dtype)
            padded[:, :-1] = signals
            return padded
        count, length = signals.shape
        outputs, frame = self._outputs, self._outputs * self.factor
        frames = -(-length // frame)
        padded = np.empty((count, frames * frame), dtype=signals.dtype)
        padded[:, :length] = signals
        padded[:, length:] = 0
        matrix = self._single if signals.dtype == np.float32 else self._matrix
        parts = (padded.reshape(count * frames, frame) @ matrix).reshape(count, frames, 2 * outputs)
        total = np.zeros((count, (frames + 1) * outputs), dtype=signals.dtype)
        total[:, :-outputs].reshape(count, frames, outputs)[:] = parts[:, :, :outputs]
        total[:, outputs:].reshape(count, frames, outputs)[:] += parts[:, :, outputs:]
        return total[:, : self.samples(length)]

    def response(self, frequency_hz: Float64Array, rate_hz: float) -> Float64Array:
        """What the low-pass makes of frequencies, before folding."""
        spectrum = np.zeros(2**16)
        reach = self.half * self.factor
        spectrum[np.arange(-reach, reach + 1)] = self._kernel
        grid = scipy_fft.rfftfreq(len(spectrum), 1.0 / rate_hz)
        return np.interp(frequency_hz, grid, scipy_fft.rfft(spectrum).real)
