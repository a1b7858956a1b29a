"""What maps are drawn over: positions, actuators and outline, and the pixel picture that shows a value per position."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.run import DriftLimits
from wavefocus.rendering.arrays import Float64Array

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

    from wavefocus.config.rig import RigConfig
    from wavefocus.config.rig import Surface as SurfaceTable
    from wavefocus.rendering.scene.paths import Path as Path2D
    from wavefocus.storage.bank.reading import Bank


_OUTLINE_POINTS = 181
_MAX_PIXELS = 400_000
_REACH = 1.5  # spacings
# A path that goes this much further from one point to the next than along it has jumped.
_JUMP = 1.5
# Pixels per spacing, and how far a cell reaches from its position, in spacings: with gaps between cells or without.
_WITH_GAPS, _WITHOUT_GAPS = (12, 0.45), (4, 0.55)
#: Name of the virtual rig, in place of a rig file.
VIRTUAL = "virtual"


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """Pixels of a surface.

    index, intp (rows, columns): Position that a pixel belongs to, `positions` where there is none; row 0 at the
        smallest y.
    left_mm, bottom_mm, width_mm, height_mm: The rectangle that it covers.
    spacing_mm: Median distance of neighbouring positions.
    tree: Of the positions.
    """

    index: NDArray[np.intp]
    left_mm: float
    bottom_mm: float
    width_mm: float
    height_mm: float
    spacing_mm: float
    tree: cKDTree

    def nearest(self, x_mm: float, y_mm: float) -> int:
        """The position nearest to a point, -1 when it is too far away to be meant by a click."""
        distance_mm, position = self.tree.query([x_mm, y_mm])
        return int(position) if distance_mm <= max(_REACH * self.spacing_mm, self.width_mm / 40) else -1


@dataclass(frozen=True, slots=True, eq=False)
class PlotSurface:
    """A surface, and the attributes of its bank.

    position_mm, float64 (positions, 2): The grid, in any order.
    actuator_mm, float64 (actuators, 2): NaN where unknown.
    outline_mm, float64 (points, 2) or None: Rim of the surface, closed; None where unknown.
    raster: Position of each pixel.
    paths_mm, sequence of float64 (points, 2): Paths of sources, NaN where they jump.
    checks, intp: Positions off the grid, which have no cell: they are drawn as small rings.
    bank: The bank's file; ``Path()`` without a bank.
    sample_rate_hz, band_hz, unit: Of the Green's functions.
    is_virtual: Whether the bank was measured on a virtual rig.
    drift_limits: Of its run; the default ones where the bank does not state them.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    outline_mm: Float64Array | None
    raster: Raster
    paths_mm: Sequence[Float64Array] = ()
    checks: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    bank: Path = Path()
    sample_rate_hz: float = 1.0
    band_hz: tuple[float, float] | None = None
    unit: str = ""
    is_virtual: bool = False
    drift_limits: DriftLimits = field(default_factory=DriftLimits)

    @property
    def positions(self) -> int:
        return len(self.position_mm)

    def with_rows(self, rows: NDArray[np.int64]) -> PlotSurface:
        """The same surface with some of the positions, their cells without gaps, for fields."""
        position_mm, checks = self.position_mm[rows], np.flatnonzero(np.isin(rows, self.checks))
        return replace(self, position_mm=position_mm, checks=checks, raster=raster_of(position_mm, checks, gaps=False))


def surface_of(bank: Bank) -> PlotSurface:
    """Return the surface of an open bank."""
    position_mm, checks = np.asarray(bank.position_mm, np.float64), np.array(list(bank.check_rows), np.intp)
    rig, run = _tables(bank.rig_json), _tables(bank.run_json)
    surface = _surface_of_table(rig.get("surface"))
    outline_mm = None if surface is None else surface.outline.line(_OUTLINE_POINTS)
    try:
        limits = DriftLimits(**run["drift"])
    except (ValueError, TypeError, KeyError):
        limits = DriftLimits()
    return PlotSurface(
        position_mm=position_mm,
        actuator_mm=np.asarray(bank.actuator_mm, np.float64),
        outline_mm=outline_mm,
        raster=raster_of(position_mm, checks),
        checks=checks,
        bank=bank.path,
        sample_rate_hz=bank.sample_rate_hz,
        band_hz=bank.band_hz,
        unit=bank.response_unit,
        is_virtual="mirror" in rig and is_virtual(rig),
        drift_limits=limits,
    )


