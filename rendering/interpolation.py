"""The bank between its grid positions: which rows a point is made of, and by how much.

A kind of interpolation is anything with `nodes(points_mm)`. Weights are real and the same for all actuators
and frequencies; a kind whose weights depend on frequency (kernel regression) gives rows of its own, nodes of
a finer grid, whose spectra the accumulator asks for by number like those of the bank.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.errors import InputError
from rendering.snapping import PositionGrid

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

KINDS = ("nearest", "bilinear")
SLACK = 1e-9
"""Rounding that is forgiven, relative to the grid spacing."""


@dataclass(frozen=True, slots=True)
class Nodes:
    """What the points of a path are made of.

    Parameters
    ----------
    rows : int64 array, shape (n, k)
        Bank rows of each point.
    weights : float64 array, shape (n, k)
        Their weights; they sum to 1. A weight of 0 means that the row is not used.
    nearest : int64 array, shape (n,)
        Nearest row of each point: its regularisation is used, and it is the focus that is reported.
    distance_mm : float64 array, shape (n,)
        Distance to the nearest row.
    """

    rows: Int64Array
    weights: Float64Array
    nearest: Int64Array
    distance_mm: Float64Array


class OffGridError(InputError):
    """A point lies where the bank says nothing; `point` is its index in the list that was asked for."""

    def __init__(self, point: int, message: str) -> None:
        super().__init__(message)
        self.point = point


class Interpolation(Protocol):
    """A kind of interpolation over one grid."""

    grid: PositionGrid

    def nodes(self, points_mm: Float64Array) -> Nodes:
        """Rows and weights of points, float64 (n, 2). Raises OffGridError."""
        ...


def interpolation(kind: str, grid: PositionGrid) -> Interpolation:
    """Make the interpolation that a scene names.

    Parameters
    ----------
    kind : {"nearest", "bilinear"}
        The kind.
    grid : PositionGrid
        The bank's grid.

    Raises
    ------
    InputError
        The kind is unknown, or the grid does not allow it.
    """
    if kind == "nearest":
        return NearestRow(grid)
    if kind == "bilinear":
        return Bilinear(grid)
    raise InputError(f"interpolation is {kind!r}; allowed are {', '.join(KINDS)}")


class NearestRow:
    """The row of smallest distance, the lower index on a tie."""

    def __init__(self, grid: PositionGrid) -> None:
        self.grid = grid

    def nodes(self, points_mm: Float64Array) -> Nodes:
        rows, distance_mm = _near(self.grid, points_mm)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), rows, distance_mm)


class Bilinear:
    """The four corners of the grid cell around a point, weighted by area.

    Parameters
    ----------
    grid : PositionGrid
        Positions on a lattice along x and y; it need not be full.

    Raises
    ------
    InputError
        The positions do not lie on such a lattice, or all on one line.
    """

    def __init__(self, grid: PositionGrid) -> None:
        self.grid = grid
        slack = max(grid.spacing_mm * 1e-6, 1e-12)
        position = grid.position_mm
        self._origin = position.min(axis=0)
        self._pitch = np.array([_pitch(position[:, axis], slack, "xy"[axis]) for axis in (0, 1)])
        lattice = (position - self._origin) / self._pitch
        cell = np.rint(lattice).astype(np.int64)
        if np.abs((lattice - cell) * self._pitch).max() > slack:
            row = int(np.argmax(np.abs((lattice - cell) * self._pitch).max(axis=1)))
            raise InputError(
                f"interpolation is 'bilinear', but position {row} at {_show(position[row])} mm lies off a"
                " regular"
                f" lattice of {self._pitch[0]:g} x {self._pitch[1]:g} mm; use 'nearest'"
            )
        self._shape = cell.max(axis=0) + 1
        if int(np.prod(self._shape)) > 100 * len(position) + 10_000:
            raise InputError("interpolation is 'bilinear', but the grid is not regular; use 'nearest'")
        self._row_at = np.full(tuple(self._shape), len(cell), dtype=np.int64)
        np.minimum.at(self._row_at, (cell[:, 0], cell[:, 1]), np.arange(len(cell)))
        self._row_at[self._row_at == len(cell)] = -1

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, distance_mm = _near(self.grid, points_mm)
        lattice = (points_mm - self._origin) / self._pitch
        cell = np.clip(np.floor(lattice).astype(np.int64), 0, self._shape - 2)
        part = lattice - cell
        outside = ((part < -SLACK) | (part > 1.0 + SLACK)).any(axis=1)
        part = np.clip(part, 0.0, 1.0)
        part[part < SLACK] = 0.0
        part[part > 1.0 - SLACK] = 1.0
        x, y = part[:, 0], part[:, 1]
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
        rows = np.stack(
            [self._row_at[cell[:, 0] + right, cell[:, 1] + up] for up in (0, 1) for right in (0, 1)], axis=1
        )
        wrong = outside | ((rows < 0) & (weights > 0)).any(axis=1)
        if wrong.any():
            point = int(np.argmax(wrong))
            raise OffGridError(
                point,
                f"lies at {_show(points_mm[point])} mm, in a grid cell that lacks a corner; bilinear"
                " interpolation"
                " needs all four",
            )
        return Nodes(np.maximum(rows, 0), weights, nearest, distance_mm)


def _near(grid: PositionGrid, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
    rows, distance_mm = grid.nearest(points_mm)
    far = distance_mm > grid.spacing_mm * (1.0 + SLACK) + 1e-9
    if far.any():
        point = int(np.argmax(far))
        row = int(rows[point])
        raise OffGridError(
            point,
            f"lies at {_show(points_mm[point])} mm, {distance_mm[point]:.3g} mm from the nearest position"
            f" ({row} at"
            f" {_show(grid.position_mm[row])} mm); at most one grid spacing, {grid.spacing_mm:.3g} mm, is"
            " allowed",
        )
    return rows, distance_mm


def _pitch(values: Float64Array, slack: float, axis: str) -> float:
    steps = np.diff(np.unique(values))
    steps = steps[steps > slack]
    if not len(steps):
        raise InputError(
            f"interpolation is 'bilinear', but all positions have the same {axis}; it needs a grid in two directions"
        )
    return float((values.max() - values.min()) / max(round((values.max() - values.min()) / steps.min()), 1))


def _show(point_mm: Float64Array) -> str:
    return f"({point_mm[0]:.6g}, {point_mm[1]:.6g})"
