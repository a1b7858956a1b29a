"""The grid position nearest to a point, and how far away it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

KNOT_SAMPLES = 16
"""Along a path, every 16th point is looked up in the tree; most others follow from their neighbours."""
TIES = 8
TIE_SLACK = 1e-5
"""Share of the pitch within which another position may be as near."""
FURTHEST_MM = 1e100
"""Points are searched for from here at most: the squares of greater distances are beyond all numbers."""


class PositionGrid:
    """The positions of a bank, to be searched by distance.

    Positions that repeat are merged: the lowest index stands for all of them.

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

    def __init__(self, position_mm: ArrayLike) -> None:
        self.position_mm: Float64Array = np.ascontiguousarray(position_mm, dtype=np.float64)
        if self.position_mm.ndim != 2 or self.position_mm.shape[1] != 2 or not len(self.position_mm):
            raise InputError(
                f"position_mm has shape {self.position_mm.shape}; expected (positions, 2), at least one position"
            )
        bad = ~np.isfinite(self.position_mm).all(axis=1)
        if bad.any():
            raise InputError(f"position {int(np.argmax(bad))} has a coordinate that is not finite")
        index = _index(self.position_mm.tobytes())
        self._unique, self._row, self._tree = index.unique_mm, index.row, index.tree
        self._lattice = index.lattice
        self.spacing_mm = index.spacing_mm

    def nearest(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Row of smallest distance (the lower index on a tie) and that distance.

        Parameters
        ----------
        points_mm : float64 array, shape (n, 2)
            Any points; neighbours in the list may be neighbours on the surface, which makes it faster.

        Returns
        -------
        rows : int64 array, shape (n,)
        distance_mm : float64 array, shape (n,)
        """
        count = len(points_mm)
        if self._lattice is not None:
            rows = self._lattice.nearest(points_mm)
            left = np.flatnonzero(rows < 0)
            if len(left):
                rows[left] = self._search(points_mm[left])
        elif count <= 4 * KNOT_SAMPLES or len(self._unique) < 2:
            rows = self._search(points_mm)
        else:
            rows = self._follow(points_mm)
        return rows, _distance(points_mm, self.position_mm[rows])

    def _follow(self, points_mm: Float64Array) -> Int64Array:
        # A point keeps its knot's row for certain while it has moved less than half the knot's lead over
        # the second nearest position.
        knots = np.clip(points_mm[::KNOT_SAMPLES], -FURTHEST_MM, FURTHEST_MM)
        distance, index = self._search_tree(knots, 2)
        lead = np.repeat(distance[:, 1] - distance[:, 0], KNOT_SAMPLES)[: len(points_mm)]
        rows = np.repeat(self._row[index[:, 0]], KNOT_SAMPLES)[: len(points_mm)]
        moved = _distance(points_mm, np.repeat(knots, KNOT_SAMPLES, axis=0)[: len(points_mm)])
        open_points = np.flatnonzero(2.0 * moved >= lead * (1.0 - 1e-9) - 1e-12 * self.spacing_mm)
        if len(open_points):
            rows[open_points] = self._search(points_mm[open_points])
        return rows

    def _search(self, points_mm: Float64Array) -> Int64Array:
        points_mm = np.clip(points_mm, -FURTHEST_MM, FURTHEST_MM)
        neighbours = min(TIES, len(self._unique))
        candidates = self._row[self._search_tree(points_mm, neighbours)[1]]
        offset = self.position_mm[candidates] - points_mm[:, None, :]
        square = offset[..., 0] ** 2 + offset[..., 1] ** 2
        best = square.min(axis=1, keepdims=True)
        rows: Int64Array = np.where(square == best, candidates, len(self.position_mm)).min(axis=1)
        crowded = (square == best).all(axis=1) & (neighbours < len(self._unique))
        for point in np.flatnonzero(crowded):
            offset = self.position_mm - points_mm[point]
            rows[point] = np.argmin(offset[:, 0] ** 2 + offset[:, 1] ** 2)
        return rows

    def _search_tree(self, points_mm: Float64Array, neighbours: int) -> tuple[Float64Array, Int64Array]:
        return _query(self._tree, points_mm, neighbours)


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Positions on the sites of a lattice along x and y, some of which may be empty."""

    origin_mm: Float64Array
    pitch_mm: Float64Array
    row_at: Int64Array
    """Row at each site, (columns, lines), -1 where there is none."""

    def nearest(self, points_mm: Float64Array) -> Int64Array:
        """Row of the nearest site, -1 where it is empty or another is as near."""
        # Axis by axis: there may be very many points, and numpy is slow along an axis of two.
        clear = np.ones(len(points_mm), dtype=bool)
        index = np.zeros(len(points_mm), dtype=np.int64)
        for axis, sites in enumerate(self.row_at.shape):
            place = (points_mm[:, axis] - self.origin_mm[axis]) / self.pitch_mm[axis]
            site = np.rint(place)
            clear &= (np.abs(place - site) < 0.5 - TIE_SLACK) & (site >= 0) & (site < sites)
            index *= sites
            index += np.where(clear, site, 0.0).astype(np.int64)
        rows: Int64Array = np.where(clear, self.row_at.ravel()[index], -1)
        return rows


@dataclass(frozen=True, slots=True)
class _Index:
    """What is worked out once for a grid."""

    unique_mm: Float64Array
    row: Int64Array
    tree: cKDTree
    spacing_mm: float
    lattice: _Lattice | None


@lru_cache(maxsize=4)
def _index(position_mm: bytes) -> _Index:
    """Index a grid by its coordinates: every render and every check of a scene asks for the same one."""
    unique_mm, first = np.unique(np.frombuffer(position_mm).reshape(-1, 2), axis=0, return_index=True)
    row = first.astype(np.int64)
    tree = cKDTree(unique_mm)
    if len(unique_mm) < 2:
        return _Index(unique_mm, row, tree, 0.0, None)
    distance, _ = _query(tree, unique_mm, 2)
    spacing_mm = float(np.median(distance[:, 1]))
    return _Index(unique_mm, row, tree, spacing_mm, _find_lattice(unique_mm, row, spacing_mm))


def _find_lattice(unique_mm: Float64Array, row: Int64Array, spacing_mm: float) -> _Lattice | None:
    extent = np.ptp(unique_mm, axis=0)
    slack = spacing_mm * TIE_SLACK / 10.0
    steps = [np.diff(np.unique(unique_mm[:, axis])) for axis in (0, 1)]
    steps = [step[step > slack] for step in steps]
    # Across a line of positions there is one site.
    sites = [round(float(length / step.min())) if len(step) else 0 for length, step in zip(extent, steps, strict=True)]
    pitch_mm = np.array([length / count if count else spacing_mm for length, count in zip(extent, sites, strict=True)])
    site = np.rint((unique_mm - unique_mm.min(axis=0)) / pitch_mm)
    shape = site.max(axis=0) + 1.0
    off = np.abs(unique_mm - unique_mm.min(axis=0) - site * pitch_mm).max()
    if off > slack or shape.prod() > 100 * len(unique_mm) + 10_000:
        return None
    row_at = np.full(shape.astype(np.int64), -1, dtype=np.int64)
    row_at[tuple(site.astype(np.int64).T)] = row
    return _Lattice(unique_mm.min(axis=0), pitch_mm, row_at)


def _query(tree: cKDTree, points_mm: Float64Array, neighbours: int) -> tuple[Float64Array, Int64Array]:
    distance, index = tree.query(points_mm, k=neighbours)
    shape = (len(points_mm), neighbours)
    return np.reshape(distance, shape), np.reshape(index, shape).astype(np.int64, copy=False)


def _distance(a: Float64Array, b: Float64Array) -> Float64Array:
    with np.errstate(over="ignore"):  # a path may lie anywhere; what is too far is refused
        distance: Float64Array = np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1])
    return distance
