"""Recordings on another clock, and recordings of a low band at a lower rate."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
import scipy.fft
import scipy.special
from numpy.typing import NDArray

from wavefocus.calibration import Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.numerics import fourier_sum

# Half-width and shape of the interpolating kernel: flat to -100 dB up to 0.8 of half the sample rate.
KERNEL_HALF = 20
KERNEL_BETA = 11.0
# Over one block the places drift from its centre by so many samples at most: a cubic through four kernels then
# errs by less than the kernel itself.
BLOCK_DRIFT_SAMPLES = 0.05
MAX_BLOCK = 4096
# Chebyshev nodes of that cubic, as shares of the drift.
NODES = np.cos(np.pi * (np.arange(4) + 0.5) / 4)
# Output samples that one row of the matrix product gives.
STRIDE = 16

Real = TypeVar("Real", np.float32, np.float64)


def resampled(rows: NDArray[Real], start: float, ratio: float, samples: int) -> NDArray[Real]:
    """Evaluate recordings at the places ``start + k * ratio``; beyond their ends they are 0.

    The step is nearly a whole sample, so the fraction of a sample hardly changes within a block: each block is
    convolved with the kernels of four fractions, and a cubic through them gives every sample.

    rows, float32 or float64 (rows, recorded): The recordings.
    start: Place of the first output sample, in samples.
    ratio: Step from place to place, near 1.
    samples: Number of output samples, >= 0.

    Returns array of the type of `rows`, shape (rows, samples).
    """
    out = np.zeros((rows.shape[0], samples), dtype=rows.dtype)
    recorded = rows.shape[1]
    longest = 2 * BLOCK_DRIFT_SAMPLES / max(abs(ratio - 1), 1e-9)
    block = STRIDE * int(min(max(longest // STRIDE, 1), MAX_BLOCK // STRIDE, samples // STRIDE + 1))
    drift = (np.arange(block, dtype=np.float64) - block // 2) * (ratio - 1)
    cubic = _cubic(drift).astype(rows.dtype)
    lows = np.arange(0, samples, block)
    centre = start + (lows + block // 2) * ratio
    whole = np.floor(centre).astype(np.int64)
    matrices = _staggered(_kernels(centre - whole, NODES * np.abs(drift).max())).astype(rows.dtype)
    # A whole block of zeros at either end, so that every block that touches the recording finds its samples.
    room = block + matrices.shape[1]
    padded = np.zeros((rows.shape[0], recorded + 2 * room), dtype=rows.dtype)
    padded[:, room : room + recorded] = rows
    windows = np.lib.stride_tricks.sliding_window_view(padded, matrices.shape[1], axis=1)
    for low, first, matrix in zip(lows, whole - block // 2 - KERNEL_HALF + 1 + room, matrices, strict=True):
        if not 0 <= first <= padded.shape[1] - room:
            continue
        here = out[:, low : low + block]
        at_nodes = np.ascontiguousarray(windows[:, first : first + block : STRIDE]) @ matrix
        at_nodes = at_nodes.reshape(len(rows), block, NODES.size)[:, : here.shape[1]]
        np.einsum("rkn,kn->rk", at_nodes, cubic[: here.shape[1]], out=here)
    return out


def _kernels(fraction: Float64Array, spread: Float64Array) -> Float64Array:
    """Weights (blocks, nodes, 40) of the samples around places `fraction` + `spread` past a sample."""
    around = np.arange(-KERNEL_HALF + 1, KERNEL_HALF + 1)
    distance = fraction[:, None, None] + spread[:, None] - around
    inside = np.clip(1 - (distance / KERNEL_HALF) ** 2, 0, None)
    window = scipy.special.i0(KERNEL_BETA * np.sqrt(inside)) / scipy.special.i0(KERNEL_BETA)
    return np.asarray(np.sinc(distance) * window)


def _staggered(kernels: Float64Array) -> Float64Array:
    """Matrices (blocks, 39 + STRIDE, STRIDE * nodes): products of one window with kernels shifted sample by sample."""
    blocks, nodes, width = kernels.shape
    matrices = np.zeros((blocks, width + STRIDE - 1, STRIDE, nodes))
    for shift in range(STRIDE):
        matrices[:, shift : shift + width, shift] = kernels.transpose(0, 2, 1)
    return matrices.reshape(blocks, width + STRIDE - 1, STRIDE * nodes)


def _cubic(drift: Float64Array) -> Float64Array:
    """Weights (samples, nodes) of the nodes' values at each sample's drift from the block's centre."""
    reach = max(float(np.abs(drift).max()), 1e-30)
    share = drift / reach
    return np.vander(share, NODES.size) @ np.linalg.inv(np.vander(NODES))


