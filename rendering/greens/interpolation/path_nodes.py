"""Places along a path between which a moving source's Green's functions are interpolated in arc length."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from rendering.scene.paths import Circle, Path

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

STENCIL = 4
"""Nodes that make one point: a cubic polynomial in arc length."""
CUBIC_ERROR = 0.0177
"""Rms error of that polynomial for exp(j k s) between its middle nodes, over (k spacing)**4: the root of the mean of
((t + 1) t (t - 1) (t - 2) / 24)**2 over 0 < t < 1."""
TURN_RAD = 0.1
LOOKS_PER_SPACING = 4
"""A path is looked at so often; where it turns by more from look to look it has a corner or a gap."""
NARROWINGS = 40
INSET = 1e-6
MOST_LOOKS = 4_000_000


def node_spacing_mm(wavenumber_rad_mm: float, error: float) -> float:
    """Spacing at which a wave along the path is interpolated with an error."""
    return float((error / CUBIC_ERROR) ** (1.0 / STENCIL) / wavenumber_rad_mm)


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
        self._first: list[int] = []
        self._count: list[int] = []
        for begin, end in itertools.pairwise(breaks.tolist()):
            # No last step of next to nothing: polynomials through places that all but meet are worth nothing.
            steps = max(int(np.ceil((end - begin) / spacing_mm - 1e-3)), 1)
            step = spacing_mm if turn_mm > 0 else (end - begin) / steps
            nodes = np.append(begin + step * np.arange(steps), end)
            # A corner is exact to rounding: its two nodes lie safely on their own sides of it.
            nodes[0] += INSET * step if begin > 0 else 0.0
            nodes[-1] -= INSET * step if end < path.length_mm else 0.0
            self._first.append(sum(self._count))
            self._count.append(steps + 1)
            parts.append(nodes)
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
            first, count = self._first[number], self._count[number]
            mine = self.arc_length_mm[first : first + count]
            width = min(STENCIL, count)
            low = np.searchsorted(mine, arc_length_mm[chosen], side="right") - width // 2
            low = np.clip(low, 0, count - width)
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
    looks = min(int(np.ceil(path.length_mm / spacing_mm * LOOKS_PER_SPACING)) + 2, MOST_LOOKS)
    along = np.linspace(0.0, path.length_mm, looks)
    points = path.point_at(along)
    step_mm = along[1]
    bend_mm = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
    found: list[float] = []
    for index in np.flatnonzero(bend_mm > TURN_RAD * step_mm).tolist():
        corner = _narrowed(path, float(along[index]), float(along[index + 2]))
        inside = 1e-6 * step_mm < corner < path.length_mm - 1e-6 * step_mm
        # One corner bends two neighbouring looks.
        if inside and (not found or corner > found[-1] + 1e-3 * step_mm):
            found.append(corner)
    return np.array(found)


def _narrowed(path: Path, begin: float, end: float) -> float:
    """Arc length of the strongest bend between two others."""
    for _ in range(NARROWINGS):
        if end - begin < 1e-9 * path.length_mm:
            break
        along = np.linspace(begin, end, 9)
        points = path.point_at(along)
        bend = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
        sharpest = 1 + int(np.argmax(bend))
        begin, end = float(along[sharpest - 1]), float(along[sharpest + 1])
    return 0.5 * (begin + end)
