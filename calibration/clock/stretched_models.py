"""What the spectrum of a recording of a known signal is made of, at one ratio of the clocks."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum

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
