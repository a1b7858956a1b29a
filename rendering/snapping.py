"""The grid position nearest to a point, and how far away it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from calibration.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

KNOT_SAMPLES = 16
"""Along a path, every 16th point is looked up in the tree; most others follow from their neighbours."""
TIES = 8


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
        self.position_mm: Float64Array = np.asarray(position_mm, dtype=np.float64)
        if self.position_mm.ndim != 2 or self.position_mm.shape[1] != 2 or not len(self.position_mm):
            raise InputError(
                f"position_mm has shape {self.position_mm.shape}; expected (positions, 2), at least one position"
            )
        bad = ~np.isfinite(self.position_mm).all(axis=1)
        if bad.any():
            raise InputError(f"position {int(np.argmax(bad))} has a coordinate that is not finite")
        self._unique, first = np.unique(self.position_mm, axis=0, return_index=True)
        self._row: Int64Array = first.astype(np.int64)
        self._tree = cKDTree(self._unique)
        self.spacing_mm = 0.0
        if len(self._unique) > 1:
            distance, _ = self._search_tree(self._unique, 2)
            self.spacing_mm = float(np.median(distance[:, 1]))

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
        if count <= 4 * KNOT_SAMPLES or len(self._unique) < 2:
            rows = self._search(points_mm)
        else:
            rows = self._follow(points_mm)
        return rows, _distance(points_mm, self.position_mm[rows])

    def _follow(self, points_mm: Float64Array) -> Int64Array:
        # A point keeps its knot's row for certain while it has moved less than half the knot's lead over
        # the second nearest position.
        knots = points_mm[::KNOT_SAMPLES]
        distance, index = self._search_tree(knots, 2)
        lead = np.repeat(distance[:, 1] - distance[:, 0], KNOT_SAMPLES)[: len(points_mm)]
        rows = np.repeat(self._row[index[:, 0]], KNOT_SAMPLES)[: len(points_mm)]
        moved = _distance(points_mm, np.repeat(knots, KNOT_SAMPLES, axis=0)[: len(points_mm)])
        open_points = np.flatnonzero(2.0 * moved >= lead * (1.0 - 1e-9) - 1e-12 * self.spacing_mm)
        if len(open_points):
            rows[open_points] = self._search(points_mm[open_points])
        return rows

    def _search(self, points_mm: Float64Array) -> Int64Array:
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
        distance, index = self._tree.query(points_mm, k=neighbours)
        shape = (len(points_mm), neighbours)
        return np.reshape(distance, shape), np.reshape(index, shape).astype(np.int64, copy=False)


def _distance(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.hypot(a[:, 0] - b[:, 0], a[:, 1] - b[:, 1])
