"""The bank's positions, searched by distance, and the lattice that they lie on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


_LATTICE_SLACK = 1e-6
"""Distance from their sites, in grid spacings, up to which positions are on a lattice."""
FURTHEST_MM = 1e100
"""Points beyond are searched for from here: the squares of greater distances overflow."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """Positions on the sites of a lattice along x and y, some of which may be empty.

    origin_mm, pitch_mm, float64 (2,): Place of the first site, and distance of the sites along x and y.
    row_at, int64 (columns, lines): Row at each site, -1 where there is none.
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
            site = np.minimum(np.maximum(np.rint(lattice), 0), self.row_at.shape[axis] - 1)
            # Share of the pitch within which another position may be as near.
            clear &= np.abs(lattice - site) < 0.5 - 1e-5
            index *= self.row_at.shape[axis]
            index += np.where(clear, site, 0.0).astype(np.int64)
        return np.where(clear, self.row_at.ravel()[index], -1)

    def corners(self, points_mm: Float64Array) -> Int64Array:
        """Rows at the corners of the cell around each point, (n, 4), -1 where there is none."""
        low = np.floor(np.clip((points_mm - self.origin_mm) / self.pitch_mm, -2.0, np.array(self.row_at.shape) + 1.0))
        site = low.astype(np.int64)[:, None] + np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        inside = ((site >= 0) & (site < self.row_at.shape)).all(axis=2)
        column, line = np.where(inside[..., None], site, 0).transpose(2, 0, 1)
        return np.where(inside, self.row_at[column, line], -1)


class PositionGrid:
    """The positions of a bank; of positions that repeat, the lowest index stands for all.

    position_mm, float64 (positions, 2): Grid in millimetres.

    Raises InputError: there is no position, or a coordinate is not finite.
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
        self._key = self.position_mm.tobytes()
        self._row, self.spacing_mm, self.lattice, self.off_lattice_row = _index(self._key)

    def nearest(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Rows (n,) of smallest distance to points (n, 2), the lower index on a tie, and those distances (n,)."""
        if self.lattice is None:
            rows = self._search(points_mm)
        else:
            rows = self.lattice.nearest(points_mm)
            left = np.flatnonzero(rows < 0)
            if len(left):
                corners = self.lattice.corners(points_mm[left])
                within = (corners >= 0).all(axis=1)
                rows[left[within]] = self._closest(points_mm[left[within]], corners[within])[0]
                left = left[~within]
            if len(left):
                rows[left] = self._search(points_mm[left])
        right_mm, up_mm = (points_mm[:, axis] - self.position_mm[:, axis].take(rows) for axis in (0, 1))
        with np.errstate(over="ignore"):  # a path may lie anywhere; a point too far away is refused
            return rows, np.hypot(right_mm, up_mm)

    def _search(self, points_mm: Float64Array) -> Int64Array:
        points_mm = np.clip(points_mm, -FURTHEST_MM, FURTHEST_MM)
        neighbours = min(8, len(self._row))
        found = np.reshape(_tree(self._key).query(points_mm, k=neighbours)[1], (len(points_mm), neighbours))
        rows, tied = self._closest(points_mm, self._row[found])
        for point in np.flatnonzero(tied) if neighbours < len(self._row) else ():
            offset = self.position_mm - points_mm[point]
            rows[point] = np.argmin(offset[:, 0] ** 2 + offset[:, 1] ** 2)
        return rows

    def _closest(self, points_mm: Float64Array, candidates: Int64Array) -> tuple[Int64Array, BoolArray]:
        """The closest of some rows (n, k), the lowest on a tie, and whether all are equally close."""
        offset = self.position_mm[candidates] - points_mm[:, None, :]
        square = offset[..., 0] ** 2 + offset[..., 1] ** 2
        best = square == square.min(axis=1, keepdims=True)
        return np.where(best, candidates, len(self.position_mm)).min(axis=1), best.all(axis=1)


@lru_cache(maxsize=4)
def _index(position_mm: bytes) -> tuple[Int64Array, float, Lattice | None, int]:
    """Index a grid by its coordinates: every render and every check of a scene needs the same one."""
    unique_mm, row = _unique(position_mm)
    if len(unique_mm) < 2:
        return row, 0.0, None, 0
    lattice, worst = _fit_lattice(unique_mm, row)
    if lattice is not None and (spacing_mm := _common_gap_mm(lattice, len(row))):
        return row, spacing_mm, lattice, worst
    distance_mm = np.asarray(_tree(position_mm).query(unique_mm, k=2)[0])
    return row, float(np.median(distance_mm[:, 1])), lattice, worst


def _unique(position_mm: bytes) -> tuple[Float64Array, Int64Array]:
    unique_mm, first = np.unique(np.frombuffer(position_mm).reshape(-1, 2), axis=0, return_index=True)
    return unique_mm, first.astype(np.int64)


@lru_cache(maxsize=4)
def _tree(position_mm: bytes) -> cKDTree:
    from scipy.spatial import cKDTree  # 0.15 s of loading that a path on a lattice hardly ever needs

    return cKDTree(_unique(position_mm)[0])


def _fit_lattice(unique_mm: Float64Array, row: Int64Array) -> tuple[Lattice | None, int]:
    """The lattice of the positions, if they lie on one, and the row furthest off it."""
    origin_mm, extent_mm = unique_mm.min(axis=0), np.ptp(unique_mm, axis=0)
    spread = extent_mm[extent_mm > 0]
    about_mm = float(spread.prod() ** (1.0 / len(spread))) / len(unique_mm) ** (1.0 / len(spread))
    pitch_mm = np.full(2, about_mm)  # across a line of positions there is one site
    for axis in (0, 1):
        steps = np.diff(np.unique(unique_mm[:, axis]))
        steps = steps[steps > _LATTICE_SLACK * about_mm]
        if len(steps):
            pitch_mm[axis] = extent_mm[axis] / round(float(extent_mm[axis] / steps.min()))
    site = np.rint((unique_mm - origin_mm) / pitch_mm)
    shape = site.max(axis=0) + 1.0
    off_mm = np.abs(unique_mm - origin_mm - site * pitch_mm).max(axis=1)
    worst = int(row[np.argmax(off_mm)])
    if off_mm.max() > _LATTICE_SLACK * about_mm or shape.prod() > 100 * len(unique_mm) + 10_000:
        return None, worst
    row_at = np.full(shape.astype(np.int64), -1, dtype=np.int64)
    row_at[tuple(site.astype(np.int64).T)] = row
    return Lattice(origin_mm, pitch_mm, row_at), worst


def _common_gap_mm(lattice: Lattice, positions: int) -> float:
    """The smaller pitch, where more than half of the positions have a neighbour at that distance; else 0."""
    there = lattice.row_at >= 0
    has_neighbour = np.zeros_like(there)
    gap_mm = min(lattice.pitch_mm[axis] for axis in (0, 1) if there.shape[axis] > 1)
    for axis in (0, 1):
        if there.shape[axis] > 1 and lattice.pitch_mm[axis] <= gap_mm * (1.0 + _LATTICE_SLACK):
            pair = np.take(there, range(1, there.shape[axis]), axis) & np.take(
                there, range(there.shape[axis] - 1), axis
            )
            ends = [(0, 0), (0, 0)]
            for ends[axis] in ((0, 1), (1, 0)):
                has_neighbour |= np.pad(pair, ends)
    return float(gap_mm) if 2 * np.count_nonzero(has_neighbour) > positions else 0.0
