"""Recordings thinned to a low band, without loss in it, so that all that follows costs a fraction."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

# What lies above the kept band is folded onto it at most this strongly; as even is the filter in the band.
ALIAS_DB = 96.0
# The thinned rate is about so many times the highest frequency: less costs a longer filter.
RATE_OVER_HIGHEST = 3.0


@dataclass(frozen=True, slots=True)
class Thinned:
    """Recordings, low-pass filtered without delay, every so many samples, silence taken beyond their ends.

    values, float32 (records, kept): The filtered recordings.
    first: Sample of the recordings at which the first value lies, negative: before they begin.
    inside: The values whose filter does not reach beyond the ends.
    """

    values: Float32Array
    first: int
    inside: slice


class Thinning:
    """A low-pass filter and the step at which its output is kept.

    highest: Upper end of the band in cycles per sample, 0 to 0.5.
    """

    def __init__(self, highest: float) -> None:
        self.highest = highest
        self.step = max(1, math.floor(1 / (RATE_OVER_HIGHEST * highest)))
        self._half = 0
        self._filter = np.ones(1, dtype=np.float32)
        if self.step > 1:
            transition = 2 * np.pi * (1 / self.step - 2 * highest)
            self._half = math.ceil((ALIAS_DB - 8) / (2.285 * transition) / 2)
            cut = 1 / (2 * self.step)
            around = np.arange(-self._half, self._half + 1)
            window = np.kaiser(around.size, 0.1102 * (ALIAS_DB - 8.7))
            self._filter = (2 * cut * np.sinc(2 * cut * around) * window).astype(np.float32)

    def __call__(self, recordings: Float32Array) -> Thinned:
        """Thin recordings (records, samples)."""
        samples = recordings.shape[1]
        values = recordings
        if self.step > 1:
            import scipy.signal  # half a second of start; most commands thin nothing

            values = scipy.signal.upfirdn(self._filter, recordings, down=self.step, axis=1)
        # Output k looks at samples step * k - 2 * half ... step * k.
        inside = slice(-(-2 * self._half // self.step), (samples - 1) // self.step + 1)
        return Thinned(values, -self._half, inside)

    def spectrum(self, thinned: Thinned, turn: float, first: int, bins: int) -> NDArray[np.complex128]:
        """Fourier sums of the unthinned recordings at ``turn * (first + m)`` radians per sample, in the band.

        thinned: The recordings.
        turn: Spacing of the frequencies in radians per sample of the recordings.
        first, bins: The first is ``first * turn``; how many.

        Returns complex128 (records, bins).
        """
        found = fourier_sum(thinned.values.astype(np.float64), turn * self.step, first, bins)
        return np.asarray(found * (self.step * np.exp(-1j * turn * thinned.first * np.arange(first, first + bins))))
