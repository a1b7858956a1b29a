"""Spectra of the rows that sources visit now, side by side, so that one small product per bin adds them up."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace

import numpy as np

from rendering.arrays import Complex128Array, Float64Array
from rendering.band import Band
from rendering.device import host_device
from rendering.drive.windows import RowSpectra, Windows
from rendering.greens.regularisation import BankRows

CACHE_BYTES = 2**30
"""Memory of row spectra: 1500 positions of 20 actuators and 2000 taps take half of it."""
STACK_BYTES = 128 * 2**20
"""Memory of the stack: 370 rows of that size; more in one block are added up in parts."""
LEAST_PLACES = 16


class RowStack:
    """Sums of windows times time-reversed rows.

    The spectra of rows, each with its saturation, lie in an array (bins, places, actuators): a bin's windows times it
    is a vector times a small matrix, three times as fast as row after row. A row keeps its place until another needs
    it.
    """

    def __init__(self, rows: BankRows, fft_samples: int) -> None:
        self._rows = rows
        device = replace(host_device(), memory_bytes=CACHE_BYTES)
        self._spectra = RowSpectra(rows, Band.whole(fft_samples), device, bounded=True)
        self._fft_samples, self._bins = fft_samples, fft_samples // 2 + 1
        self._most = max(1, STACK_BYTES // (16 * self._bins * rows.bank.actuators))
        self._clear(min(LEAST_PLACES, self._most))

    @property
    def most_rows(self) -> int:
        """Rows whose spectra are kept in memory."""
        return self._spectra.most_rows

    def load(self, row: int) -> None:
        """Read and transform a row. Raises InputError: it may not be used."""
        self._spectra.load([row])

    def total(self, windows: Windows, emitted: Complex128Array, error: float = 0.0) -> Complex128Array:
        """Sum over all windows, (kept bins, actuators).

        emitted, complex128 (windows, bins): Spectra of the windows.
        error: Bound on the norm in time of what may be left out, bins from the highest downwards.
        """
        keys = list(zip(windows.rows.tolist(), windows.regularised_by.tolist(), strict=True))
        if len(keys) <= self._most:
            places = self._placed(keys)
            return self._sum(places, emitted[:, : self._kept(places, emitted, error)])
        parts = [slice(first, first + self._most) for first in range(0, len(keys), self._most)]
        return np.asarray(sum(self._sum(self._placed(keys[part]), emitted[part]) for part in parts))

    def _sum(self, places: list[int], emitted: Complex128Array) -> Complex128Array:
        vector = np.zeros((emitted.shape[1], 1, max(places) + 1), dtype=np.complex128)
        vector[:, 0, places] = emitted.T
        total: Complex128Array = np.matmul(vector, self._stack[: len(vector), : vector.shape[2]])[:, 0]
        return total

    def _kept(self, places: list[int], emitted: Complex128Array, error: float) -> int:
        """Number of bins; the norm in time of those beyond is at most the error (see `rendering.band`)."""
        if not error > 0:
            return self._bins
        size = np.sqrt(np.square(emitted.real) + np.square(emitted.imag))
        summed = np.einsum("wb,wb->b", size, self._magnitude[places])
        beyond = np.cumsum(np.square(summed[::-1])) * (2.0 / self._fft_samples)
        return max(self._bins - int(np.searchsorted(beyond, error**2, side="right")), 1)

    def _placed(self, keys: list[tuple[int, int]]) -> list[int]:
        """Places of rows, each with the row that saturates it or -1; those that have none get one."""
        if len(keys) > self._stack.shape[1]:
            self._clear(min(len(keys) + LEAST_PLACES, self._most))
        elif len(self._place) > 2 * len(keys) + LEAST_PLACES:
            self._place.clear()  # what lies far behind would be multiplied with nothing
        for key in keys:
            if key in self._place:
                self._place.move_to_end(key)
        waiting = set(keys)
        for key in keys:
            if key not in self._place:
                oldest = next(iter(self._place), key)
                place = len(self._place) if oldest in waiting else self._place.pop(oldest)
                self._fill(place, *key)
                self._place[key] = place
        return [self._place[key] for key in keys]

    def _fill(self, place: int, row: int, regularised_by: int) -> None:
        self._spectra.load([row])
        spectrum = self._spectra[row]
        sigma = self._rows.sigma(regularised_by) if regularised_by >= 0 else None
        self._stack[:, place] = spectrum.kept.T if sigma is None else (spectrum.kept * sigma[:, None]).T
        assert spectrum.magnitude is not None
        self._magnitude[place] = spectrum.magnitude  # saturation only lessens a row

    def _clear(self, places: int) -> None:
        self._place: OrderedDict[tuple[int, int], int] = OrderedDict()
        self._stack: Complex128Array = np.zeros((self._bins, places, self._rows.bank.actuators), dtype=np.complex128)
        self._magnitude: Float64Array = np.zeros((places, self._bins))
