"""A known signal in a recording: roughly where it lies, and its spectrum at any clock ratio."""

from __future__ import annotations

import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum
from calibration.clock.resampling import resampled

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
