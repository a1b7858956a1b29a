"""Paths on the surface, each followed by its arc length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.argument_types import check_fields, real_array
from wavefocus.storage.errors import InputError

PointMm = Sequence[float] | Float64Array
"""x and y in millimetres; a path keeps them as a tuple."""

MAX_TURNS = 1e12
"""Of more, numbers do not resolve the angle."""


class Path(Protocol):
    """A curve on the surface, in millimetres, x right and y up, seen from the laser."""

    @property
    def length_mm(self) -> float:
        """Arc length in millimetres, 0 for a point."""

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        """Points at arc lengths in [0, length_mm], float64 (n, 2)."""


@dataclass(frozen=True, slots=True)
class Point:
    """A source that stands still. Raises InputError: a coordinate is not finite."""

    at_mm: PointMm

    def __post_init__(self) -> None:
        object.__setattr__(self, "at_mm", check_point(self.at_mm, "at_mm"))

    @property
    def length_mm(self) -> float:
        return 0.0

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        return np.tile(np.array(self.at_mm, dtype=np.float64), (np.size(arc_length_mm), 1))


@dataclass(frozen=True, slots=True)
class DrawnPath:
    """A path that is drawn as polylines, one after another; base of those below.

    Arc length runs along the strokes only; between two strokes the source jumps. At the joint itself it is already at
    the start of the next stroke. Points that repeat count once.
    """

    length_mm: float = field(init=False, compare=False)
    _starts: Float64Array = field(init=False, repr=False, compare=False)
    _directions: Float64Array = field(init=False, repr=False, compare=False)
    _from_mm: Float64Array = field(init=False, repr=False, compare=False)

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        along = np.atleast_1d(np.asarray(arc_length_mm, dtype=np.float64))
        segment = np.searchsorted(self._from_mm, along, side="right") - 1
        np.clip(segment, 0, len(self._starts) - 1, out=segment)
        rest = along - self._from_mm[segment]
        return np.asarray(self._starts[segment] + self._directions[segment] * rest[:, None])

    def _draw(self, strokes_mm: Sequence[Float64Array]) -> None:
        strokes = [np.asarray(stroke, dtype=np.float64) for stroke in strokes_mm]
        if not strokes:
            raise InputError("a path has no stroke; at least one point is needed")
        for points in strokes:
            if points.ndim != 2 or points.shape[1:] != (2,) or len(points) == 0:
                raise InputError(f"a stroke has shape {points.shape}; expected at least one point (x, y)")
            if not np.isfinite(points).all():
                raise InputError("a path has a coordinate that is not finite; millimetres are expected")
        with np.errstate(over="ignore", under="ignore"):
            direction = np.concatenate([np.diff(points, axis=0) for points in strokes])
            lengths = np.hypot(direction[:, 0], direction[:, 1])
            moving = lengths > 0
            from_mm = np.concatenate([[0.0], np.cumsum(lengths[moving])])
        if not np.isfinite(from_mm[-1]):
            raise InputError("a path is longer than the range of numbers in millimetres")
        start = np.concatenate([points[:-1] for points in strokes])[moving]
        if not len(start):
            start, direction, lengths, moving = strokes[0][:1], np.zeros((1, 2)), np.ones(1), np.ones(1, dtype=bool)
        object.__setattr__(self, "length_mm", float(from_mm[-1]))
        object.__setattr__(self, "_starts", start)
        object.__setattr__(self, "_directions", direction[moving] / lengths[moving, None])
        object.__setattr__(self, "_from_mm", from_mm)


@dataclass(frozen=True, slots=True)
class Strokes(DrawnPath):
    """Polylines, float64 (points, 2) each, in millimetres; InputError: one has no point, or is not finite."""

    strokes_mm: Sequence[Float64Array]

    def __post_init__(self) -> None:
        self._draw(self.strokes_mm)


@dataclass(frozen=True, slots=True)
class Line(DrawnPath):
    """A straight line between two points in millimetres; raises InputError where one is not finite."""

    start_mm: PointMm
    end_mm: PointMm

    def __post_init__(self) -> None:
        for name in ("start_mm", "end_mm"):
            object.__setattr__(self, name, check_point(getattr(self, name), name))
        self._draw([np.array([self.start_mm, self.end_mm], dtype=np.float64)])


@dataclass(frozen=True, slots=True)
class Polyline(DrawnPath):
    """Straight lines from point to point, at least one, in millimetres; a closed one leads back to the first.

    Raises InputError where there is no point, or a coordinate is not finite.
    """

    points_mm: Sequence[PointMm]
    closed: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if not len(self.points_mm):
            raise InputError("points_mm is empty; a polyline needs at least one point")
        points = [check_point(point, "points_mm") for point in self.points_mm]
        object.__setattr__(self, "points_mm", tuple(points))
        if self.closed:
            points.append(points[0])
        self._draw([np.array(points, dtype=np.float64)])


@dataclass(frozen=True, slots=True)
class Circle:
    """An arc of a circle, or several turns of it.

    radius_mm: Radius, >= 0.
    turns: Turns from the start; positive anticlockwise as seen from the laser (y up), negative clockwise.
    start_deg: Direction of the start from the centre, in degrees anticlockwise from x.

    Raises InputError: a figure is not finite, or the radius is negative.
    """

    centre_mm: PointMm
    radius_mm: float
    turns: float = 1.0
    start_deg: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "centre_mm", check_point(self.centre_mm, "centre_mm"))
        if not (math.isfinite(self.radius_mm) and self.radius_mm >= 0):
            raise InputError(f"radius_mm is {self.radius_mm}; it must be a finite number, 0 or above")
        for name in ("turns", "start_deg"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name} is {getattr(self, name)}; it must be a finite number")
        if abs(self.turns) > MAX_TURNS:
            raise InputError(f"turns is {self.turns:g}; at most {MAX_TURNS:g} are allowed")
        if not math.isfinite(self.length_mm):
            raise InputError(f"radius_mm is {self.radius_mm}; the circle is longer than the range of numbers")

    @property
    def length_mm(self) -> float:
        return 2.0 * math.pi * self.radius_mm * abs(self.turns)

    def point_at(self, arc_length_mm: ArrayLike) -> Float64Array:
        along = np.atleast_1d(np.asarray(arc_length_mm, dtype=np.float64))
        turned = along / self.radius_mm if self.radius_mm else np.zeros_like(along)
        angle = math.radians(self.start_deg) + math.copysign(1.0, self.turns) * turned
        x = self.centre_mm[0] + self.radius_mm * np.cos(angle)
        y = self.centre_mm[1] + self.radius_mm * np.sin(angle)
        return np.stack([x, y], axis=1)


def check_point(point: PointMm, name: str) -> tuple[float, float]:
    """Coordinates of a point; raises InputError where they are not two finite numbers."""
    xy = real_array(name, point)
    if xy.shape != (2,) or not np.isfinite(xy).all():
        raise InputError(f"{name} is {point}; two finite numbers (x, y) in millimetres are expected")
    return float(xy[0]), float(xy[1])


MAX_LETTERS = 1000


@dataclass(frozen=True, slots=True)
class TextPath(DrawnPath):
    """The outlines of a line of text; each contour is a closed stroke, and the source jumps between them.

    string: The text, in characters that DejaVu Sans has; it comes with matplotlib.
    height_mm: Height of the drawn outlines' bounding box, > 0.
    centre_mm: Centre of that box, in millimetres.

    Raises InputError: the text is too long, is blank or has a character without an outline, or a figure is out of
    range.
    """

    string: str
    height_mm: float
    centre_mm: PointMm = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self)
        if not (math.isfinite(self.height_mm) and self.height_mm > 0):
            raise InputError(f"height_mm is {self.height_mm}; it must be a finite number above 0")
        object.__setattr__(self, "centre_mm", check_point(self.centre_mm, "centre_mm"))
        if len(self.string) > MAX_LETTERS:
            raise InputError(f"string has {len(self.string)} letters; at most {MAX_LETTERS} are allowed")
        contours = _contours(self.string)
        corners = np.concatenate(contours)
        low, high = corners.min(axis=0), corners.max(axis=0)
        with np.errstate(over="ignore", invalid="ignore"):  # strokes that are not finite are refused
            scale = self.height_mm / (high[1] - low[1])
            self._draw([np.array(self.centre_mm) + scale * (contour - (low + high) / 2) for contour in contours])


def _contours(text: str) -> list[Float64Array]:
    # Imported here because matplotlib takes long to load and only scenes with text need it.
    from matplotlib.font_manager import FontProperties, findfont, get_font
    from matplotlib.path import Path as Outline
    from matplotlib.textpath import TextToPath

    if not text.strip():
        raise InputError(f"string is {text[:60]!r}; it must hold at least one letter")
    properties = FontProperties(family="DejaVu Sans", size=1000)
    known = get_font(findfont(properties)).get_charmap()
    missing = [letter for letter in text if ord(letter) not in known]
    if missing:
        raise InputError(f"string has {missing[0]!r}, which DejaVu Sans cannot draw; use an SVG path for it")
    vertices, codes = TextToPath().get_text_path(properties, text, ismath=False)
    outline = Outline(np.asarray(vertices), np.asarray(codes))
    outline.should_simplify = False
    contours = [np.asarray(polygon, dtype=np.float64) for polygon in outline.to_polygons(closed_only=False)]
    contours = [contour for contour in contours if len(contour) > 1]
    if not contours:
        raise InputError(f"string is {text[:60]!r}; it must hold at least one letter with an outline")
    return contours
