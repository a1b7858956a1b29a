"""The rows that a scene visits: read, judged and regularised, each when it is first asked for."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.greens.regularisation import RowWeights, green_energies, row_weights, saturation_threshold, weights_of
from rendering.greens.row_scaling import RawRow, RealArray, ScaledRow, look_at_rows, scale_row, scale_together
from rendering.greens.source import GreenSource, fetch_row, refusal
from rendering.inner_loops import InnerLoops
from rendering.scene.model import Regularisation
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

PLAIN_EXPONENT = 300
"""Drives within 2**300 of 1 are accumulated as they are."""


class BankRows:
    """The rows that a scene visits, read, judged and regularised.

    Parameters
    ----------
    bank : GreenSource
        Where they come from.
    regularisation : Regularisation
        Saturation and normalisation.
    """

    needed_by: Callable[[int, Float64Array], str]
    """Tells, for a message, which source and path point needs a row at a place."""

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

    def knows(self, row: int) -> bool:
        """Whether a row was read before, so that its weights are known."""
        return row in self._weights

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
            raw = self._fetch(row)
            # Weights are those of the row as it is, not as it is rounded.
            rounded = single and (raw.dtype == np.float32 or row in self._weights)
            scaled = scale_row(raw, row, single=rounded)
        if scaled is None or scaled.silent:
            x, y = self._position_mm[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is {reason or 'all zeros, so not measured'}, but"
                f" {self.needed_by(row, self._position_mm[row])} needs it; remeasure the position or move"
                " the path"
            )
        if row not in self._weights:
            self._know(row, scaled)
        return scaled.rounded() if single and scaled.values.dtype != np.float32 else scaled

    def read_together(self, rows: Sequence[int], out: RealArray) -> None:
        """Read some rows side by side, in few steps for all of them; otherwise as `read` does.

        Parameters
        ----------
        rows : sequence of int
            Bank rows, none twice.
        out : float32 or float64 array, shape (rows, actuators, taps)
            Where the scaled values go, however it lies.
        """
        if not any(refusal(int(self.status[row])) for row in rows):
            exponents = scale_together([self._fetch(row) for row in rows], out)
            if exponents is not None:
                self._learn(rows, out, exponents)
                return
        for place, row in enumerate(rows):
            out[place] = self.read(row, single=out.dtype == np.float32).values

    def look_together(self, rows: Sequence[int], used_taps: int, loops: InnerLoops) -> list[RawRow] | None:
        """Read some rows for compiled loops to scale; None where one needs `read`.

        Parameters
        ----------
        rows : sequence of int
            Bank rows, none twice.
        used_taps : int
            How many taps, from the first, are used.
        loops : InnerLoops
            The loops.
        """
        if any(refusal(int(self.status[row])) for row in rows):
            return None
        found = look_at_rows([self._fetch(row) for row in rows], used_taps, loops)
        if found is None:
            return None
        new = [(row, raw) for row, raw in zip(rows, found, strict=True) if row not in self._weights]
        if new:
            energies = np.array([raw.energies for _, raw in new]).sum(axis=1)
            self._loud |= (energies > 0).any(axis=0)
            exponents = [raw.exponent for _, raw in new]
            weights = weights_of(energies, self.bank.taps, exponents, self.threshold, normalise=self._normalise)
            for (row, raw), weight in zip(new, weights, strict=True):
                self._exponent[row], self._weights[row] = raw.exponent, weight
        return found

    def _fetch(self, row: int) -> NDArray[Any]:
        with self._reading:
            return fetch_row(self.bank, row)

    def _learn(self, rows: Sequence[int], values: RealArray, exponents: Int64Array) -> None:
        """Find the weights of rows that were scaled together."""
        new = [place for place, row in enumerate(rows) if row not in self._weights]
        if not new:
            return
        found = green_energies(values if len(new) == len(rows) else values[new])
        for place, energies in zip(new, found, strict=True):
            self._know(rows[place], ScaledRow(values[place], int(exponents[place])), energies)

    def _know(self, row: int, scaled: ScaledRow, energies: Float64Array | None = None) -> None:
        if not self._loud.all():
            self._loud |= scaled.values.any(axis=1)
        self._exponent[row] = scaled.exponent
        self._weights[row] = row_weights(scaled, self.threshold, normalise=self._normalise, energies=energies)

    def norm_of(self, rows: Int64Array) -> Float64Array:
        """Norms of scaled rows that were read, over all actuators and taps."""
        return np.array([self._weights[row].norm for row in rows.tolist()])

    def sigma(self, regularised_by: int) -> Float64Array | None:
        """Saturation factors (actuators,) of a row, None where all are 1."""
        return self._known(regularised_by).sigma

    def weigh(
        self, rows: Int64Array, regularised_by: Int64Array, exponent: int = 0
    ) -> tuple[Float64Array, NDArray[np.bool_]]:
        """Weights of rows, each regularised by another or by itself.

        Parameters
        ----------
        rows, regularised_by : int64 array, shape (k,)
            Bank rows.
        exponent : int
            The factors are divided by 2**exponent.

        Returns
        -------
        factors : float64 array, shape (k,)
            n(regularised_by) times the scale of the row, over 2**(drive_exponent + exponent).
        saturated : bool array, shape (k,)
            Where `sigma` is not None.
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
