"""Interpolation from the grid's positions only: nearest and bilinear."""

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import SLACK, GridInterpolation, Nodes, OffGridError, near, show_mm
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.storage.errors import InputError


class Nearest(GridInterpolation):
    """The row of smallest distance, the lower index on a tie."""

    name = "nearest"

    def nodes(self, points_mm: Float64Array) -> Nodes:
        rows, distance_mm = near(self.grid, points_mm)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), rows, distance_mm)


class Bilinear(GridInterpolation):
    """The four corners of the grid cell around a point, weighted by area; on a lattice, which may have holes.

    Raises InputError where the positions do not lie on such a lattice, or all on one line.
    """

    name = "bilinear"

    def __init__(self, grid: PositionGrid) -> None:
        super().__init__(grid)
        position, refused = grid.position_mm, "interpolation is 'bilinear', but"
        for axis in (0, 1):
            if not np.ptp(position[:, axis]) > 0:
                same = f"all positions have the same {'xy'[axis]}; it needs a grid in two directions"
                raise InputError(f"{refused} {same}")
        if grid.lattice is None:
            row = grid.off_lattice_row
            raise InputError(
                f"{refused} position {row} at {show_mm(position[row])} mm lies off a regular lattice; use 'nearest' or"
                " 'kernel'"
            )
        self._lattice = grid.lattice
        self._row_at = grid.lattice.row_at

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, distance_mm = near(self.grid, points_mm)
        cell, part, outside = self._cells(points_mm)
        (x, y), (column, line) = part, cell
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]).T
        rows = np.stack([self._row_at[column + right, line + up] for up in (0, 1) for right in (0, 1)]).T
        wrong = outside | ((rows < 0) & (weights > 0)).any(axis=1)
        if wrong.any():
            point = int(np.argmax(wrong))
            raise OffGridError(
                point,
                f"lies at {show_mm(points_mm[point])} mm, in a grid cell that lacks a corner; bilinear interpolation"
                " needs all four",
            )
        return Nodes(np.maximum(rows, 0), weights, nearest, distance_mm)

    def _cells(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array, BoolArray]:
        """Cells of points, (2, n), their places in the cells from 0 to 1, and whether they lie outside all cells."""
        # Axis by axis: there may be very many points, and numpy is slow along an axis of two.
        cell, part = np.empty((2, len(points_mm)), dtype=np.int64), np.empty((2, len(points_mm)))
        outside = np.zeros(len(points_mm), dtype=bool)
        for axis in (0, 1):
            site = (points_mm[:, axis] - self._lattice.origin_mm[axis]) / self._lattice.pitch_mm[axis]
            cell[axis] = np.clip(np.floor(site).astype(np.int64), 0, self._row_at.shape[axis] - 2)
            beyond = site - cell[axis]
            outside |= (beyond < -SLACK) | (beyond > 1.0 + SLACK)
            within = np.clip(beyond, 0.0, 1.0, out=part[axis])
            within[within < SLACK] = 0.0
            within[within > 1.0 - SLACK] = 1.0
        return cell, part, outside
