"""Grid rows, or whole scans, whose positions show the field of neighbouring places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.field.focus_figures import evenly
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.verify.results import Symptom
from wavefocus.storage.point_status import Status

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.verify.comparison import FieldComparison

LEAST_ERROR = 0.1
"""Median relative error from which a grid row is looked at."""
LEFT = 0.2
"""Share of the sum of squares that may be left when a shift is taken off."""
LEAST_LINE, MOST_LOOKED_AT = 3, 64
SAME_LINE, SAME_PLACE = 0.1, 0.1  # grid spacings
FRACTIONS = tuple(np.linspace(-1.0, 1.0, 9).tolist())
STEPS = tuple((x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y)


@dataclass(frozen=True, slots=True)
class Shifts:
    """Shifts found; `row_at` gives, for a shifted bank row, the row whose response the scan shows, -1 for none.

    whole: All positions are shifted alike.
    between: And by less than a step of the grid, so that no row has their responses.
    """

    symptoms: tuple[Symptom, ...] = ()
    row_at: dict[int, int] = field(default_factory=dict)
    whole: bool = False
    between: bool = False

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
        looked_at = members[evenly(len(members), MOST_LOOKED_AT)]
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

    def best_fraction(self, members: Int64Array) -> tuple[float, tuple[float, float] | None]:
        """The same for parts of a step in x and y; fields between positions are quadratic."""
        looked_at = members[evenly(len(members), MOST_LOOKED_AT)]
        steps = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]
        rows = np.stack([self.shifted_rows(step, self.rows[looked_at]) for step in steps])
        inner = (rows >= 0).all(axis=0)
        if np.count_nonzero(inner) < LEAST_LINE:
            return LEFT, None
        around = np.stack([self.predicted(of_step) for of_step in rows[:, inner]])
        scanned = self._spectra.scanned[looked_at[inner]]
        own = np.square(np.abs(scanned - around[len(steps) // 2])).sum()
        best: tuple[float, tuple[float, float] | None] = (LEFT, None)
        for x in FRACTIONS:
            for y in FRACTIONS:
                field_there = np.tensordot(np.outer(_quadratic(x), _quadratic(y)).ravel(), around, axes=1)
                best = min(best, (float(np.square(np.abs(scanned - field_there)).sum() / own), (x, y)))
        return best


def _quadratic(place: float) -> Float64Array:
    """Weights of the values at -1, 0 and 1 for the value at a place between."""
    return np.array([0.5 * place * (place - 1.0), 1.0 - place**2, 0.5 * place * (place + 1.0)])


def find_shifts(fields: FieldComparison, bank: GreenSource, predict: Callable[[int], Complex128Array]) -> Shifts:
    """Find grid rows that are shifted by one step of the grid, or a whole scan that is.

    predict: The predicted spectrum (K,) of a bank row, at the frequencies of ``fields.spectra``.
    """
    if len(bank.position_mm) < 2:
        return Shifts()
    neighbours = _Neighbours(fields, bank, predict)
    everything = np.arange(len(neighbours.rows))
    wrong = fields.position_error > LEAST_ERROR
    if np.mean(wrong) > 0.5:
        left, step = neighbours.best_step(everything)
        if step is not None:
            return _shift(neighbours, everything, step, left, whole=True)
        left, part = neighbours.best_fraction(everything)
        if part is None:
            return Shifts()
        x_mm, y_mm = (float(one) for one in np.array(part) * neighbours.pitch_mm)
        symptom = Symptom("shifted", (), float(np.hypot(x_mm, y_mm)), 1.0 - left, shift_mm=(x_mm, y_mm))
        return Shifts((symptom,), {}, between=True)
    found = Shifts()
    for axis in (1, 0):
        along = neighbours.place_mm[neighbours.rows, axis] / neighbours.pitch_mm[axis]
        for level in np.unique(np.round(along[wrong] / SAME_LINE)) * SAME_LINE:
            members = np.flatnonzero(np.abs(along - level) <= SAME_LINE)
            if len(members) >= LEAST_LINE and np.mean(wrong[members]) > 0.5:
                left, step = neighbours.best_step(members)
                if step is not None:
                    one = _shift(neighbours, members, step, left, whole=False)
                    found = Shifts((*found.symptoms, *one.symptoms), found.row_at | one.row_at)
        if found.symptoms:
            break
    return found


def _shift(neighbours: _Neighbours, members: Int64Array, step: tuple[int, int], left: float, *, whole: bool) -> Shifts:
    rows = neighbours.rows[members]
    x_mm, y_mm = (float(one) for one in np.array(step) * neighbours.pitch_mm)
    shown = neighbours.shifted_rows(step, rows)
    positions = () if whole else tuple(rows.tolist())
    symptom = Symptom(
        "shifted", (), float(np.hypot(x_mm, y_mm)), 1.0 - left, positions=positions, shift_mm=(x_mm, y_mm)
    )
    return Shifts((symptom,), dict(zip(rows.tolist(), shown.tolist(), strict=True)), whole)
