"""The bank's positions, searched by distance, and the lattice that they lie on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

TIES = 8
TIE_SLACK = 1e-5
"""Share of the pitch within which another position may be as near."""
LATTICE_SLACK = 1e-6
"""Distance from their sites, in grid spacings, up to which positions are on a lattice."""
FURTHEST_MM = 1e100
"""Points beyond are searched for from here: the squares of greater distances overflow."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """Positions on the sites of a lattice along x and y, some of which may be empty.

    Parameters
    ----------
    origin_mm, pitch_mm : float64 array, shape (2,)
        Place of the first site, and distance of the sites along x and y.
    row_at : int64 array, shape (columns, lines)
        Row at each site, -1 where there is none.
    """

    origin_mm: Float64Array
    pitch_mm: Float64Array
    row_at: Int64Array

    def nearest(self, points_mm: Float64Array) -> Int64Array:
        """Row of the nearest site, -1 where it is empty or another is as near."""
        index = np.zeros(len(points_mm), dtype=np.int64)
        clear = np.ones(len(points_mm), dtype=bool)
        for axis in (0, 1):
            lattice = (points_mm[:, axis] - self.origin_mm[axis]) / self.pitch_mm[axis]
            site = np.clip(np.rint(lattice), 0, self.row_at.shape[axis] - 1)
            clear &= np.abs(lattice - site) < 0.5 - TIE_SLACK
            index *= self.row_at.shape[axis]
            index += np.where(clear, site, 0.0).astype(np.int64)
        return np.where(clear, self.row_at.ravel()[index], -1)


class PositionGrid:
    """The positions of a bank; of positions that repeat, the lowest index stands for all.

    Parameters
    ----------
    position_mm : float64 array, shape (positions, 2)
        Grid in millimetres.

    Raises
    ------
    InputError
        There is no position, or a coordinate is not finite.
    """

    spacing_mm: float
    """Median distance of neighbouring positions, 0 where there is one position only."""
    lattice: Lattice | None
    """The lattice that all positions lie on, if any."""
    off_lattice_row: int
    """The row furthest off the lattice that fits best."""

    def __init__(self, position_mm: ArrayLike) -> None:
        self.position_mm: Float64Array = np.ascontiguousarray(position_mm, dtype=np.float64)
        if self.position_mm.ndim != 2 or self.position_mm.shape[1] != 2 or not len(self.position_mm):
            raise InputError(
                f"position_mm has shape {self.position_mm.shape}; expected (positions, 2), at least one position"
            )
        bad = ~np.isfinite(self.position_mm).all(axis=1)
        if bad.any():
            raise InputError(f"position {int(np.argmax(bad))} has a coordinate that is not finite")
        self._row, self._tree, self.spacing_mm, self.lattice, self.off_lattice_row = _index(self.position_mm.tobytes())

    def nearest(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Rows (n,) of smallest distance to points (n, 2), the lower index on a tie, and those distances (n,)."""
        if self.lattice is None:
            rows = self._search(points_mm)
        else:
            rows = self.lattice.nearest(points_mm)
            left = np.flatnonzero(rows < 0)
            rows[left] = self._search(points_mm[left])
        with np.errstate(over="ignore"):  # a path may lie anywhere; a point too far away is refused
            return rows, np.asarray(np.hypot(*(points_mm - self.position_mm[rows]).T), dtype=np.float64)

    def _search(self, points_mm: Float64Array) -> Int64Array:
        points_mm = np.clip(points_mm, -FURTHEST_MM, FURTHEST_MM)
        neighbours = min(TIES, self._tree.n)
        found = np.reshape(self._tree.query(points_mm, k=neighbours)[1], (len(points_mm), neighbours))
        candidates = self._row[found]
        offset = self.position_mm[candidates] - points_mm[:, None, :]
        square = offset[..., 0] ** 2 + offset[..., 1] ** 2
        best = square.min(axis=1, keepdims=True)
        rows: Int64Array = np.where(square == best, candidates, len(self.position_mm)).min(axis=1)
        crowded = (square == best).all(axis=1) & (neighbours < self._tree.n)
        for point in np.flatnonzero(crowded):
            offset = self.position_mm - points_mm[point]
            rows[point] = np.argmin(offset[:, 0] ** 2 + offset[:, 1] ** 2)
        return rows


@lru_cache(maxsize=4)
def _index(position_mm: bytes) -> tuple[Int64Array, cKDTree, float, Lattice | None, int]:
    """Index a grid by its coordinates: every render and every check of a scene needs the same one."""
    unique_mm, first = np.unique(np.frombuffer(position_mm).reshape(-1, 2), axis=0, return_index=True)
    row = first.astype(np.int64)
    tree = cKDTree(unique_mm)
    if len(unique_mm) < 2:
        return row, tree, 0.0, None, 0
    distance_mm = np.asarray(tree.query(unique_mm, k=2)[0])
    spacing_mm = float(np.median(distance_mm[:, 1]))
    return row, tree, spacing_mm, *_fit_lattice(unique_mm, row, spacing_mm)


def _fit_lattice(unique_mm: Float64Array, row: Int64Array, spacing_mm: float) -> tuple[Lattice | None, int]:
    """The lattice of the positions, if they lie on one, and the row furthest off it."""
    origin_mm, extent_mm = unique_mm.min(axis=0), np.ptp(unique_mm, axis=0)
    slack_mm = spacing_mm * LATTICE_SLACK
    pitch_mm = np.full(2, spacing_mm)  # across a line of positions there is one site
    for axis in (0, 1):
        steps = np.diff(np.unique(unique_mm[:, axis]))
        steps = steps[steps > slack_mm]
        if len(steps):
            pitch_mm[axis] = extent_mm[axis] / round(float(extent_mm[axis] / steps.min()))
    site = np.rint((unique_mm - origin_mm) / pitch_mm)
    shape = site.max(axis=0) + 1.0
    off_mm = np.abs(unique_mm - origin_mm - site * pitch_mm).max(axis=1)
    worst = int(row[np.argmax(off_mm)])
    if off_mm.max() > slack_mm or shape.prod() > 100 * len(unique_mm) + 10_000:
        return None, worst
    row_at = np.full(shape.astype(np.int64), -1, dtype=np.int64)
    row_at[tuple(site.astype(np.int64).T)] = row
    return Lattice(origin_mm, pitch_mm, row_at), worst
