"""Interpolation of the bank: rows and weights that make up the Green's functions at a point; registered methods.

Those from the grid's positions only are here: nearest and bilinear.

Weights are real and the same for all actuators and frequencies. A method whose weights depend on frequency (kernel
regression) adds rows of its own behind those of the bank.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.calibration.numerics import evenly_spread, on_a_line
from wavefocus.calibration.wave_model import Patch
from wavefocus.config.scene import INTERPOLATIONS
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenSource, is_check
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.paths import Path
from wavefocus.rendering.scene.trajectory import rests_mm
from wavefocus.storage.errors import InputError

_SLACK = 1e-9
"""Rounding that is forgiven, relative to the grid spacing."""
_OFF_LINE = 1e-5
"""Distance from a lattice's line, in its pitches, up to which a place is on it: positions may be rounded to float32."""


Key = TypeVar("Key")
Model = TypeVar("Model")


def kept(models: dict[Key, Model], key: Key, make: Callable[[], Model], most: int) -> Model:
    """The model of a key, made where it is missing; the `most` that were used last are kept."""
    found = models.pop(key, None)
    if found is None:
        found = make()
    models[key] = found
    for oldest in list(models)[:-most]:
        models.pop(oldest, None)
    return found


@dataclass(frozen=True, slots=True)
class Nodes:
    """Rows and weights of some points.

    rows, int64 (n, k): Bank rows of each point.
    weights, float64 (n, k): Their weights; they sum to 1. A weight of 0 means that the row is not used.
    nearest, int64 (n,): Nearest row of each point: its regularisation is used, and it is the focus that is reported.
    """

    rows: Int64Array
    weights: Float64Array
    nearest: Int64Array


class OffGridError(InputError):
    """A point lies beyond the measured grid; `point` is its index in the list of points."""

    def __init__(self, point: int, message: str) -> None:
        super().__init__(message)
        self.point = point


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Interpolated transfer functions at places, and how wrong they are; in the bank's unit.

    values, complex128 (frequencies, places, actuators).
    expected, bound, float64 (frequencies, places, actuators): Root mean square of the error, and a bound of it.
    level, float64 (frequencies, places): L2 norm over the actuators of what is there.
    judged_by: ``"left-out positions"``, ``"check positions"``.
    bound_words: What the bound states, or why there is none.
    """

    values: Complex128Array
    expected: Float64Array
    bound: Float64Array
    level: Float64Array
    judged_by: str
    bound_words: str

    @property
    def relative(self) -> Float64Array:
        """L2 norm over the actuators of what is wrong, over that of what is there, (frequencies, places)."""
        largest = float(self.expected.max(initial=0.0)) or 1.0  # squares of a bank in any unit are finite
        wrong = largest * np.linalg.norm(self.expected / largest, axis=2)
        return np.asarray(np.divide(wrong, self.level, out=np.ones_like(wrong), where=self.level > 0))


@dataclass(frozen=True, slots=True)
class InterpolationChoice:
    """What "auto" has chosen from.

    judged_by: As of `Estimate`; ``"positions"`` where every place is one.
    errors: Expected error of each method in the scene's band, by name; NaN where it was not judged.
    unsuited: Why other methods cannot be used, by name.
    """

    judged_by: str
    errors: dict[str, float]
    unsuited: dict[str, str]


Follow = Callable[[Float64Array], Nodes]
"""Nodes at arc lengths along a path, float64 (n,) in millimetres."""


class Interpolation(ABC):
    """An interpolation method over one bank; registered in `wavefocus.config.scene`."""

    name: ClassVar[str]
    choice: InterpolationChoice | None = None
    """What it was chosen from, where the scene says "auto"."""
    doubtful_hz: tuple[float, ...] = ()
    """Frequencies at which the bank says little of the waves."""

    @abstractmethod
    def estimate(self, bank: GreenSource, points_mm: Float64Array, frequency_hz: Float64Array) -> Estimate:
        """Values and errors at points (n, 2). Raises InputError: the bank has nothing that judges them."""

    @classmethod
    @abstractmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        """Make it for a bank and points (n, 2) near which it will be used; raises InputError on an unsuited grid."""

    @abstractmethod
    def nodes(self, points_mm: Float64Array) -> Nodes:
        """Rows and weights of points, float64 (n, 2). Raises OffGridError."""

    def follow(self, path: Path, arc_length_mm: Float64Array | None = None) -> Follow:
        """Prepare for a path, before rows are read; given arc lengths are the only ones that will be asked for.

        Raises OffGridError where the path leaves the grid, as far as that is found now.
        """
        return lambda along: self.nodes(path.point_at(along))

    def rows_of(self, bank: GreenSource) -> GreenSource:
        """The bank whose rows `nodes` refers to, with the rows that the method adds."""
        return bank


class GridInterpolation(Interpolation):
    """A method whose nodes are rows of the bank and depend only on the point."""

    def __init__(self, grid: PositionGrid) -> None:
        self.grid = grid

    @classmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        return cls(bank_grid(bank))

    def estimate(self, bank: GreenSource, points_mm: Float64Array, frequency_hz: Float64Array) -> Estimate:
        """Errors of the kernel, and the difference to it."""
        kernel = import_module("wavefocus.rendering.greens.interpolation.kernel")  # which builds on this module
        found: Estimate = kernel.KernelInterpolation(bank, points_mm).estimate(bank, points_mm, frequency_hz, self)
        return found


def bank_grid(bank: GreenSource) -> PositionGrid:
    """The grid of a bank's positions, see `grid_of`."""
    return grid_of(bank.position_mm, is_check(bank))


