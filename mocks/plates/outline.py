"""Outlines of plates: closed curves of straight lines and arcs, their nodes and the region within."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64Array = NDArray[np.float64]

FINE_MM = 0.1
"""Spacing of the polygon that decides which points lie within."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight line (radius 0) or a circular arc, anticlockwise.

    Parameters
    ----------
    start_mm, end_mm : tuple of float
        Its ends.
    centre_mm : tuple of float, optional
        Centre of an arc; a line has none. An arc runs anticlockwise by at most a full turn.
    """

    start_mm: tuple[float, float]
    end_mm: tuple[float, float]
    centre_mm: tuple[float, float] | None = None

    @property
    def _arc(self) -> tuple[float, float, float]:
        """Radius, angle of the start, and angle turned."""
        assert self.centre_mm is not None
        (x, y), (cx, cy) = self.start_mm, self.centre_mm
        begin = math.atan2(y - cy, x - cx)
        turned = (math.atan2(self.end_mm[1] - cy, self.end_mm[0] - cx) - begin) % (2 * math.pi)
        return math.hypot(x - cx, y - cy), begin, turned if turned > 1e-9 else 2 * math.pi

    @property
    def length_mm(self) -> float:
        """Arc length."""
        if self.centre_mm is None:
            return math.dist(self.start_mm, self.end_mm)
        radius, _, turned = self._arc
        return radius * turned

    def at(self, share: ArrayLike) -> Float64Array:
        """Points (n, 2) at shares of the length, 0 to 1."""
        share = np.asarray(share, dtype=np.float64)[:, None]
        if self.centre_mm is None:
            return np.asarray((1 - share) * self.start_mm + share * self.end_mm)
        radius, begin, turned = self._arc
        angle = begin + turned * share[:, 0]
        return np.asarray(self.centre_mm + radius * np.column_stack([np.cos(angle), np.sin(angle)]))


@dataclass(frozen=True, slots=True)
class Outline:
    """A closed curve without crossings, anticlockwise. Raises ValueError.

    Parameters
    ----------
    segments : tuple of Segment
        Each begins where the one before ends; corners are only between them.
    """

    segments: tuple[Segment, ...]

    def __post_init__(self) -> None:
        before = (self.segments[-1], *self.segments)
        if any(math.dist(a.end_mm, b.start_mm) > 1e-6 for a, b in zip(before, self.segments, strict=False)):
            raise ValueError("the segments of an outline must follow each other and close")
        if self.area_mm2 <= 0:
            raise ValueError("an outline must enclose an area and run anticlockwise")

    @classmethod
    def stadium(cls, length_mm: float, width_mm: float) -> Outline:
        """Rectangle with a half disk at either end, its long side along x, centred on the origin."""
        radius, half = width_mm / 2, (length_mm - width_mm) / 2
        if half <= 0:
            return cls.disk(radius)
        a, b, c, d = (-half, -radius), (half, -radius), (half, radius), (-half, radius)
        return cls((Segment(a, b), Segment(b, c, (half, 0.0)), Segment(c, d), Segment(d, a, (-half, 0.0))))

    @classmethod
    def disk(cls, radius_mm: float) -> Outline:
        """Circle around the origin."""
        right, left = (radius_mm, 0.0), (-radius_mm, 0.0)
        return cls((Segment(right, left, (0.0, 0.0)), Segment(left, right, (0.0, 0.0))))

    @classmethod
    def polygon(cls, corner_mm: Sequence[tuple[float, float]]) -> Outline:
        """Polygon through corners, anticlockwise."""
        following = (*corner_mm[1:], corner_mm[0])
        return cls(tuple(Segment(a, b) for a, b in zip(corner_mm, following, strict=True)))

    @classmethod
    def rectangle(cls, length_mm: float, width_mm: float) -> Outline:
        """Rectangle centred on the origin, its long side along x."""
        x, y = length_mm / 2, width_mm / 2
        return cls.polygon([(-x, -y), (x, -y), (x, y), (-x, y)])

    @property
    def area_mm2(self) -> float:
        """Area within, negative where the curve runs clockwise."""
        x, y = self.nodes(FINE_MM)[0].T
        return float(0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))

    def nodes(self, spacing_mm: float) -> tuple[Float64Array, Float64Array]:
        """Return points along the curve about one spacing apart, and the points half-way to the next; (n, 2) each."""
        ends, halves = [], []
        for segment in self.segments:
            count = max(1, round(segment.length_mm / spacing_mm))
            share = np.arange(count) / count
            ends.append(segment.at(share))
            halves.append(segment.at(share + 0.5 / count))
        return np.concatenate(ends), np.concatenate(halves)

    def depth_mm(self, point_mm: ArrayLike) -> Float64Array:
        """Distance of points (n, 2) from the curve to 0.1 mm, negative outside."""
        from scipy.spatial import cKDTree

        point = np.asarray(point_mm, dtype=np.float64)
        fine = self.nodes(FINE_MM)[0]
        distance, _ = cKDTree(fine).query(point)
        (x0, y0), (x1, y1) = fine.T, np.roll(fine, -1, axis=0).T
        within = np.empty(len(point), dtype=bool)
        for place, (x, y) in enumerate(point.tolist()):
            # Crossings of a ray to the right.
            straddles = (y0 > y) != (y1 > y)
            crossing = x0[straddles] + (y - y0[straddles]) / (y1 - y0)[straddles] * (x1 - x0)[straddles]
            within[place] = np.count_nonzero(crossing > x) % 2 == 1
        return np.where(within, distance, -distance)
