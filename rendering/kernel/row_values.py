"""Rows of a bank at a few frequencies, read once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.greens.source import GreenSource, read_row
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]
Int64Array = NDArray[np.int64]

ROWS_AT_ONCE = 16


class RowValues:
    """Fourier transforms of rows at chosen frequencies.

    Values are the bank's over one power of two, the same for all rows, so that a bank in any unit fits.

    Parameters
    ----------
    bank : GreenSource
        The bank.
    frequency_hz : float64 array, shape (frequencies,)
        Frequencies in Hz.
    """

    def __init__(self, bank: GreenSource, frequency_hz: Float64Array) -> None:
        self._bank = bank
        self.frequency_hz = frequency_hz
        turns = np.outer(np.arange(bank.taps), frequency_hz / bank.sample_rate_hz)
        phase = -2.0 * np.pi * np.remainder(turns, 1.0)
        self._transform = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
        self._known: dict[int, Complex128Array] = {}
        self._exponent: int | None = None

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators).

        Raises
        ------
        InputError
            A row is all zeros, or holds NaN or infinity.
        """
        missing = [row for row in dict.fromkeys(rows.tolist()) if row not in self._known]
        for first in range(0, len(missing), ROWS_AT_ONCE):
            self._read(missing[first : first + ROWS_AT_ONCE])
        return np.stack([self._known[row] for row in rows.tolist()], axis=1)

    def _read(self, rows: list[int]) -> None:
        values = np.empty((len(rows), self._bank.actuators, self._bank.taps))
        for place, row in enumerate(rows):
            scaled = read_row(self._bank, row)
            if scaled.silent:
                x, y = np.asarray(self._bank.position_mm)[row]
                raise InputError(
                    f"position {row} at ({x:.6g}, {y:.6g}) mm is all zeros, so not measured, but interpolation"
                    " needs it; remeasure or disable the position"
                )
            if self._exponent is None:
                self._exponent = scaled.exponent
            values[place] = np.ldexp(scaled.values, scaled.exponent - self._exponent)
        found = values.reshape(-1, self._bank.taps) @ self._transform
        count = len(self.frequency_hz)
        spectra = (found[:, :count] + 1j * found[:, count:]).reshape(len(rows), self._bank.actuators, count)
        for place, row in enumerate(rows):
            self._known[row] = np.ascontiguousarray(spectra[place].T)