def grid_of(position_mm: ArrayLike, check: BoolArray) -> PositionGrid:
    """The grid of positions (n, 2), with those that only judge, bool (n,), moved onto its first one.

    Of positions that repeat, the first stands for all: so they are never interpolated from.
    """
    grid_mm = np.array(position_mm, dtype=np.float64)
    if check.any() and not check.all():
        grid_mm[check] = grid_mm[np.argmin(check)]
    return PositionGrid(grid_mm)


def near(
    grid: PositionGrid, points_mm: Float64Array, spacings: float = 1.0, *, amid_cells: bool = True
) -> tuple[Int64Array, Float64Array]:
    """Nearest rows and distances. Raises OffGridError for a point further than some grid spacings from all.

    amid_cells: Whether the centre of a long cell of a rectangular grid is near in any case.
    """
    rows, distance_mm = grid.nearest(points_mm)
    allowed_mm, half_mm = spacings * grid.spacing_mm, 0.0
    if amid_cells and grid.lattice is not None:
        half_mm = 0.5 * float(np.hypot(*grid.lattice.pitch_mm)) * (1.0 + _OFF_LINE)
    allowed = "one grid spacing" if spacings == 1.0 else f"{spacings:g} grid spacings"
    if half_mm > allowed_mm:
        allowed, allowed_mm = "half the diagonal of a grid cell", half_mm
    far = distance_mm > allowed_mm * (1.0 + _SLACK) + 1e-9
    if far.any():
        point = int(np.argmax(far))
        row = int(rows[point])
        raise OffGridError(
            point,
            f"lies at {show_mm(points_mm[point])} mm, {distance_mm[point]:.3g} mm from the nearest position"
            f" ({row} at {show_mm(grid.position_mm[row])} mm); at most {allowed}, {allowed_mm:.3g} mm, is allowed",
        )
    return rows, distance_mm


def show_mm(point_mm: Float64Array) -> str:
    """A point for a message."""
    return f"({point_mm[0]:.6g}, {point_mm[1]:.6g})"


def interpolation_method(name: str) -> type[Interpolation]:
    """Load a registered method; raises InputError where there is none of that name, as "auto" is none."""
    if name not in INTERPOLATIONS:
        raise InputError(f"interpolation is {name!r}; allowed are {', '.join(INTERPOLATIONS)}")
    if name == "auto":
        raise InputError("interpolation is 'auto', which is chosen for a scene; name a method instead")
    found: type[Interpolation] = _registered(name)
    return found


def _registered(name: str) -> Any:
    module, _, what = INTERPOLATIONS[name].partition(":")
    return getattr(import_module(module), what)  # which builds on this module


def scene_interpolation(scene: Scene, bank: GreenSource) -> Interpolation:
    """Make the interpolation of a scene; raises InputError where the bank's positions do not allow it."""
    name = scene.output.interpolation
    if reason := getattr(bank, "import_facts", {}).get("unsuited", {}).get(name):
        raise InputError(f"interpolation is {name!r}, and the bank was imported: {reason}; use 'nearest'")
    if name == "auto":
        chosen: Interpolation = _registered(name)(scene, bank)
        return chosen
    return interpolation_method(name).over(bank, scene_points(scene))


