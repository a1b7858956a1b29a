"""Grid rows whose positions show the field of neighbouring places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.verify.results import Symptom
from wavefocus.storage.point_status import Status

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.verify.comparison import FieldComparison

MIN_ERROR = 0.1
"""Median relative error from which a grid row is looked at."""
LEFT = 0.2
"""Share of the sum of squares that may be left when a shift is taken off."""
MIN_LINE, MAX_LOOKED_AT = 3, 64
SAME_LINE, SAME_PLACE = 0.1, 0.1  # grid spacings
STEPS = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)


@dataclass(frozen=True, slots=True)
class Shifts:
    """Shifts found; `row_at` gives, for a shifted bank row, the row whose response the scan shows, -1 for none."""

    symptoms: tuple[Symptom, ...] = ()
    row_at: dict[int, int] = field(default_factory=dict)

    def bank_rows(self, rows: Int64Array) -> Int64Array:
        """The bank rows whose responses positions show."""
        return np.array([self.row_at.get(row, row) for row in rows.tolist()], np.int64)


class _Neighbours:
    """Errors of compared positions against the predictions of their neighbours."""

    def __init__(self, fields: FieldComparison, bank: GreenSource, predict: Callable[[int], Complex128Array]) -> None:
        self._spectra, self._predict = fields.spectra, predict
        self.rows = fields.position_index
        self.place_mm = np.asarray(bank.position_mm, np.float64)
        grid = PositionGrid(self.place_mm)
        self.pitch_mm = np.full(2, grid.spacing_mm) if grid.lattice is None else grid.lattice.pitch_mm
        self._valid = np.flatnonzero(np.asarray(bank.status) == Status.VALID)
        self._predicted = dict(zip(self.rows.tolist(), self._spectra.predicted, strict=True))

    def shifted_rows(self, step: tuple[int, int], rows: Int64Array) -> Int64Array:
        """Bank row one step further from each, -1 where there is none."""
        from scipy.spatial import cKDTree

        wanted = self.place_mm[rows] + np.array(step) * self.pitch_mm
        apart, index = cKDTree(self.place_mm[self._valid]).query(wanted)
        return np.asarray(np.where(apart <= SAME_PLACE * self.pitch_mm.min(), self._valid[index], -1))

    def squares(self, members: Int64Array, rows: Int64Array) -> Float64Array:
        """Sum of squares, at each compared position, of the scan's difference from the prediction of a bank row."""
        difference = self._spectra.scanned[members] - self.predicted(rows)
        return np.asarray(np.square(np.abs(difference)).sum(axis=1), np.float64)

    def predicted(self, rows: Int64Array) -> Complex128Array:
        """Predicted spectra of bank rows, (rows, K)."""
        for row in set(rows.tolist()) - set(self._predicted):
            self._predicted[row] = self._predict(row)
        return np.stack([self._predicted[row] for row in rows.tolist()])

    def best_step(self, members: Int64Array) -> tuple[float, tuple[int, int] | None]:
        """The step that explains the differences of some compared positions, if one does, and the share it leaves."""
        looked_at = members[evenly_spread(len(members), MAX_LOOKED_AT)]
        own = self.squares(looked_at, self.rows[looked_at])
        best: tuple[float, tuple[int, int] | None] = (LEFT, None)
        for step in STEPS:
            rows = self.shifted_rows(step, self.rows[looked_at])
            there = rows >= 0
            if np.count_nonzero(there) < max(2, len(looked_at) / 2):
                continue
            left = float(self.squares(looked_at[there], rows[there]).sum() / own[there].sum())
            best = min(best, (left, step))
        return best


def find_shifts(fields: FieldComparison, bank: GreenSource, predict: Callable[[int], Complex128Array]) -> Shifts:
    """Find grid rows that are shifted by one step of the grid; a whole scan that is, is the mirror's error.

    predict: The predicted spectrum (K,) of a bank row, at the frequencies of ``fields.spectra``.
    """
    if len(bank.position_mm) < 2:
        return Shifts()
    neighbours = _Neighbours(fields, bank, predict)
    wrong = fields.position_error > MIN_ERROR
    if np.mean(wrong) > 0.5:
        return Shifts()
    found = Shifts()
    for axis in (1, 0):
        along = neighbours.place_mm[neighbours.rows, axis] / neighbours.pitch_mm[axis]
        for level in np.unique(np.round(along[wrong] / SAME_LINE)) * SAME_LINE:
            members = np.flatnonzero(np.abs(along - level) <= SAME_LINE)
            if len(members) >= MIN_LINE and np.mean(wrong[members]) > 0.5:
                left, step = neighbours.best_step(members)
                if step is not None:
                    shift = _shift(neighbours, members, step, left)
                    found = Shifts((*found.symptoms, *shift.symptoms), found.row_at | shift.row_at)
        if found.symptoms:
            break
    return found


def _shift(neighbours: _Neighbours, members: Int64Array, step: tuple[int, int], left: float) -> Shifts:
    rows = neighbours.rows[members]
    x_mm, y_mm = (float(part_mm) for part_mm in np.array(step) * neighbours.pitch_mm)
    shown = neighbours.shifted_rows(step, rows)
    distance_mm, positions = float(np.hypot(x_mm, y_mm)), tuple(rows.tolist())
    symptom = Symptom("shifted", (), distance_mm, 1.0 - left, positions=positions, shift_mm=(x_mm, y_mm))
    return Shifts((symptom,), dict(zip(rows.tolist(), shown.tolist(), strict=True)))
