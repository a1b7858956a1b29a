"""Outlines of plates: closed curves of straight lines and arcs, points along them, and the region within."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64Array = NDArray[np.float64]
_Pair = tuple[float, float]

Kind = Literal["stadium", "rectangle", "disk", "polygon"]
EDGE_TOLERANCE_MM = 1e-6
"""A point this far outside still counts as on the outline: a nanometre is rounding, not geometry."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight line or, with a centre, an anticlockwise arc of at most half a circle; in mm."""

    start: _Pair
    end: _Pair
    centre: _Pair | None = None

    @property
    def arc(self) -> tuple[float, float, float]:
        """Radius in mm, angle of the start, and angle turned, of an arc."""
        assert self.centre is not None
        (x, y), (cx, cy) = self.start, self.centre
        begin = math.atan2(y - cy, x - cx)
        turned = (math.atan2(self.end[1] - cy, self.end[0] - cx) - begin) % (2 * math.pi)
        return math.hypot(x - cx, y - cy), begin, turned

    @property
    def length_mm(self) -> float:
        """Arc length."""
        if self.centre is None:
            return math.dist(self.start, self.end)
        radius, _, turned = self.arc
        return radius * turned

    def at(self, share: ArrayLike) -> Float64Array:
        """Points (n, 2) at shares (n,) of the length, 0 to 1."""
        share = np.asarray(share, dtype=np.float64)[:, None]
        if self.centre is None:
            return np.asarray((1 - share) * self.start + share * self.end)
        radius, begin, turned = self.arc
        angle = begin + turned * share[:, 0]
        return np.asarray(self.centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))

    def distance_mm(self, point: Float64Array) -> Float64Array:
        """Distance of points (n, 2)."""
        start, end = np.array(self.start), np.array(self.end)
        if self.centre is None:
            along = np.clip((point - start) @ (end - start) / self.length_mm**2, 0.0, 1.0)
            return np.asarray(np.hypot(*(point - start - along[:, None] * (end - start)).T))
        radius, begin, turned = self.arc
        away = point - self.centre
        within = (np.arctan2(away[:, 1], away[:, 0]) - begin) % (2 * math.pi) <= turned
        ends = np.minimum(np.hypot(*(point - start).T), np.hypot(*(point - end).T))
        return np.asarray(np.where(within, np.abs(np.hypot(*away.T) - radius), ends))


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
        if any(math.dist(a.end, b.start) > EDGE_TOLERANCE_MM for a, b in zip(before, self.segments, strict=False)):
            raise ValueError("the segments of an outline must follow each other and close")
        if any(segment.centre is not None and segment.arc[2] > math.pi + 1e-9 for segment in self.segments):
            raise ValueError("an arc of an outline must run anticlockwise, by half a circle at most")
        if self.area_mm2 <= 0:
            raise ValueError("an outline must enclose an area and run anticlockwise")

    @classmethod
    def stadium(cls, length_mm: float, width_mm: float) -> Outline:
        """Rectangle with a half disk at either end, along x, centred; from the middle of the right end."""
        radius, half = width_mm / 2, (length_mm - width_mm) / 2
        right, left = (half + radius, 0.0), (-half - radius, 0.0)
        arcs = (
            Segment(right, (half, radius), (half, 0.0)),
            Segment((half, radius), (-half, radius)),
            Segment((-half, radius), left, (-half, 0.0)),
            Segment(left, (-half, -radius), (-half, 0.0)),
            Segment((-half, -radius), (half, -radius)),
            Segment((half, -radius), right, (half, 0.0)),
        )
        return cls(tuple(segment for segment in arcs if segment.length_mm > 0))

    @classmethod
    def rectangle(cls, length_mm: float, width_mm: float) -> Outline:
        """Rectangle with its length along x, centred; from the middle of the right end."""
        x, y = length_mm / 2, width_mm / 2
        return cls.polygon([(x, 0.0), (x, y), (-x, y), (-x, -y), (x, -y)])

    @classmethod
    def polygon(cls, corners_mm: Sequence[_Pair]) -> Outline:
        """Polygon through corners, anticlockwise."""
        following = (*corners_mm[1:], corners_mm[0])
        return cls(tuple(Segment(a, b) for a, b in zip(corners_mm, following, strict=True)))

    @classmethod
    def of(cls, kind: Kind, length_mm: float, width_mm: float, corners_mm: Sequence[_Pair] | None = None) -> Outline:
        """Outline of a kind: a disk has its length for diameter; a polygon needs corners alone."""
        if kind == "polygon":
            return cls.polygon(corners_mm or ())
        if kind == "rectangle":
            return cls.rectangle(length_mm, width_mm)
        return cls.stadium(length_mm, length_mm if kind == "disk" else width_mm)

    @property
    def perimeter_mm(self) -> float:
        """Length of the curve."""
        return sum(segment.length_mm for segment in self.segments)

    @property
    def area_mm2(self) -> float:
        """Area within, negative where the curve runs clockwise."""
        area = 0.0
        for segment in self.segments:
            (x0, y0), (x1, y1) = segment.start, segment.end
            area += (x0 * y1 - x1 * y0) / 2
            if segment.centre is not None:
                radius, _, turned = segment.arc
                area += radius**2 * (turned - math.sin(turned)) / 2
        return area

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        """Left, bottom, right and top of the curve, to a micrometre."""
        point = self.nodes(self.perimeter_mm / 4000)[0]
        (left, bottom), (right, top) = point.min(axis=0).tolist(), point.max(axis=0).tolist()
        return left, bottom, right, top

    def at(self, arc_mm: ArrayLike) -> Float64Array:
        """Points (n, 2) at arc lengths (n,) from the beginning, at most the perimeter."""
        arc = np.asarray(arc_mm, dtype=np.float64)
        point = np.empty((len(arc), 2))
        before = 0.0
        for segment in self.segments:
            there = (arc >= before) & (arc <= before + segment.length_mm)
            point[there] = segment.at((arc[there] - before) / segment.length_mm)
            before += segment.length_mm
        return point

    def nodes(self, spacing_mm: float) -> tuple[Float64Array, Float64Array]:
        """Points about one spacing apart, all ends of segments among them, and the points half-way to the next."""
        ends, halves = [], []
        for segment in self.segments:
            count = max(1, round(segment.length_mm / spacing_mm))
            share = np.arange(count) / count
            ends.append(segment.at(share))
            halves.append(segment.at(share + 0.5 / count))
        return np.concatenate(ends), np.concatenate(halves)

    def line(self, points: int) -> Float64Array:
        """The closed curve as a line of about so many points, the first repeated at the end."""
        point = self.nodes(self.perimeter_mm / points)[0]
        return np.vstack([point, point[:1]])

    def depth_mm(self, point_mm: ArrayLike) -> Float64Array:
        """Distance of points (..., 2) from the curve, negative outside; NaN where a coordinate is."""
        point = np.asarray(point_mm, dtype=np.float64)
        flat = point.reshape(-1, 2)
        x, y = flat.T
        inside, beyond = np.zeros((2, len(flat)), dtype=bool)
        nearest = np.full(len(flat), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for segment in self.segments:
                (x0, y0), (x1, y1) = segment.start, segment.end
                # Crossings of a ray to the right with the chord; then what lies between chord and arc.
                inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
                if segment.centre is not None:
                    outer = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) <= 0
                    beyond |= outer & (np.hypot(*(flat - segment.centre).T) < segment.arc[0])
                nearest = np.minimum(nearest, segment.distance_mm(flat))
        return np.asarray(np.where(inside | beyond, nearest, -nearest).reshape(point.shape[:-1]))

    def contains(self, point_mm: ArrayLike, margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (..., 2) lie within the curve inset by a margin, its edge included; False for NaN."""
        return np.asarray(self.depth_mm(point_mm) >= margin_mm - EDGE_TOLERANCE_MM)


def default_marks_mm(length_mm: float, width_mm: float) -> tuple[_Pair, ...]:
    """Return seven places that determine a mirror map well: the middle, the corners of a rectangle, and the ends."""
    x_mm, y_mm = 0.32 * length_mm, 0.3 * width_mm
    return ((0.0, 0.0), (x_mm, y_mm), (-x_mm, y_mm), (-x_mm, -y_mm), (x_mm, -y_mm), (0.4 * length_mm, 0.0),
            (-0.4 * length_mm, 0.0))  # fmt: skip
