"""Fields at a fraction of their rate: a low-pass within the transforms, and bins above the lower rate left out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

PASSED = 0.8
"""Frequencies up to this share of half the lower rate are passed."""
STOPBAND_DB = 80.0
LARGEST_FACTOR = 64


class Decimation:
    """Low-passes signals (a windowed sinc, symmetrical about each sample) and keeps every D-th sample.

    Frequencies between `passed_hz` and half the lower rate are attenuated, those above are left out.

    Raises InputError: `lower_hz` is not an integer fraction of `rate_hz`.
    """

    factor: int
    """D."""
    passed_hz: float
    """Frequencies up to this are passed to one part in ten thousand."""
    half: int
    """Samples at the lower rate that the low-pass reaches on either side."""

    def __init__(self, rate_hz: float, lower_hz: float) -> None:
        # Beyond any rate that is allowed, quotients are not finite.
        ratio = rate_hz / lower_hz if lower_hz >= rate_hz / (2 * LARGEST_FACTOR) else 0.0
        self.factor = round(ratio)
        if not (1 <= self.factor <= LARGEST_FACTOR and abs(ratio - self.factor) <= 1e-9 * self.factor):
            raise InputError(
                f"rate_hz is {lower_hz:g}; allowed are {rate_hz:g} Hz over a whole number of at most {LARGEST_FACTOR}"
            )
        self.passed_hz, self.half, self._kernel = rate_hz / 2.0, 0, np.ones(1)
        if self.factor > 1:
            self.passed_hz *= PASSED / self.factor
            width = (1.0 - PASSED) / self.factor
            self.half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / 2.0 / self.factor))
            at = np.arange(-self.half * self.factor, self.half * self.factor + 1)
            kernel = np.sinc(at / self.factor) * np.kaiser(len(at), 0.1102 * (STOPBAND_DB - 8.7))
            self._kernel = kernel / kernel.sum()

    @property
    def kernel_samples(self) -> int:
        """Length of the low-pass at the full rate."""
        return len(self._kernel)

    def weights(self, fft_samples: int) -> Complex128Array:
        """Factors of spectra of `fft_samples`, up to half the lower rate; they delay by `half`."""
        spectrum: Complex128Array = np.fft.rfft(self._kernel, fft_samples)[: fft_samples // self.factor // 2 + 1]
        return spectrum / self.factor