def plan_surface(rig: RigConfig, position_mm: Float64Array, checks: Sequence[int] | NDArray[np.intp]) -> PlotSurface:
    """The surface of a rig with positions to be measured, `checks` of them off the grid."""
    return PlotSurface(
        position_mm=position_mm,
        actuator_mm=rig.actuator_mm,
        outline_mm=rig.surface.outline.line(_OUTLINE_POINTS),
        raster=raster_of(position_mm, checks),
        checks=np.asarray(checks, np.intp),
    )


def raster_of(position_mm: Float64Array, checks: Sequence[int] | NDArray[np.intp] = (), *, gaps: bool = True) -> Raster:
    """Assign each pixel to the nearest position within about half a spacing; takes tens of milliseconds.

    checks: Positions that get no pixels.
    """
    from scipy.spatial import cKDTree  # the window starts without scipy

    pixels_per_spacing, cell = _WITH_GAPS if gaps else _WITHOUT_GAPS
    tree = cKDTree(position_mm)
    on_grid = np.setdiff1d(np.arange(len(position_mm)), np.asarray(checks, np.intp))
    cells = cKDTree(position_mm[on_grid])
    spacing_mm = float(np.median(cells.query(position_mm[on_grid], k=[2])[0])) if len(on_grid) > 1 else 1.0
    low, high = position_mm.min(axis=0) - spacing_mm, position_mm.max(axis=0) + spacing_mm
    size_mm = high - low
    pixel_mm = max(spacing_mm / pixels_per_spacing, float(np.sqrt(size_mm[0] * size_mm[1] / _MAX_PIXELS)))
    columns, rows = (max(1, int(np.ceil(side / pixel_mm))) for side in size_mm)
    x_mm = low[0] + (np.arange(columns) + 0.5) * size_mm[0] / columns
    y_mm = low[1] + (np.arange(rows) + 0.5) * size_mm[1] / rows
    pixels_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    # By the larger of both coordinates a cell is a square: right for square grids, and clear enough for others.
    _, found = cells.query(pixels_mm, p=np.inf, distance_upper_bound=cell * spacing_mm)
    index = np.append(on_grid, len(position_mm))[found]  # beyond the last row: no position
    left_mm, bottom_mm, width_mm, height_mm = (float(one) for one in (*low, *size_mm))
    return Raster(index.reshape(rows, columns), left_mm, bottom_mm, width_mm, height_mm, spacing_mm, tree)


def path_line(path: Path2D, points: int) -> Float64Array:
    """Return a path as a line (n, 2), NaN where it jumps from stroke to stroke; one point for a path at rest."""
    if path.length_mm <= 0:
        return path.point_at(np.zeros(1))
    along_mm, step_mm = np.linspace(0.0, path.length_mm, points, retstep=True)
    line_mm = path.point_at(along_mm)
    jumps = np.flatnonzero(np.hypot(*np.diff(line_mm, axis=0).T) > _JUMP * step_mm + 1e-6) + 1
    return np.insert(line_mm, jumps, np.nan, axis=0)


def surface_from(table: object) -> SurfaceTable:
    """The surface that a table of a rig file or a message describes; the default where it describes none."""
    from wavefocus.config.rig import Surface as SurfaceTable  # loads pydantic

    return _surface_of_table(table) or SurfaceTable()


def _surface_of_table(table: object) -> SurfaceTable | None:
    from wavefocus.config.rig import Surface as SurfaceTable

    try:
        return SurfaceTable.model_validate(table)
    except (ValueError, TypeError):
        return None


def is_virtual(rig: Mapping[str, object]) -> bool:
    """Whether a rig's tables name virtual instruments; either all of a rig are, or none."""
    mirror = rig.get("mirror")
    return not isinstance(mirror, Mapping) or mirror.get("driver", VIRTUAL) == VIRTUAL


def _tables(text: str | None) -> dict[str, Any]:
    """The tables of a bank's configuration; a bank made by another program may hold any text there."""
    try:
        tables = json.loads(text or "")
    except (ValueError, RecursionError):
        return {}
    return tables if isinstance(tables, dict) else {}
