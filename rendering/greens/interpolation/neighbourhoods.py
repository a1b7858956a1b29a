"""Measured positions that a point of the surface is interpolated from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendering.arrays import BoolArray, Float64Array, Int64Array
from rendering.greens.interpolation.position_grid import PositionGrid
from storage.errors import InputError

NEIGHBOURS = 36
"""Whole rings about a position, on a square and on a hexagonal grid alike."""
LEAST_NEIGHBOURS = 8
REACH_SPACINGS = 8.0
"""Positions further than this, in grid spacings, are no neighbours: the waves there say little of those here."""
SAME_SPACINGS = 1e-3
"""Positions nearer to one another than about this, in grid spacings, count once."""
THIN = 1e-3
"""Positions whose extent across is this part of that along lie on a line."""


class SparseError(InputError):
    """A position has too few neighbours, or all of them on one line."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A position and its neighbours.

    rows, int64 (n,): Bank rows, that of the position itself first, then by distance and direction.
    offset_mm, float64 (n, 2): Places relative to the position; the first is (0, 0).
    key: Equal for patches of equal shape, for which everything but the rows is the same.
    """

    rows: Int64Array
    offset_mm: Float64Array
    key: bytes


class Neighbourhoods:
    """The positions of a bank that may be interpolated from.

    position_mm, float64 (positions, 2): Grid in millimetres: square, hexagonal or irregular, with holes and repeated
        positions.
    allowed, bool (positions,): Rows that may be used; the others are holes.

    Raises InputError: no two of the positions are apart, or all lie on one line.
    """

    spacing_mm: float
    """Median distance of neighbouring positions."""

    def __init__(self, position_mm: Float64Array, allowed: BoolArray) -> None:
        rows = np.flatnonzero(allowed)
        if not len(rows):
            raise InputError("interpolation is 'kernel', but no position of the bank was measured well; use 'nearest'")
        spacing_mm = PositionGrid(position_mm[rows]).spacing_mm
        if spacing_mm > 0:
            _, first = np.unique(np.rint(position_mm[rows] / (SAME_SPACINGS * spacing_mm)), axis=0, return_index=True)
            rows = rows[np.sort(first)]
            spacing_mm = PositionGrid(position_mm[rows]).spacing_mm
        if len(rows) < LEAST_NEIGHBOURS or _on_a_line(position_mm[rows]):
            raise InputError(
                f"interpolation is 'kernel', but the {len(rows)} measured positions are too few or lie on one line;"
                f" it needs at least {LEAST_NEIGHBOURS}, spread in two directions; use 'nearest'"
            )
        self.spacing_mm = spacing_mm
        self._rows: Int64Array = rows.astype(np.int64)
        self._position_mm = position_mm[rows]
        from scipy.spatial import cKDTree  # slow to load

        self._tree = cKDTree(self._position_mm)
        self._patches: dict[int, Patch] = {}

    def nearest(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Row of the position nearest to each point, and the distance in millimetres."""
        distance, index = self._tree.query(points_mm)
        return self._rows[index], np.asarray(distance, dtype=np.float64)

    def position_of(self, row: int) -> Float64Array:
        """Place of a row that may be used, float64 (2,) in millimetres."""
        return np.asarray(self._position_mm[np.searchsorted(self._rows, row)])

    def some_rows(self, most: int) -> list[int]:
        """At most so many of the rows, evenly chosen."""
        chosen = np.unique(np.linspace(0, len(self._rows) - 1, min(most, len(self._rows))).astype(np.int64))
        return [int(row) for row in self._rows[chosen]]

    def patch(self, row: int) -> Patch:
        """The patch around a row that may be used.

        Raises SparseError: too few positions are near, or all are on one line.
        """
        if row not in self._patches:
            self._patches[row] = self._make(row)
        return self._patches[row]

    def _make(self, row: int) -> Patch:
        centre_mm = self.position_of(row)
        # A few more than needed: where several are equally far, those that count are chosen by direction.
        wanted = min(2 * NEIGHBOURS, len(self._rows))
        found = self._tree.query(centre_mm[None], k=wanted)
        distance, index = np.asarray(found[0])[0], np.asarray(found[1])[0]
        near = distance <= REACH_SPACINGS * self.spacing_mm
        index, offset_mm = index[near], self._position_mm[index[near]] - centre_mm
        fine = np.rint(offset_mm / (SAME_SPACINGS * self.spacing_mm))
        ring = np.rint(distance[near] / (SAME_SPACINGS * self.spacing_mm))
        chosen = np.lexsort((np.round(np.arctan2(fine[:, 1], fine[:, 0]), 6), ring))[: NEIGHBOURS + 1]
        offset_mm = offset_mm[chosen]
        if len(chosen) <= LEAST_NEIGHBOURS or _on_a_line(offset_mm):
            reach_mm = REACH_SPACINGS * self.spacing_mm
            raise SparseError(
                f"position {row} at ({centre_mm[0]:.6g}, {centre_mm[1]:.6g}) mm has {len(chosen) - 1} measured"
                f" neighbours within {reach_mm:.3g} mm; kernel interpolation needs at least {LEAST_NEIGHBOURS},"
                " spread in two directions"
            )
        # Shape to a tenth of what counts as the same place: rounding in a file must not make each patch unique.
        key = np.rint(offset_mm / (0.1 * SAME_SPACINGS * self.spacing_mm)).astype(np.int64).tobytes()
        return Patch(self._rows[index[chosen]], offset_mm, key)


def _on_a_line(points_mm: Float64Array) -> bool:
    extent = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(len(extent) < 2 or extent[1] <= THIN * extent[0])