def scene_points(scene: Scene, most: int = 64) -> Float64Array:
    """Points evenly chosen along the paths of a scene's sources, at most so many each, float64 (n, 2).

    Of a source that emits anew at every path point, path points; of a trajectory as many `rests_mm`, too.
    """
    parts = []
    for source in scene.sources:
        at_rest_mm = rests_mm(source.path)
        parts.append(at_rest_mm[evenly_spread(len(at_rest_mm), most)])
        if len(at_rest_mm) and source.path.length_mm == 0:
            continue
        length_mm, step_mm = source.path.length_mm, source.step_mm
        if length_mm > 0 and step_mm > 0 and source.emission == "per_point":
            last = int(min(length_mm / step_mm + 1e-9, 2**53))
            along_mm = step_mm * evenly_spread(last + 1, most)
        else:
            along_mm = np.linspace(0.0, length_mm, most) if length_mm > 0 else np.zeros(1)
        parts.append(source.path.point_at(along_mm))
    return np.concatenate(parts)


NEIGHBOURS = 36
"""Whole rings about a position, on a square and on a hexagonal grid alike."""
MIN_NEIGHBOURS = 8
REACH_SPACINGS = 8.0
"""Positions further than this, in grid spacings, are no neighbours: the waves there say little of those here."""
SAME_SPACINGS = 1e-3
"""Positions nearer to one another than about this, in grid spacings, count once."""


class SparseError(InputError):
    """A position has too few neighbours, or all of them on one line."""


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
        if len(rows) < MIN_NEIGHBOURS or on_a_line(position_mm[rows]):
            raise InputError(
                f"interpolation is 'kernel', but the {len(rows)} measured positions are too few or lie on one line;"
                f" it needs at least {MIN_NEIGHBOURS}, spread in two directions; use 'nearest'"
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
        chosen = evenly_spread(len(self._rows), most)
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
        if len(chosen) <= MIN_NEIGHBOURS or on_a_line(offset_mm):
            reach_mm = REACH_SPACINGS * self.spacing_mm
            raise SparseError(
                f"position {row} at ({centre_mm[0]:.6g}, {centre_mm[1]:.6g}) mm has {len(chosen) - 1} measured"
                f" neighbours within {reach_mm:.3g} mm; kernel interpolation needs at least {MIN_NEIGHBOURS},"
                " spread in two directions"
            )
        # Shape to a tenth of what counts as the same place: rounding in a file must not make each patch unique.
        key = np.rint(offset_mm / (0.1 * SAME_SPACINGS * self.spacing_mm)).astype(np.int64).tobytes()
        return Patch(self._rows[index[chosen]], offset_mm, key)


class Nearest(GridInterpolation):
    """The row of smallest distance, the lower index on a tie."""

    name = "nearest"

    def nodes(self, points_mm: Float64Array) -> Nodes:
        rows, _ = near(self.grid, points_mm, amid_cells=False)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), rows)


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
        nearest, _ = near(self.grid, points_mm)
        cell, part, outside = self._cells(points_mm)
        column, line = cell
        rows = np.stack([self._row_at[column + right, line + up] for up in (0, 1) for right in (0, 1)]).T
        lacking = (rows < 0).any(axis=1)
        if lacking.any():  # a place on a line of the lattice needs no corner off it
            on_line = lacking & (np.abs(part - np.rint(part)) < _OFF_LINE)
            part[on_line] = np.rint(part[on_line])
        x, y = part
        weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]).T
        wrong = outside | ((rows < 0) & (weights > 0)).any(axis=1)
        if wrong.any():
            point = int(np.argmax(wrong))
            raise OffGridError(
                point,
                f"lies at {show_mm(points_mm[point])} mm, in a grid cell that lacks a corner; bilinear interpolation"
                " needs all four",
            )
        return Nodes(np.maximum(rows, 0), weights, nearest)

    def _cells(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array, BoolArray]:
        """Cells of points, (2, n), their places in the cells from 0 to 1, and whether they lie outside all cells."""
        # Axis by axis: there may be very many points, and numpy is slow along an axis of two.
        cell, part = np.empty((2, len(points_mm)), dtype=np.int64), np.empty((2, len(points_mm)))
        outside = np.zeros(len(points_mm), dtype=bool)
        for axis in (0, 1):
            site = (points_mm[:, axis] - self._lattice.origin_mm[axis]) / self._lattice.pitch_mm[axis]
            cell[axis] = np.clip(np.floor(site).astype(np.int64), 0, self._row_at.shape[axis] - 2)
            beyond = site - cell[axis]
            outside |= (beyond < -_OFF_LINE) | (beyond > 1.0 + _OFF_LINE)
            within = np.clip(beyond, 0.0, 1.0, out=part[axis])
            within[within < _SLACK] = 0.0
            within[within > 1.0 - _SLACK] = 1.0
        return cell, part, outside
