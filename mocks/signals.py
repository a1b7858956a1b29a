"""Signals that were played, each kept once with its spectra."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray
from scipy.signal import czt

from mocks.bounded_cache import BoundedCache

Float64Array = NDArray[np.float64]
Complex64Array = NDArray[np.complex64]


class PlayedSignal:
    """One signal as the player's 16-bit converter puts it out.

    Parameters
    ----------
    volts : float64 array, shape (samples,)
        The signal in volts.
    full_scale_v : float
        Full scale of the converter in volts.

    Attributes
    ----------
    kept_bins : BoundedCache of int
        How many bins of each spectrum matter to a response; the synthesis fills it.
    """

    def __init__(self, volts: Float64Array, full_scale_v: float) -> None:
        self.volts = volts
        self._step_v = full_scale_v / 32768
        self.kept_bins: BoundedCache[int] = BoundedCache(3)
        self._spectra: BoundedCache[Complex64Array] = BoundedCache(3)

    def spectrum(self, length: int, scale: float, samples: int) -> Complex64Array:
        """Spectrum of the first samples, on the clock of the recorder.

        The output is band-limited, so its spectrum on another clock is its Fourier transform at scaled
        frequencies: exact, no interpolation.

        Parameters
        ----------
        length : int
            Length N of the recorder's transform; bin m lies at m / N cycles per recorder sample.
        scale : float
            Recorder samples per player sample.
        samples : int
            How many samples were played.

        Returns
        -------
        complex64 array, shape (bins,)
            Up to half the player's or half the recorder's rate, whichever is lower.
        """
        return self._spectra.get((length, scale, samples), lambda: self._transform(length, scale, samples))

    def _transform(self, length: int, scale: float, samples: int) -> Complex64Array:
        bins = min(length // 2, int(length / (2 * scale))) + 1
        counts = np.clip(np.rint(self.volts[:samples] / self._step_v), -32768, 32767)
        if counts.size == 0:
            return np.zeros(bins, dtype=np.complex64)
        step = np.exp(-2j * np.pi * scale / length)
        return np.asarray(scale * self._step_v * czt(counts, m=bins, w=step), dtype=np.complex64)


class SignalStore:
    """Recognises signals by their content, so that a signal played again costs one comparison.

    Parameters
    ----------
    full_scale_v : float
        Full scale of the player in volts.
    size : int
        How many signals to keep.
    """

    def __init__(self, full_scale_v: float, size: int = 64) -> None:
        self._full_scale_v = full_scale_v
        self._size = size
        self._held: OrderedDict[tuple[int, bytes], PlayedSignal] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, volts: Float64Array) -> PlayedSignal:
        """The signal of this content; new ones are copied.

        Parameters
        ----------
        volts : float64 array, shape (samples,)
            The signal in volts.
        """
        key = (volts.size, volts[:: max(1, volts.size // 64)].tobytes())
        with self._lock:
            held = self._held.get(key)
            if held is None or not np.array_equal(held.volts, volts):
                held = PlayedSignal(volts.copy(), self._full_scale_v)
                self._held[key] = held
                if len(self._held) > self._size:
                    self._held.popitem(last=False)
            self._held.move_to_end(key)
            return held