# What lies above the kept band is folded onto it at most this strongly; as even is the filter in the band.
ALIAS_DB = 96.0
# The decimated rate is about so many times the highest frequency: less costs a longer filter.
RATE_OVER_HIGHEST = 3.0


@dataclass(frozen=True, slots=True)
class Decimated:
    """Recordings, low-pass filtered without delay, every so many samples, silence taken beyond their ends.

    values, float32 (records, kept): The filtered recordings.
    first: Sample of the recordings at which the first value lies, negative: before they begin.
    step: Samples of the recordings from value to value.
    inside: The values whose filter does not reach beyond the ends.
    """

    values: Float32Array
    first: int
    step: int
    inside: slice

    def spectrum(self, turn: float, first: int, bins: int) -> Complex128Array:
        """Fourier sums of the undecimated recordings at ``turn * (first + m)`` radians per sample, in the band.

        turn: Spacing of the frequencies in radians per sample of the recordings.
        first, bins: The first is ``first * turn``; how many.

        Returns complex128 (records, bins).
        """
        found = fourier_sum(self.values.astype(np.float64), turn * self.step, first, bins)
        return np.asarray(found * (self.step * np.exp(-1j * turn * self.first * np.arange(first, first + bins))))


def decimate(recordings: Float32Array, highest: float) -> Decimated:
    """Decimate recordings (records, samples) to a band from 0 to `highest` cycles per sample, 0 to 0.5."""
    filter_, step = _low_pass(highest)
    samples, half = recordings.shape[1], filter_.size // 2
    values = recordings
    if step > 1:
        # `scipy.signal.upfirdn` does this as well, but takes more than a second to load.
        outputs = (samples + 2 * half - 1) // step + 1
        values = np.empty((len(recordings), outputs), dtype=np.float32)
        padded = np.zeros((outputs - 1) * step + filter_.size, dtype=np.float32)
        for recording, output in zip(recordings, values, strict=True):
            padded[2 * half : 2 * half + samples] = recording
            windows = np.lib.stride_tricks.sliding_window_view(padded, filter_.size)[::step]
            np.matmul(np.ascontiguousarray(windows), filter_, out=output)  # the filter is even
    # Output k looks at samples step * k - 2 * half ... step * k.
    return Decimated(values, -half, step, slice(-(-2 * half // step), (samples - 1) // step + 1))


def decimation_step(highest: float) -> int:
    """Samples from value to value of recordings decimated to a band from 0 to `highest` cycles per sample."""
    return _low_pass(highest)[1]


@lru_cache(maxsize=8)
def _low_pass(highest: float) -> tuple[Float32Array, int]:
    """The filter for a band, and the step at which its output is kept."""
    step = max(1, math.floor(1 / (RATE_OVER_HIGHEST * highest)))
    if step == 1:
        return np.ones(1, dtype=np.float32), 1
    transition = 2 * np.pi * (1 / step - 2 * highest)
    half = math.ceil((ALIAS_DB - 8) / (2.285 * transition) / 2)
    cut = 1 / (2 * step)
    around = np.arange(-half, half + 1)
    window = np.kaiser(around.size, 0.1102 * (ALIAS_DB - 8.7))
    return (2 * cut * np.sinc(2 * cut * around) * window).astype(np.float32), step
