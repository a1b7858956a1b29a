"""Spectra of bank rows, transformed when they are first asked for and kept while there is room."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.omission import Economy
from rendering.regularisation import BankRows

Float64Array = NDArray[np.float64]

CACHE_BYTES = 384 * 2**20
PADDED_BYTES = 2 * 2**20
"""Rows of so many bytes are transformed together: enough for two threads, and still in their cache."""
FFT_WORKERS = 2
FLUSH = np.float32(2.0**-70)
"""Added and taken away again, it rounds single precision to multiples of 2**-94: no denormal is left."""


@dataclass(frozen=True, slots=True)
class RowSpectrum:
    """Transform of a time-reversed, scaled row.

    Parameters
    ----------
    kept : complex array, shape (actuators, kept bins)
    norms : float64 array, shape (actuators, segments + 1)
        Norms over the segments of the economy; empty where nothing is left out.
    """

    kept: NDArray[Any]
    norms: Float64Array


class RowSpectra:
    """Transforms rows once and keeps the latest.

    Parameters
    ----------
    rows : BankRows
        Where rows are read.
    fft_samples : int
        Transform length.
    economy : Economy
        Precision, and which bins to keep.
    """

    def __init__(self, rows: BankRows, fft_samples: int, economy: Economy) -> None:
        self._rows = rows
        self._economy = economy
        actuators = rows.bank.actuators
        row_bytes = actuators * fft_samples * np.dtype(economy.real).itemsize
        self._at_once = max(1, PADDED_BYTES // row_bytes)
        # Kept and refilled: fresh zeros for each row would cost as much as its transform.
        self._padded = np.zeros((self._at_once, actuators, fft_samples), dtype=economy.real)
        self._cache: OrderedDict[int, RowSpectrum] = OrderedDict()
        self._bytes = 0

    def spectra(self, rows: list[int]) -> list[RowSpectrum]:
        """Spectra of rows. Raises InputError where one may not be used."""
        missing = [row for row in dict.fromkeys(rows) if row not in self._cache]
        found: dict[int, RowSpectrum] = {}
        for first in range(0, len(missing), self._at_once):
            found.update(self._transformed(missing[first : first + self._at_once]))
        for row in rows:
            if row not in found:
                self._cache.move_to_end(row)
                found[row] = self._cache[row]
        for row in missing:
            self._cache[row] = found[row]
            self._bytes += found[row].kept.nbytes
        while self._bytes > CACHE_BYTES and len(self._cache) > 1:
            self._bytes -= self._cache.popitem(last=False)[1].kept.nbytes
        return [found[row] for row in rows]

    def _transformed(self, rows: list[int]) -> dict[int, RowSpectrum]:
        economy = self._economy
        padded = self._padded[: len(rows)]
        for place, row in enumerate(rows):
            values = self._rows.read(row).values
            padded[place, :, : values.shape[1]] = values[:, ::-1]
        if economy.single:
            padded += FLUSH
            padded -= FLUSH
        full = scipy_fft.rfft(padded, axis=2, workers=FFT_WORKERS)
        norms = np.zeros((len(rows), 0, 0)) if economy.exact else economy.norms(full)
        # Where all bins are kept, rows that were transformed together share their memory.
        kept = full if economy.kept == economy.bins else full[:, :, economy.low : economy.high].copy()
        return {row: RowSpectrum(kept[place], norms[place]) for place, row in enumerate(rows)}
