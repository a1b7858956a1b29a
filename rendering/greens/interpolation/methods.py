"""The bank between its grid positions: which rows a point is made of, and by how much.

A kind of interpolation is anything with `nodes(points_mm)`. Weights are real and the same for all actuators
and frequencies; a kind whose weights depend on frequency (kernel regression) makes rows of its own, places
along the path, that the accumulator asks for by number like those of the bank.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rendering.greens.interpolation.position_grid import PositionGrid
from rendering.greens.source import GreenSource
from rendering.scene.paths import Path
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

GRID_KINDS = ("nearest", "bilinear", "bicubic")
KINDS = (*GRID_KINDS, "kernel")
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


Follow = Callable[[Float64Array], Nodes]
"""Nodes at arc lengths along a path, float64 (n,) in millimetres."""


class Interpolation(Protocol):
    """A kind of interpolation over one bank."""

    def nodes(self, points_mm: Float64Array) -> Nodes:
        """Rows and weights of points, float64 (n, 2). Raises OffGridError."""
        ...

    def follow(self, path: Path, arc_length_mm: Float64Array | None = None) -> Follow:
        """Prepare for a path, which must be done before rows are read.

        Parameters
        ----------
        path : Path
            The path.
        arc_length_mm : float64 array, shape (n,), optional
            The only arc lengths that will be asked about; by default any may be.

        Raises
        ------
        OffGridError
            The path leaves the grid, as far as that is found now.
        """
        ...

    def rows_of(self, bank: GreenSource) -> GreenSource:
        """The bank whose rows `nodes` names: `bank`, with rows added to it where the kind makes its own."""
        ...


def interpolation(kind: str, grid: PositionGrid) -> Interpolation:
    """Make an interpolation that needs the grid alone.

    Parameters
    ----------
    kind : {"nearest", "bilinear", "bicubic"}
        The kind.
    grid : PositionGrid
        The bank's grid.

    Raises
    ------
    InputError
        The kind is unknown or needs more than the grid, or the grid does not allow it.
    """
    if kind == "nearest":
        return NearestRow(grid)
    if kind == "bilinear":
        return Bilinear(grid)
    if kind == "bicubic":
        return Bicubic(grid)
    raise InputError(f"interpolation is {kind!r}; allowed are {', '.join(KINDS)}")


class GridInterpolation(ABC):
    """A kind whose nodes are rows of the bank, and depend on the point alone.

    Parameters
    ----------
    grid : PositionGrid
        The bank's grid.
    """

    def __init__(self, grid: PositionGrid) -> None:
        self.grid = grid

    @abstractmethod
    def nodes(self, points_mm: Float64Array) -> Nodes:
        """Rows and weights of points, float64 (n, 2). Raises OffGridError."""

    def follow(self, path: Path, arc_length_mm: Float64Array | None = None) -> Follow:
        return lambda along: self.nodes(path.point_at(along))

    def rows_of(self, bank: GreenSource) -> GreenSource:
        return bank


class NearestRow(GridInterpolation):
    """The row of smallest distance, the lower index on a tie."""

    def nodes(self, points_mm: Float64Array) -> Nodes:
        rows, distance_mm = near(self.grid, points_mm)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), rows, distance_mm)


class _OnLattice(GridInterpolation):
    """A kind that needs positions on a lattice along x and y; it need not be full.

    Parameters
    ----------
    grid : PositionGrid
        The bank's grid.

    Raises
    ------
    InputError
        The positions do not lie on such a lattice, or all on one line.
    """

    kind: str

    def __init__(self, grid: PositionGrid) -> None:
        super().__init__(grid)
        slack = max(grid.spacing_mm * 1e-6, 1e-12)
        position = grid.position_mm
        self._origin = position.min(axis=0)
        self._pitch = np.array([self._axis_pitch(position[:, axis], slack, "xy"[axis]) for axis in (0, 1)])
        lattice = (position - self._origin) / self._pitch
        cell = np.rint(lattice).astype(np.int64)
        if np.abs((lattice - cell) * self._pitch).max() > slack:
            row = int(np.argmax(np.abs((lattice - cell) * self._pitch).max(axis=1)))
            raise InputError(
                f"interpolation is {self.kind!r}, but position {row} at {show_mm(position[row])} mm lies off a"
                f" regular lattice of {self._pitch[0]:g} x {self._pitch[1]:g} mm; use 'nearest' or 'kernel'"
            )
        self._shape = cell.max(axis=0) + 1
        if int(np.prod(self._shape)) > 100 * len(position) + 10_000:
            raise InputError(f"interpolation is {self.kind!r}, but the grid is not regular; use 'nearest' or 'kernel'")
        self._row_at = np.full(tuple(self._shape), len(cell), dtype=np.int64)
        np.minimum.at(self._row_at, (cell[:, 0], cell[:, 1]), np.arange(len(cell)))
        self._row_at[self._row_at == len(cell)] = -1

    def _axis_pitch(self, values: Float64Array, slack: float, axis: str) -> float:
        steps = np.diff(np.unique(values))
        steps = steps[steps > slack]
        if not len(steps):
            raise InputError(
                f"interpolation is {self.kind!r}, but all positions have the same {axis}; it needs a grid in two"
                " directions"
            )
        return float((values.max() - values.min()) / max(round((values.max() - values.min()) / steps.min()), 1))

    def _cells(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array, NDArray[np.bool_]]:
        """Cell of each point, its place in the cell from 0 to 1, and whether it lies outside all cells."""
        # Axis by axis: there may be very many points, and numpy is slow along an axis of two.
        cell, part = np.empty((2, len(points_mm)), dtype=np.int64), np.empty((2, len(points_mm)))
        outside = np.zeros(len(points_mm), dtype=bool)
        for axis in (0, 1):
            lattice = (points_mm[:, axis] - self._origin[axis]) / self._pitch[axis]
            cell[axis] = np.clip(np.floor(lattice).astype(np.int64), 0, self._shape[axis] - 2)
            beyond = np.subtract(lattice, cell[axis], out=lattice)
            outside |= (beyond < -SLACK) | (beyond > 1.0 + SLACK)
            within = np.clip(beyond, 0.0, 1.0, out=part[axis])
            within[within < SLACK] = 0.0
            within[within > 1.0 - SLACK] = 1.0
        return cell.T, part.T, outside

    def _corners(
        self, cell: Int64Array, part: Float64Array, outside: NDArray[np.bool_], points_mm: Float64Array
    ) -> tuple[Int64Array, Float64Array]:
        """Rows and weights of bilinear interpolation, (n, 4) each. Raises OffGridError where a corner is missing."""
        x, y = part[:, 0], part[:, 1]
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]).T
        lines = self._row_at.shape[1]
        corner, row_at = cell[:, 0] * lines + cell[:, 1], self._row_at.ravel()
        rows = np.stack([row_at[corner + right * lines + up] for up in (0, 1) for right in (0, 1)]).T
        wrong = outside | ((rows < 0) & (weights > 0)).any(axis=1)
        if wrong.any():
            point = int(np.argmax(wrong))
            raise OffGridError(
                point,
                f"lies at {show_mm(points_mm[point])} mm, in a grid cell that lacks a corner; {self.kind}"
                " interpolation needs all four",
            )
        return np.maximum(rows, 0), weights


class Bilinear(_OnLattice):
    """The four corners of the grid cell around a point, weighted by area."""

    kind = "bilinear"

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, distance_mm = near(self.grid, points_mm)
        rows, weights = self._corners(*self._cells(points_mm), points_mm)
        return Nodes(rows, weights, nearest, distance_mm)


class Bicubic(_OnLattice):
    """Cubic along x and y through the 4 x 4 positions around a point (Lagrange's polynomial).

    Where a row or column of them is missing at the rim, the polynomial goes through the three that are left,
    or through the cell's two; where a position within them is missing, the cell's four corners count alone.
    """

    kind = "bicubic"

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, distance_mm = near(self.grid, points_mm)
        cell, part, outside = self._cells(points_mm)
        corner_rows, corner_weights = self._corners(cell, part, outside, points_mm)
        before, after = self._there(cell - 1), self._there(cell + 2)
        along = np.stack([_lagrange(part[:, axis], before[:, axis], after[:, axis]) for axis in (0, 1)])
        weights = (along[1][:, :, None] * along[0][:, None, :]).reshape(-1, 16)
        step = np.arange(-1, 3)
        column = np.clip(cell[:, None, 0] + step, 0, self._shape[0] - 1)
        line = np.clip(cell[:, None, 1] + step, 0, self._shape[1] - 1)
        rows = self._row_at[column[:, None, :], line[:, :, None]].reshape(-1, 16)
        holed = ((rows < 0) & (weights != 0)).any(axis=1)
        rows = np.maximum(rows, 0)
        rows[holed, :4], weights[holed] = corner_rows[holed], 0.0
        weights[holed, :4] = corner_weights[holed]
        return Nodes(rows, weights, nearest, distance_mm)

    def _there(self, index: Int64Array) -> NDArray[np.bool_]:
        return np.asarray((index >= 0) & (index < self._shape))


def _lagrange(part: Float64Array, before: NDArray[np.bool_], after: NDArray[np.bool_]) -> Float64Array:
    """Weights (n, 4) of the values at -1, 0, 1, 2 for places between 0 and 1; 0 where a value is not there."""
    at = np.arange(-1.0, 3.0)
    there = np.stack([before, np.ones_like(before), np.ones_like(before), after], axis=1)
    weights = there.astype(np.float64)
    for place in range(4):
        for other in range(4):
            if other != place:
                factor = (part - at[other]) / (at[place] - at[other])
                weights[:, place] *= np.where(there[:, other], factor, 1.0)
    return weights


def near(grid: PositionGrid, points_mm: Float64Array, spacings: float = 1.0) -> tuple[Int64Array, Float64Array]:
    """Nearest rows and distances. Raises OffGridError for a point further than some grid spacings from all."""
    rows, distance_mm = grid.nearest(points_mm)
    allowed_mm = spacings * grid.spacing_mm
    far = distance_mm > allowed_mm * (1.0 + SLACK) + 1e-9
    if far.any():
        point = int(np.argmax(far))
        row = int(rows[point])
        allowed = "one grid spacing" if spacings == 1.0 else f"{spacings:g} grid spacings"
        raise OffGridError(
            point,
            f"lies at {show_mm(points_mm[point])} mm, {distance_mm[point]:.3g} mm from the nearest position"
            f" ({row} at {show_mm(grid.position_mm[row])} mm); at most {allowed}, {allowed_mm:.3g} mm, is allowed",
        )
    return rows, distance_mm


def show_mm(point_mm: Float64Array) -> str:
    """A point for a message."""
    return f"({point_mm[0]:.6g}, {point_mm[1]:.6g})"
