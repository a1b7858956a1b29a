"""The positions of a grid that a scene needs: those that it is rendered from, and those around its foci."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM
from wavefocus.rendering.greens.interpolation.base import NEIGHBOURS, Bilinear, OffGridError, grid_of, near
from wavefocus.rendering.greens.interpolation.errors import ON_POSITION
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.paths import Path
from wavefocus.rendering.scene.quiet_places import places_of
from wavefocus.rendering.scene.sampling import MAX_PATH_POINTS
from wavefocus.rendering.scene.trajectory import rests_mm
from wavefocus.storage.errors import InputError

POINTS_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class SceneRows:
    """Rows of a grid, each once, ascending.

    path, int64 (n,): Rows that the scene is rendered from, for any method and sample distance of the path.
    checks, int64 (m,): Those within 15 mm of a path: there the foci are looked for when the scene is verified; and
        those at quiet places.
    """

    path: Int64Array
    checks: Int64Array

    @property
    def all(self) -> Int64Array:
        """Both."""
        return np.union1d(self.path, self.checks)


def scene_rows(
    scene: Scene, position_mm: Float64Array, check: BoolArray | None = None, *, coarse: bool = False
) -> SceneRows:
    """Find the positions that a scene needs on a grid (positions, 2).

    check, bool (positions,): Those that lie off the grid and only judge what is between its positions.
    coarse: The grid is too coarse for the kernel: "auto", and a quiet place between positions, are made of waves, which
        need all.

    Raises InputError where a path leaves the grid, or the grid does not allow the scene's interpolation.
    """
    grid = grid_of(position_mm, np.zeros(len(position_mm), bool) if check is None else check)
    auto = "waves" if coarse else "kernel"
    method = auto if scene.output.interpolation == "auto" else scene.output.interpolation
    tree = cKDTree(position_mm)
    path: set[int] = set()
    checks: set[int] = set()
    for source in scene.sources:
        points_mm, step_mm = _along(source.path, grid.spacing_mm)
        _, away_mm = near(grid, points_mm, amid_cells=method != "nearest")
        rows = _nearby_rows(tree, points_mm, away_mm + step_mm)
        path |= rows | _more_rows(method, grid, tree, rows, points_mm, step_mm)
        checks |= _nearby_rows(tree, points_mm, np.full(len(points_mm), FOCUS_RADIUS_MM + grid.spacing_mm))
    for place in places_of(scene):
        # Between positions a quiet place takes the best interpolation, whatever the scene's is.
        points_mm, step_mm = _along(place.path, grid.spacing_mm)
        _, away_mm = near(grid, points_mm)
        reach_mm = away_mm + step_mm + place.radius_mm
        rows = _nearby_rows(tree, points_mm, reach_mm)
        between = step_mm + place.radius_mm > 0 or away_mm.max() > ON_POSITION * grid.spacing_mm
        path |= rows | _more_rows(auto if between else "kernel", grid, tree, rows, points_mm, step_mm)
        checks |= _nearby_rows(tree, points_mm, reach_mm + grid.spacing_mm)
    return SceneRows(np.array(sorted(path), dtype=np.int64), np.array(sorted(checks), dtype=np.int64))


def _more_rows(
    name: str, grid: PositionGrid, tree: cKDTree, rows: set[int], points_mm: Float64Array, step_mm: float
) -> set[int]:
    """Rows that an interpolation needs beyond the nearest ones, `rows`, for a path through points a step apart."""
    if name == "waves":  # which cross the whole surface
        return set(range(len(grid.position_mm)))
    if name == "kernel":  # the neighbours of the nearest rows, and all that is as far away as the last of them
        centres_mm = tree.data[sorted(rows)]
        distance, _ = tree.query(centres_mm, k=min(NEIGHBOURS + 1, tree.n))
        furthest_mm = np.reshape(distance, (len(centres_mm), -1))[:, -1] * (1 + 1e-6) + 1e-9
        return {row for near_rows in tree.query_ball_point(centres_mm, furthest_mm) for row in near_rows}
    found = set[int]()
    if name == "nearest":
        return found
    method = Bilinear(grid)
    for shift_mm in np.array([(0.0, 0.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]) * step_mm:
        places_mm = points_mm + shift_mm
        while len(places_mm):
            try:
                found.update(np.unique(method.nodes(places_mm).rows).tolist())
                break
            except OffGridError as off:
                if not shift_mm.any():
                    raise
                places_mm = np.delete(places_mm, off.point, axis=0)  # only the margin is beyond the grid
    return found


def _along(path: Path, spacing_mm: float) -> tuple[Float64Array, float]:
    """Points along a path so close that none on it is further than the returned distance from one of them."""
    if path.length_mm <= 0 or spacing_mm <= 0:
        at_rest_mm = rests_mm(path)
        return at_rest_mm if len(at_rest_mm) else path.point_at(np.zeros(1)), 0.0
    # Points per grid spacing at which a path is looked at; what lies between them is covered by a margin.
    steps = path.length_mm / spacing_mm * 32
    if steps > 32 * MAX_PATH_POINTS:
        raise InputError(
            f"a path is {path.length_mm:.4g} mm long, {steps / 32:.4g} grid spacings; at most {MAX_PATH_POINTS} points"
            " are allowed"
        )
    count = max(2, math.ceil(steps) + 1)
    along_mm = np.linspace(0.0, path.length_mm, count)
    return np.concatenate([path.point_at(along_mm), rests_mm(path, along_mm[1])]), float(along_mm[1])


def _nearby_rows(tree: cKDTree, points_mm: Float64Array, radius_mm: Float64Array) -> set[int]:
    near: set[int] = set()
    for begin in range(0, len(points_mm), POINTS_AT_ONCE):
        some = slice(begin, begin + POINTS_AT_ONCE)
        for rows in tree.query_ball_point(points_mm[some], radius_mm[some] + 1e-9):
            near.update(rows)
    return near
