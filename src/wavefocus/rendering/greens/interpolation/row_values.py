"""Values of a bank's rows at some frequencies."""

from __future__ import annotations

import numpy as np

from wavefocus.calibration.numerics import transform_at
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.source import GreenSource, RowReader
from wavefocus.storage.errors import InputError


class RowValues:
    """Fourier transforms of a bank's rows at frequencies (n,), each row read once."""

    def __init__(self, bank: GreenSource, frequency_hz: Float64Array) -> None:
        self._bank = bank
        self.frequency_hz = frequency_hz
        self._cached: dict[int, Complex128Array] = {}
        self._reader = RowReader(bank)
        self.actuators = bank.actuators

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators).

        Raises InputError where a row is all zeros, or holds NaN or infinity.
        """
        for row in rows.tolist():
            if row not in self._cached:
                self._cached[row] = self._read(row)
        return np.stack([self._cached[row] for row in rows.tolist()], axis=1)

    def _read(self, row: int) -> Complex128Array:
        green = self._reader.read(row)
        if not green.any():
            x, y = np.asarray(self._bank.position_mm)[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is all zeros, so not measured, but interpolation"
                " needs it; remeasure or disable the position"
            )
        return np.ascontiguousarray(transform_at(green, self.frequency_hz, self._bank.sample_rate_hz).T)
