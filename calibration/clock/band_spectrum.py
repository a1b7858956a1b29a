"""Spectra of periodic segments in a low band, several times faster than whole ones."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

# What lies above the kept band is folded onto it at most this strongly.
ALIAS_DB = 70.0
# Blocks of this many samples or fewer keep the matrix product cheaper than the transform it saves.
LONGEST_BLOCK = 160


class BandSpectrum:
    """Discrete Fourier transform of segments of one period, in some low bins alone.

    The segment, taken as periodic, is low-pass filtered and thinned in one matrix product, then transformed.
    A response and its reference go through the same filter; the spectra are corrected for it all the same.

    period: Samples of a segment.
    bins: Bins wanted, of the period // 2 + 1 there are.
    """

    def __init__(self, period: int, bins: slice) -> None:
        self.period = period
        self.bins = bins
        self._thinning, self._block = _cheapest(period, bins.stop / period)
        self._matrix = np.zeros((0, 0), dtype=np.float32)
        self._correction = np.ones(bins.stop - bins.start, dtype=np.complex64)
        if self._thinning > 1:
            self._design()

    def _design(self) -> None:
        thinning, block = self._thinning, self._block
        shift, half = _reach(thinning, block)
        around = np.arange(-half, half + 1)
        transition = 2 * np.pi * (1 / thinning - 2 * self.bins.stop / self.period)
        attenuation = 8 + 2.285 * transition * 2 * half
        filter_ = np.sinc(around / thinning) * np.kaiser(around.size, 0.1102 * (attenuation - 8.7))
        both = np.zeros((2 * block, block // thinning))
        for output in range(block // thinning):
            both[output * thinning + shift + around, output] = filter_
        self._matrix = np.concatenate([both[:block], both[block:]], axis=1).astype(np.float32)
        omega = 2 * np.pi * np.arange(self.bins.start, self.bins.stop) / self.period
        passed = np.cos(omega[:, None] * around) @ filter_
        self._correction = (thinning * np.exp(-1j * omega * shift) / passed).astype(np.complex64)

    def __call__(self, recording: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.complex64]:
        """Spectra of segments of recordings.

        recording, float32 (records, samples): Recordings, contiguous.
        starts, int64 (records, segments): First samples; each segment lies inside its recording.

        Returns complex64 (records, segments, bins).
        """
        if self._thinning == 1:
            segments = np.empty((*starts.shape, self.period), dtype=np.float32)
            for record, row in enumerate(starts):
                for segment, start in enumerate(row):
                    segments[record, segment] = recording[record, start : start + self.period]
            return np.ascontiguousarray(scipy.fft.rfft(segments, overwrite_x=True)[..., self.bins])
        blocks, width = self.period // self._block, self._block // self._thinning
        product = np.empty((*starts.shape, blocks, 2 * width), dtype=np.float32)
        for record, row in enumerate(starts):
            for segment, start in enumerate(row):
                piece = recording[record, start : start + self.period].reshape(blocks, self._block)
                np.matmul(piece, self._matrix, out=product[record, segment])
        thin = np.empty((*starts.shape, blocks, width), dtype=np.float32)
        np.add(product[..., :-1, :width], product[..., 1:, width:], out=thin[..., :-1, :])
        np.add(product[..., -1, :width], product[..., 0, width:], out=thin[..., -1, :])
        spectra = scipy.fft.rfft(thin.reshape(*starts.shape, -1), overwrite_x=True)
        return np.asarray(spectra[..., self.bins] * self._correction)


def _reach(thinning: int, block: int) -> tuple[int, int]:
    """Where the first output of a block lies, and how far its filter reaches inside two blocks."""
    shift = (block + thinning) // 2
    return shift, min(shift, block + thinning - 1 - shift)


def _cheapest(period: int, highest: float) -> tuple[int, int]:
    """Thinning and block length that divide the period and cost least; (1, period) if none will do."""
    best, least = (1, period), np.inf
    for thinning in range(2, 33):
        transition = 2 * np.pi * (1 / thinning - 2 * highest)
        if period % (2 * thinning) or transition <= 0:
            continue
        for block in range(2 * thinning, LONGEST_BLOCK + 1, thinning):
            enough = 8 + 2.285 * transition * 2 * _reach(thinning, block)[1] >= ALIAS_DB
            # Products cost in proportion to the block; 50 is what the transform costs on that scale.
            if period % block == 0 and enough and (block + 50) / thinning < least:
                best, least = (thinning, block), (block + 50) / thinning
    return best
