"""The rows that a scene visits: read, judged and regularised, each when it is first asked for."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from config.scene import Regularisation
from rendering.greens.regularisation import RowWeights, row_weights, saturation_threshold
from rendering.greens.row_scaling import ScaledRow, scale_row
from rendering.greens.source import GreenSource, fetch_row, refusal
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

PLAIN_EXPONENT = 300
"""Drives within 2**300 of 1 are accumulated as they are."""


class BankRows:
    """The rows that a scene visits, read, judged and regularised."""

    needed_by: Callable[[int, Float64Array], str]
    """Source and path point that need a row at a place, for a message."""

    def __init__(self, bank: GreenSource, regularisation: Regularisation) -> None:
        self.bank = bank
        self.needed_by = lambda row, at_mm: "the scene"
        self.status = np.asarray(bank.status)
        self._position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        # Rows that an interpolation adds say nothing of the bank's median.
        measured: GreenSource = getattr(bank, "measured", bank)
        self.threshold = saturation_threshold(regularisation, measured)
        self._normalise = regularisation.normalise
        self._weights: dict[int, RowWeights] = {}
        self._exponent: dict[int, int] = {}
        self._drive_exponent: int | None = None
        # Files are read by one thread at a time.
        self._reading = threading.Lock()
        self._loud = np.zeros(bank.actuators, dtype=bool)

    @property
    def used(self) -> list[int]:
        """Rows read so far, in ascending order."""
        return sorted(self._weights)

    @property
    def silent_actuators(self) -> list[int]:
        """Actuators whose Green's functions are zero in every row read so far."""
        return [int(actuator) for actuator in np.flatnonzero(~self._loud)] if self._weights else []

    def read(self, row: int, *, single: bool = False) -> ScaledRow:
        """Read a row. Raises InputError where it may not be used, saying which path point needs it.

        Several threads may read. With `single` the values are float32.
        """
        reason = refusal(int(self.status[row]))
        scaled = None
        if not reason:
            with self._reading:
                raw = fetch_row(self.bank, row)
            scaled = scale_row(raw, row)
        if scaled is None or scaled.silent:
            x, y = self._position_mm[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is {reason or 'all zeros, so not measured'}, but"
                f" {self.needed_by(row, self._position_mm[row])} needs it; remeasure the position or move"
                " the path"
            )
        if row not in self._weights:
            self._loud |= scaled.values.any(axis=1)
            self._exponent[row] = scaled.exponent
            self._weights[row] = row_weights(scaled, self.threshold, normalise=self._normalise)
        return scaled.rounded() if single else scaled

    def sigma(self, regularised_by: int) -> Float64Array | None:
        """Saturation factors (actuators,) of a row, None where all are 1."""
        return self._known(regularised_by).sigma

    def weigh(
        self, rows: Int64Array, regularised_by: Int64Array, exponent: int = 0
    ) -> tuple[Float64Array, NDArray[np.bool_]]:
        """Weights of rows, each regularised by another or by itself.

        rows, regularised_by, int64 (k,): Bank rows.
        exponent: The factors are divided by 2**exponent.

        Returns factors : float64 (k,): n(regularised_by) times the scale of the row, over 2**(drive_exponent +
        exponent); saturated : bool (k,): where `sigma` is not None.
        """
        factors, saturated = np.empty(len(rows)), np.empty(len(rows), dtype=bool)
        for place, (row, by) in enumerate(zip(rows.tolist(), regularised_by.tolist(), strict=True)):
            weights = self._known(by)
            self._known(row)
            power = weights.gain_exponent + self._exponent[row]
            if self._drive_exponent is None:
                self._drive_exponent = power if abs(power) > PLAIN_EXPONENT else 0
            try:
                factors[place] = math.ldexp(weights.gain, power - self._drive_exponent - exponent)
            except OverflowError:
                factors[place] = np.inf
            saturated[place] = weights.sigma is not None
        return factors, saturated

    @property
    def drive_exponent(self) -> int:
        """Power of two that the drives are still to be multiplied with.

        It keeps a bank of tiny numbers from being accumulated in denormals, which are slow and inexact.
        """
        return self._drive_exponent or 0

    def _known(self, row: int) -> RowWeights:
        if row not in self._weights:
            self.read(row)
        return self._weights[row]
