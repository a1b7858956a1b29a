"""Blocks that hold few frequencies are made at a fraction of the rate and interpolated once, with what that costs.

Block b is a trigonometric polynomial p on its N samples; at every D-th of them it is known exactly from its
lowest N / D bins. The blocks' samples are added up at that rate, and a low-pass (a windowed sinc) interpolates
the sum. On the circle of N samples the low-pass takes p to p times its own transform: what that differs from 1
in the bins computed, and what it lets through of their D - 1 images, are the *ripple*, evaluated at those very
bins. On the line it also spills over the block's ends what on the circle would have come round: the *spill*,
evaluated for each block, is wrong outside, and missing at the opposite end. So per block, with |.| the
Euclidean norm, the error is at most ripple |p| + sqrt(2) |spill|, and rounding in proportion to |p|.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy import fft as scipy_fft

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

FACTORS = (2, 3, 4, 6, 8, 12)
MULTIPLE = 24
"""Blocks and hops that are multiples of this can be made at any of these fractions of the rate."""
LEAST_ROOM = 0.1
"""Width of the low-pass's transition, as a share of the lower rate: less would make it long."""
STOPBAND_DB = 110.0
FRAMES_BYTES = 2**19
"""Frames of so many bytes are interpolated together, within the cache of one core."""
FRAME = 16
"""Samples at the lower rate that one row of the matrix product makes."""


def choose_factor(fft_samples: int, high: int) -> int:
    """By how much the rate may fall where bins below `high` are kept; 1 where it may not."""
    if fft_samples % MULTIPLE:
        return 1
    allowed = [factor for factor in FACTORS if fft_samples / factor - 2 * high >= LEAST_ROOM * fft_samples / factor]
    return max(allowed, default=1)


class Upsampling:
    """Interpolates blocks from a fraction of the rate.

    Parameters
    ----------
    fft_samples : int
        Length N of a block.
    high : int
        Bins below this are in use.
    hop : int
        Samples from one block to the next.
    factor : int
        D.
    """

    overlap: int
    """Most blocks that one sample lies in, what they spill over included."""

    def __init__(self, fft_samples: int, high: int, hop: int, factor: int) -> None:
        self.factor = factor
        self._kernel, ripple = _kernel(fft_samples, high, factor)
        self.half = (len(self._kernel) - 1) // (2 * factor)
        reach = self.half * factor
        at = np.arange(-reach, reach + 1)
        self._frame = self._matrix(np.arange(FRAME * factor), np.arange(-self.half, FRAME + self.half))
        spilled = np.arange(reach)
        self._before = self._matrix(-1 - spilled, np.arange(self.half))
        self._after = self._matrix(spilled, np.arange(-self.half, 0))
        self.overlap = -(-(fft_samples + 2 * reach) // hop)
        size = np.abs(self._kernel)
        by_phase = max(float(size[at % factor == phase].sum()) for phase in range(factor))
        gain = float(np.sqrt(by_phase * size.sum() * factor))
        # In single precision, both blocks are added up and the low-pass is summed.
        self._relative = ripple + (2 * self.half + 3 + self.overlap) * 2.0**-24 * gain

    def errors(self, samples: Float32Array, norms: Float64Array) -> Float64Array:
        """Bounds on the errors of interpolating blocks.

        Parameters
        ----------
        samples : float32 array, shape (blocks, actuators, N / D)
            Blocks.
        norms : float64 array, shape (blocks,)
            Their norms at the full rate, |p|.
        """
        spill = np.zeros(len(samples))
        for ends, matrix in ((samples[:, :, : self.half], self._before), (samples[:, :, -self.half :], self._after)):
            # All in one product: there may be very many of them, and each is small.
            spilled = np.ascontiguousarray(ends).reshape(-1, self.half) @ matrix
            spill += block_energies(spilled.reshape(*samples.shape[:2], -1))
        errors: Float64Array = self._relative * norms + np.sqrt(2.0 * spill)
        return errors

    def interpolate(self, samples: Float32Array, out: Float32Array | None = None) -> Float32Array:
        """Interpolate (actuators, n + 2 half) to (actuators, n D), into `out` where given; n is a multiple of FRAME.

        The first sample returned is that of samples[:, half].
        """
        actuators, length = samples.shape
        frames = (length - 2 * self.half) // FRAME
        stride = samples.strides[1]
        overlapping = as_strided(
            samples,
            (actuators, frames, FRAME + 2 * self.half),
            (samples.strides[0], FRAME * stride, stride),
            writeable=False,
        )
        found = np.empty((actuators, frames * FRAME * self.factor), dtype=np.float32) if out is None else out
        at_once = max(1, FRAMES_BYTES // max(frames * overlapping.shape[2] * 4, 1))
        for begin in range(0, actuators, at_once):
            some = overlapping[begin : begin + at_once]
            made = found[begin : begin + at_once].reshape(len(some), frames, FRAME * self.factor)
            np.matmul(np.ascontiguousarray(some), self._frame, out=made)
        return found

    def _matrix(self, outputs: NDArray[np.int64], inputs: NDArray[np.int64]) -> Float32Array:
        """What samples at inputs * D make at outputs, (inputs, outputs)."""
        offset = outputs[None, :] - inputs[:, None] * self.factor
        reach = self.half * self.factor
        return np.where(np.abs(offset) <= reach, self._kernel[np.clip(offset + reach, 0, 2 * reach)], 0.0).astype(
            np.float32
        )


def block_energies(samples: NDArray[Any]) -> Float64Array:
    """Energy of each block (blocks, actuators, samples), no smaller than rounding."""
    energy: Float64Array = row_energies(samples).sum(axis=1) * (1.0 + samples.shape[2] * np.finfo(samples.dtype).eps)
    return energy


def row_energies(samples: NDArray[Any]) -> Float64Array:
    """Energy along the last axis, summed up in the samples' own precision."""
    squares = np.matmul(samples[..., None, :], samples[..., :, None])[..., 0, 0]
    return np.asarray(squares, dtype=np.float64)


@lru_cache(maxsize=16)
def _kernel(fft_samples: int, high: int, factor: int) -> tuple[Float64Array, float]:
    """Windowed sinc over D, 2 half D + 1 samples long, and its ripple at the bins in use."""
    lower = fft_samples // factor
    width = (lower - 2 * high + 2) / fft_samples
    half = int(np.ceil((STOPBAND_DB - 8.0) / (2.285 * 2.0 * np.pi * width) / (2.0 * factor)))
    half = min(half, lower // 4)
    at = np.arange(-half * factor, half * factor + 1)
    kernel = np.sinc(at / factor) * np.kaiser(len(at), 0.1102 * (STOPBAND_DB - 8.7)) / factor
    circle = np.zeros(fft_samples)
    # As it is used: rounded to single precision.
    circle[at] = kernel.astype(np.float32)
    spectrum = scipy_fft.fft(circle).real
    bins = np.arange(-high + 1, high)
    images = spectrum[(bins + lower * np.arange(factor)[:, None]) % fft_samples]
    images[0] -= 1.0
    return kernel, float(np.sqrt(np.square(images).sum(axis=0).max()))
