"""A known signal in a recording: where it lies, its spectrum at any clock ratio, and recordings on another clock."""

from __future__ import annotations

import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import scipy.fft
import scipy.special
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

# Half-width and shape of the interpolating kernel: flat to -100 dB up to 0.8 of half the sample rate.
KERNEL_HALF = 20
KERNEL_BETA = 11.0
# Over one block the places drift from its centre by so many samples at most: a cubic through four kernels then
# errs by less than the kernel itself.
BLOCK_DRIFT_SAMPLES = 0.05
LONGEST_BLOCK = 4096
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
    block = STRIDE * int(min(max(longest // STRIDE, 1), LONGEST_BLOCK // STRIDE, samples // STRIDE + 1))
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


def _kernels(fraction: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (blocks, nodes, 40) of the samples around places `fraction` + `spread` past a sample."""
    around = np.arange(-KERNEL_HALF + 1, KERNEL_HALF + 1)
    distance = fraction[:, None, None] + spread[:, None] - around
    inside = np.clip(1 - (distance / KERNEL_HALF) ** 2, 0, None)
    window = scipy.special.i0(KERNEL_BETA * np.sqrt(inside)) / scipy.special.i0(KERNEL_BETA)
    return np.asarray(np.sinc(distance) * window)


def _staggered(kernels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrices (blocks, 39 + STRIDE, STRIDE * nodes): products of one window with kernels shifted sample by sample."""
    blocks, nodes, width = kernels.shape
    matrices = np.zeros((blocks, width + STRIDE - 1, STRIDE, nodes))
    for shift in range(STRIDE):
        matrices[:, shift : shift + width, shift] = kernels.transpose(0, 2, 1)
    return matrices.reshape(blocks, width + STRIDE - 1, STRIDE * nodes)


def _cubic(drift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (samples, nodes) of the nodes' values at each sample's drift from the block's centre."""
    reach = max(float(np.abs(drift).max()), 1e-30)
    share = drift / reach
    return np.vander(share, NODES.size) @ np.linalg.inv(np.vander(NODES))


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


# Blocks of the known signal that are looked for one by one; silent ones are left out.
BLOCKS = 8
LEAST_ENERGY = 0.05
# Points per bin of the band on the way back to lags: near enough for a parabola through the envelope's top.
OVERSAMPLING = 1.5
# Silence around the signal where its blocks are looked for in itself.
TRIAL_MARGIN_SAMPLES = 200


class BlockSearch:
    """Finds blocks of a known signal by cross-correlation and draws a line through where they lie.

    The envelopes of the blocks' correlations are added without phase, so that neither repeats in the signal
    nor a drift over the record can mislead it. Only the band of the signal is transformed back.

    A stretch moves a block of a sweep also because its frequencies are met elsewhere in the sweep. How far each
    block moves per unit of stretch is therefore measured on the known signal, stretched on purpose.

    known, float64 (known,): The signal, not all zeros.
    band: Lowest and highest frequency that matter, in cycles per sample.
    max_ppm: Largest skew of the clocks looked for, in parts per million.
    """

    def __init__(self, known: NDArray[np.float64], band: tuple[float, float], max_ppm: float) -> None:
        self._known, self._band, self._max_ppm = known, band, max_ppm
        edges = np.linspace(0, known.size, BLOCKS + 1).astype(int)
        spans = [(int(low), int(high)) for low, high in itertools.pairwise(edges) if high > low]
        energy = np.array([np.square(known[low:high]).sum() for low, high in spans])
        loud = energy > LEAST_ENERGY * energy.max()
        self._spans = [span for span, is_loud in zip(spans, loud, strict=True) if is_loud]
        self._energy = energy[loud]
        self._held: tuple[int, _Blocks] | None = None
        self._moves = np.zeros(len(self._spans))
        if len(self._spans) > 1:
            trial = 0.5e-6 * max_ppm
            samples = known.size + 2 * TRIAL_MARGIN_SAMPLES
            lags = [
                self._lags(resampled(known[None], -TRIAL_MARGIN_SAMPLES, 1 / (1 + skew), samples)[0])
                for skew in (trial, -trial)
            ]
            self._moves = (lags[0] - lags[1]) / (2 * trial)

    def first_guess(self, recorded: NDArray[np.floating]) -> tuple[float, float]:
        """Offset and clock ratio, to about a sample over the record.

        recorded, float (samples,): The recording; the signal may lie anywhere in it, or stick out at either end.
        """
        lags = self._lags(recorded)
        share = self._energy / self._energy.sum()
        moves = self._moves - share @ self._moves
        spread = float(share @ moves**2)
        # Blocks that all move alike do not show the stretch.
        slope = float(share @ (moves * lags)) / spread if spread > 1.0 else 0.0
        slope = min(max(slope, -1e-6 * self._max_ppm), 1e-6 * self._max_ppm)
        return float(share @ (lags - slope * self._moves)), 1.0 + slope

    def _lags(self, recorded: NDArray[np.floating]) -> NDArray[np.float64]:
        """Sample at which the signal would begin, by each block."""
        blocks = self._blocks_for(recorded.size)
        spectrum = scipy.fft.rfft(recorded.astype(np.float32, copy=False), blocks.length)[blocks.bins]
        envelopes = np.abs(scipy.fft.ifft(spectrum * blocks.spectra, blocks.lags, axis=1))
        step = blocks.length / blocks.lags
        top = int(np.argmax(envelopes.sum(axis=0)))
        # A sweep stretched moves its blocks by twice the stretch.
        reach = math.ceil((2e-6 * self._max_ppm * self._known.size + 8) / step)
        near = (top + np.arange(-reach - 1, reach + 2)) % blocks.lags
        close = envelopes[:, near].astype(np.float64)
        found = 1 + np.argmax(close[:, 1:-1], axis=1)
        before, at, after = (close[np.arange(len(close)), found + side] for side in (-1, 0, 1))
        bend = np.minimum(before - 2 * at + after, -1e-9 * at - 1e-30)
        late = found - reach - 1 + np.clip(0.5 * (before - after) / bend, -1, 1)
        return np.asarray(step * (top + late) - (blocks.length if step * top >= recorded.size else 0))

    def _blocks_for(self, recorded: int) -> _Blocks:
        held = self._held
        if held is None or held[0] != recorded:
            held = self._held = (recorded, self._transformed(recorded))
        return held[1]

    def _transformed(self, recorded: int) -> _Blocks:
        length = scipy.fft.next_fast_len(recorded + self._known.size, real=True)
        bins = slice(max(int(self._band[0] * length), 1), math.ceil(self._band[1] * length))
        spectra = []
        for low, high in self._spans:
            alone = np.zeros(length)
            alone[low:high] = self._known[low:high]
            spectra.append(scipy.fft.rfft(alone)[bins].conj().astype(np.complex64))
        stacked = np.stack(spectra)
        return _Blocks(length, bins, scipy.fft.next_fast_len(math.ceil(OVERSAMPLING * stacked.shape[1])), stacked)


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Conjugate spectra of the blocks, in the band of a transform of `length`; lags of the way back."""

    length: int
    bins: slice
    lags: int
    spectra: NDArray[np.complex64]


KEPT_MODELS = 16


@dataclass(frozen=True, slots=True)
class Model:
    """Parts of a spectrum, and how the share of each is found by least squares.

    ratio: DAQ rate over playback rate.
    regressors, float64 (parts, 2 * bins): Real and imaginary parts in turn: the signal, its change with offset and with
        ratio, and the signal below each corner frequency.
    solve, float64 (parts, 2 * bins): Its product with a spectrum gives the parts' shares.
    """

    ratio: float
    regressors: NDArray[np.float64]
    solve: NDArray[np.float64]


class StretchedModels:
    """Models of one known signal, made when first asked for; the last few are kept. Safe to share.

    known, float64 (known,): The signal on the playback clock.
    length: Length of the transform on the DAQ clock.
    bins: Its bins that are looked at.
    corners: Corners of coupling capacitors allowed for, in radians per sample.
    """

    def __init__(self, known: NDArray[np.float64], length: int, bins: slice, corners: Sequence[float]) -> None:
        self._known, self._length, self._bins = known, length, bins
        self._omega = 2 * np.pi / length * np.arange(bins.start, bins.stop)
        self._coupling = np.stack([1 / (1 + 1j * self._omega / corner) for corner in corners])
        self._held: OrderedDict[float, Model] = OrderedDict()
        self._lock = threading.Lock()

    def at(self, skew_ppm: float) -> Model:
        """The model for clocks that differ by so many parts per million."""
        with self._lock:
            model = self._held.get(skew_ppm)
            if model is None:
                model = self._held[skew_ppm] = self._made(1 + 1e-6 * skew_ppm)
                if len(self._held) > KEPT_MODELS:
                    self._held.popitem(last=False)
            self._held.move_to_end(skew_ppm)
            return model

    def _made(self, ratio: float) -> Model:
        # The spectrum of a stretched signal is its own at scaled frequencies: exact, no interpolation.
        turn = 2 * np.pi * ratio / self._length
        known, later = (
            fourier_sum(signal, turn, self._bins.start, self._omega.size)
            for signal in (self._known, np.arange(self._known.size) * self._known)
        )
        slopes = -1j * self._omega * np.stack([known, later])
        regressors = np.concatenate([known[None], slopes, self._coupling * known]).view(np.float64)
        # Scaled to one size, or the Gram matrix loses half its digits.
        size = np.sqrt(np.square(regressors).sum(axis=1, keepdims=True))
        size[size == 0] = 1.0
        even = regressors / size
        return Model(ratio, regressors, np.linalg.pinv(even @ even.T, hermitian=True) @ even / size)
