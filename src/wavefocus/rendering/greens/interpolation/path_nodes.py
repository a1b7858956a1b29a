"""Interpolation along a path between nodes in arc length, for methods that add rows of their own to the bank."""

import itertools
from abc import ABC, abstractmethod
from collections import OrderedDict
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import Follow, Interpolation, Nodes, near
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenSource, well_measured
from wavefocus.rendering.scene.paths import Circle, Path
from wavefocus.storage.bank.ledger import Status

STENCIL = 4
"""Nodes that make one point: a cubic polynomial in arc length."""
_INSET = 1e-6


def node_spacing_mm(wavenumber_rad_mm: float, error: float) -> float:
    """Spacing at which a wave along the path is interpolated with an error."""
    # Rms error of that polynomial for exp(j k s) between its middle nodes, over (k spacing)**4: the root of the mean
    # of ((t + 1) t (t - 1) (t - 2) / 24)**2 over 0 < t < 1.
    return float((error / 0.0177) ** (1.0 / STENCIL) / wavenumber_rad_mm)


class PathNodes:
    """Nodes along the smooth pieces of a path.

    Green's functions along a path are smooth in arc length but for its corners and gaps; no polynomial
    reaches across those.

    spacing_mm: Largest distance of neighbouring nodes along it, > 0.
    """

    arc_length_mm: Float64Array
    """Arc lengths of the nodes, ascending; at a corner two are equal."""

    def __init__(self, path: Path, spacing_mm: float) -> None:
        turn_mm = 2.0 * np.pi * path.radius_mm if isinstance(path, Circle) else 0.0
        if turn_mm > 0:
            # Every turn meets the same nodes.
            spacing_mm = turn_mm / np.ceil(turn_mm / spacing_mm)
        breaks = np.concatenate([[0.0], _corners(path, spacing_mm), [path.length_mm]])
        self._begins = breaks[:-1]
        parts: list[Float64Array] = []
        for begin, end in itertools.pairwise(breaks.tolist()):
            # No last step of next to nothing: polynomials through places that all but meet are worth nothing.
            steps = max(int(np.ceil((end - begin) / spacing_mm - 1e-3)), 1)
            step = spacing_mm if turn_mm > 0 else (end - begin) / steps
            nodes = np.append(begin + step * np.arange(steps), end)
            # A corner is exact to rounding: its two nodes lie safely on their own sides of it.
            nodes[0] += _INSET * step if begin > 0 else 0.0
            nodes[-1] -= _INSET * step if end < path.length_mm else 0.0
            parts.append(nodes)
        self._parts, self._first = parts, np.cumsum([0, *map(len, parts)]).tolist()
        self.arc_length_mm = np.concatenate(parts)

    def weights(self, arc_length_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Nodes and their weights at arc lengths.

        Returns they sum to 1; 0 for nodes that a short piece does not have.
        """
        piece = np.clip(np.searchsorted(self._begins, arc_length_mm, side="right") - 1, 0, len(self._begins) - 1)
        nodes = np.zeros((len(arc_length_mm), STENCIL), dtype=np.int64)
        weights = np.zeros((len(arc_length_mm), STENCIL))
        for number in np.unique(piece).tolist():
            chosen = np.flatnonzero(piece == number)
            first, mine = self._first[number], self._parts[number]
            width = min(STENCIL, len(mine))
            low = np.searchsorted(mine, arc_length_mm[chosen], side="right") - width // 2
            low = np.clip(low, 0, len(mine) - width)
            stencil = low[:, None] + np.arange(width)
            nodes[chosen] = first
            nodes[chosen[:, None], np.arange(width)] = first + stencil
            weights[chosen, :width] = _lagrange(mine[stencil], arc_length_mm[chosen])
        return nodes, weights


def _lagrange(at: Float64Array, wanted: Float64Array) -> Float64Array:
    """Weights (n, k) of values at `at` (n, k) for the polynomial at `wanted` (n,)."""
    weights = np.ones_like(at)
    for place in range(at.shape[1]):
        for other in range(at.shape[1]):
            if other != place:
                weights[:, place] *= (wanted - at[:, other]) / (at[:, place] - at[:, other])
    return weights


def _corners(path: Path, spacing_mm: float) -> Float64Array:
    """Arc lengths at which the path has a corner or a gap, ascending."""
    if isinstance(path, Circle):
        return np.zeros(0)
    # A path is looked at so often; where it turns by more from look to look it has a corner or a gap.
    looks = min(int(np.ceil(path.length_mm / spacing_mm * 4)) + 2, 4_000_000)
    along = np.linspace(0.0, path.length_mm, looks)
    points = path.point_at(along)
    step_mm = along[1]
    bend_mm = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
    found: list[float] = []
    for index in np.flatnonzero(bend_mm > 0.1 * step_mm).tolist():
        corner = _narrowed(path, float(along[index]), float(along[index + 2]))
        inside = 1e-6 * step_mm < corner < path.length_mm - 1e-6 * step_mm
        # One corner bends two neighbouring looks.
        if inside and (not found or corner > found[-1] + 1e-3 * step_mm):
            found.append(corner)
    return np.array(found)


def _narrowed(path: Path, begin: float, end: float) -> float:
    """Arc length of the strongest bend between two others."""
    for _ in range(40):
        if end - begin < 1e-9 * path.length_mm:
            break
        along = np.linspace(begin, end, 9)
        points = path.point_at(along)
        bend = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
        sharpest = 1 + int(np.argmax(bend))
        begin, end = float(along[sharpest - 1]), float(along[sharpest + 1])
    return 0.5 * (begin + end)


REACH_SPACINGS = 1.5
"""Largest distance of a point from the nearest position: an irregular grid has gaps wider than its median spacing."""
PATH_ERROR = 1e-3
"""Relative error that interpolating along a path adds, at the bank's highest frequency."""


_SAME_MM = 1e-6


class AddedRows(ABC):
    """A bank and, behind its own positions, rows at further points; the read interface of a bank.

    kept: Number of added rows that are kept; those that are made together are kept in any case.
    """

    def __init__(self, measured: GreenSource, kept: int) -> None:
        self._kept, self._rows = kept, OrderedDict[int, Float64Array]()
        self.measured = measured
        self.actuator_mm, self.band_hz = measured.actuator_mm, measured.band_hz
        self.taps, self.actuators = measured.taps, measured.actuators
        self.sample_rate_hz, self.response_unit = measured.sample_rate_hz, measured.response_unit
        self._points_mm: list[tuple[float, float]] = []
        self._index: dict[tuple[int, int], int] = {}

    def green(self, position: int) -> NDArray[Any]:
        """Green's functions of one row, (actuators, taps): measured, or interpolated in float64."""
        if position < self.measured.positions:
            return self.measured.green(position)
        number = position - self.measured.positions
        if number not in self._rows:
            made = self._make(number)
            self._rows.update(made)
            while len(self._rows) > max(self._kept, len(made)):
                self._rows.popitem(last=False)
        self._rows.move_to_end(number)
        return self._rows[number]

    @abstractmethod
    def _make(self, number: int) -> dict[int, Float64Array]:
        """Make an added row, and others with it."""

    def add(self, points_mm: Float64Array) -> Int64Array:
        """Add rows at points, float64 (n, 2), and return their numbers; a point is added once. Raises OffGridError."""
        numbers = np.empty(len(points_mm), dtype=np.int64)
        for place, (x_mm, y_mm) in enumerate(points_mm.tolist()):
            key = (round(x_mm / _SAME_MM), round(y_mm / _SAME_MM))
            if key not in self._index:
                self._index[key] = len(self._points_mm)
                self._points_mm.append((x_mm, y_mm))
            numbers[place] = self.measured.positions + self._index[key]
        return numbers

    @property
    def added(self) -> int:
        """Number of rows that were added."""
        return len(self._points_mm)

    @property
    def position_mm(self) -> Float64Array:
        own = np.asarray(self.measured.position_mm, dtype=np.float64)
        return np.concatenate([own, np.asarray(self._points_mm, dtype=np.float64).reshape(-1, 2)])

    @property
    def status(self) -> NDArray[np.uint8]:
        added = np.full(self.added, int(Status.VALID), dtype=np.uint8)
        return np.concatenate([np.asarray(self.measured.status, dtype=np.uint8), added])

    @property
    def positions(self) -> int:
        return self.measured.positions + self.added


class PathInterpolation(Interpolation):
    """A method that makes rows at nodes along a path; between them, cubics in arc length interpolate.

    rows: The bank with the rows that were added.
    grid: Positions that rows are made from.
    grid_row, int64: Their rows in the bank.
    node_spacing_mm: See `node_spacing_mm`.
    """

    rows: AddedRows
    node_spacing_mm: float

    def __init__(self, bank: GreenSource) -> None:
        self.grid_row: Int64Array = np.flatnonzero(well_measured(bank)).astype(np.int64)
        self.grid = PositionGrid(np.asarray(bank.position_mm, dtype=np.float64)[self.grid_row])

    def add(self, points_mm: Float64Array) -> Int64Array:
        """Add rows at points (n, 2) and return their numbers. Raises OffGridError."""
        near(self.grid, points_mm, REACH_SPACINGS)
        return self.rows.add(points_mm)

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, rows = self._nearest(points_mm), self.add(points_mm)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), nearest)

    def follow(self, path: Path, arc_length_mm: Float64Array | None = None) -> Follow:
        if path.length_mm == 0 or (
            arc_length_mm is not None and len(arc_length_mm) * self.node_spacing_mm <= path.length_mm
        ):
            return lambda along: self.nodes(path.point_at(along))
        along_path = PathNodes(path, self.node_spacing_mm)
        rows = self.add(path.point_at(along_path.arc_length_mm))

        def follow(along: Float64Array) -> Nodes:
            nodes, weights = along_path.weights(along)
            return Nodes(rows[nodes], weights, self._nearest(path.point_at(along)))

        return follow

    def rows_of(self, bank: GreenSource) -> GreenSource:
        return cast(GreenSource, self.rows)

    def _nearest(self, points_mm: Float64Array) -> Int64Array:
        return self.grid_row[near(self.grid, points_mm, REACH_SPACINGS)[0]]
