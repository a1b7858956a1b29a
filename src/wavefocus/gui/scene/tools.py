"""Tools that draw a path with clicks and drags, and the handles that shape it afterwards."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from wavefocus.config.scene import (
    CircleTable,
    LineTable,
    PathTable,
    PointTable,
    PolylineTable,
    SvgTable,
    TextTable,
    TrajectoryTable,
)
from wavefocus.gui.scene.draft import NEW_PATHS, PointMm, changed

Box = tuple[PointMm, PointMm]

QUIET = "quiet"
"""The tool that draws quiet places; the other tools are kinds of paths."""
_MIN_MM = 0.1
# As fine as any stage or laser spot; files stay short and readable.
_DECIMALS = 2
_SCALE_FIGURES = 5
# A polyline of more vertices is moved as a whole.
_MAX_VERTICES = 500
_POLYLINE_HINT = "Click each corner; double click or Enter ends, a click on the first closes, Backspace takes one back"


@dataclass(frozen=True, slots=True)
class Handle:
    """A point of a path that can be dragged.

    name: ``"centre"``, ``"radius"``, or a vertex's number.
    at_mm: Position.
    words: Effect of dragging it.
    """

    name: str
    at_mm: PointMm
    words: str


def handles_of(path: PathTable, box: Box | None = None) -> list[Handle]:
    """Handles of a path; `box` holds the lower left and upper right corner of what is drawn, where that is known."""
    match path:
        case PointTable():
            return [Handle("at", path.at_mm, "moves the point")]
        case LineTable():
            return [Handle("start", path.start_mm, "moves the start"), Handle("end", path.end_mm, "moves the end")]
        case CircleTable():
            return _circle_handles(path)
        case PolylineTable():
            points = path.points_mm if len(path.points_mm) <= _MAX_VERTICES else ()
            return [Handle(str(index), at, f"moves vertex {index}") for index, at in enumerate(points)]
        case TextTable(centre_mm=(x, y)):
            height = Handle("height", (x, y + path.height_mm / 2), "sets the height")
            return [Handle("centre", (x, y), "moves the text"), height]
        case TrajectoryTable():
            return []
    origin = Handle("origin", path.origin_mm, "moves the drawing")
    corner = _far_corner(path, box)
    return [origin] if corner is None else [origin, Handle("scale", corner, "sets the scale")]


def with_handle_at(path: PathTable, name: str, to_mm: PointMm, box: Box | None = None) -> PathTable:
    """The path after a handle was moved to a place."""
    to_mm = rounded(to_mm)
    if isinstance(path, PolylineTable):
        index = int(name)
        return changed(path, points_mm=(*path.points_mm[:index], to_mm, *path.points_mm[index + 1 :]))
    if isinstance(path, CircleTable) and name != "centre":
        return _turned(path, name, to_mm)
    if isinstance(path, TextTable) and name == "height":
        return changed(path, height_mm=max(_MIN_MM, round(2 * abs(to_mm[1] - path.centre_mm[1]), _DECIMALS)))
    if isinstance(path, SvgTable) and name == "scale":
        return _scaled(path, to_mm, box)
    return changed(path, **{f"{name}_mm": to_mm})


def shifted(path: PathTable, by_mm: PointMm) -> PathTable:
    """The path moved as a whole; a trajectory stays where its file says."""
    if isinstance(path, TrajectoryTable):
        return path
    if isinstance(path, PolylineTable):
        return changed(path, points_mm=tuple(_plus(at, by_mm) for at in path.points_mm))
    if isinstance(path, LineTable):
        return changed(path, start_mm=_plus(path.start_mm, by_mm), end_mm=_plus(path.end_mm, by_mm))
    key = _anchor_key(path)
    return changed(path, **{key: _plus(getattr(path, key), by_mm)})


def _anchor_key(path: PathTable) -> str:
    """The key of a path that says where it is as a whole."""
    return next(key for key in ("at_mm", "centre_mm", "origin_mm", "start_mm") if hasattr(path, key))


def anchor_of(path: PathTable) -> PointMm:
    """The point of a path that snaps when all of it is moved."""
    if isinstance(path, TrajectoryTable):
        return 0.0, 0.0
    if isinstance(path, PolylineTable):
        return path.points_mm[0]
    at: PointMm = getattr(path, _anchor_key(path))
    return at


def with_vertex(path: PolylineTable, at_mm: PointMm) -> PolylineTable:
    """The polyline with a vertex more, on the segment nearest to a point."""
    points = path.points_mm
    ends = [*points[1:], points[0]] if path.closed else list(points[1:])
    nearest = min(range(len(ends)), key=lambda index: _distance(at_mm, points[index], ends[index]))
    return changed(path, points_mm=(*points[: nearest + 1], rounded(at_mm), *points[nearest + 1 :]))


def without_vertex(path: PolylineTable, index: int) -> PolylineTable:
    """The polyline with a vertex less; two stay."""
    if len(path.points_mm) <= 2:
        return path
    return changed(path, points_mm=(*path.points_mm[:index], *path.points_mm[index + 1 :]))


def box_of(points: Sequence[Sequence[float]]) -> Box:
    """The lower left and upper right corner of some points, at least one."""
    xs, ys = [at[0] for at in points], [at[1] for at in points]
    return (min(xs), min(ys)), (max(xs), max(ys))


def _circle_handles(path: CircleTable) -> list[Handle]:
    way = math.copysign(90.0, path.turns)
    handles = [
        Handle("centre", path.centre_mm, "moves the circle"),
        Handle("start", _on_rim(path, path.start_deg), "turns the start"),
        Handle("radius", _on_rim(path, path.start_deg + way), "sets the radius"),
    ]
    if path.turns % 1.0:
        handles.insert(1, Handle("end", _on_rim(path, path.start_deg + 360.0 * path.turns), "sets how far it goes"))
    return handles


def _on_rim(path: CircleTable, direction_deg: float) -> PointMm:
    angle = math.radians(direction_deg)
    x, y = path.centre_mm
    return x + path.radius_mm * math.cos(angle), y + path.radius_mm * math.sin(angle)


def _turned(path: CircleTable, name: str, to_mm: PointMm) -> CircleTable:
    x, y = to_mm[0] - path.centre_mm[0], to_mm[1] - path.centre_mm[1]
    if name == "radius":
        return changed(path, radius_mm=max(_MIN_MM, round(math.hypot(x, y), _DECIMALS)))
    direction_deg = math.degrees(math.atan2(y, x)) if x or y else path.start_deg
    if name == "start":
        return changed(path, start_deg=round(direction_deg % 360.0, 1))
    # The end keeps to its turn: going past the start makes a whole turn more or less, however it is dragged.
    turned = (direction_deg - path.start_deg) / 360.0
    turned += round(path.turns - turned)
    return changed(path, turns=round(turned, 4) or path.turns)


def _far_corner(path: SvgTable, box: Box | None) -> PointMm | None:
    if box is None:
        return None
    (left, bottom), (right, top) = box
    x, y = path.origin_mm
    corner = max(((a, b) for a in (left, right) for b in (bottom, top)), key=lambda at: math.dist(at, (x, y)))
    return corner if math.dist(corner, (x, y)) > _MIN_MM else None


def _scaled(path: SvgTable, to_mm: PointMm, box: Box | None) -> SvgTable:
    corner = _far_corner(path, box)
    if corner is None:
        return path
    x, y = path.origin_mm
    away = corner[0] - x, corner[1] - y
    along = ((to_mm[0] - x) * away[0] + (to_mm[1] - y) * away[1]) / (away[0] ** 2 + away[1] ** 2)
    scale = float(f"{path.scale * max(along, 1e-3):.{_SCALE_FIGURES}g}")
    return changed(path, scale=scale)


def _plus(at_mm: PointMm, by_mm: PointMm) -> PointMm:
    return rounded((at_mm[0] + by_mm[0], at_mm[1] + by_mm[1]))


def rounded(at_mm: PointMm) -> PointMm:
    """Return a point as files have it."""
    return round(at_mm[0], _DECIMALS) + 0.0, round(at_mm[1], _DECIMALS) + 0.0


def _distance(at: PointMm, start: PointMm, end: PointMm) -> float:
    along = (end[0] - start[0], end[1] - start[1])
    square = along[0] ** 2 + along[1] ** 2
    part = ((at[0] - start[0]) * along[0] + (at[1] - start[1]) * along[1]) / square if square else 0.0
    part = min(max(part, 0.0), 1.0)
    return math.dist(at, (start[0] + part * along[0], start[1] + part * along[1]))


class Tool:
    """Draws a path by clicks on its points, or by a drag from one point to the next.

    make: From the points to the path; None where they are too near.
    hint: Instruction for the user.
    count: Number of points of the path; None for as many as are clicked.

    sketch, done: The path so far, and the finished one.
    """

    def __init__(self, make: Callable[..., PathTable | None], hint: str, count: int | None) -> None:
        self._make, self.hint, self._count = make, hint, count
        self._points: list[PointMm] = []
        self.sketch: PathTable | None = None
        self.done: PathTable | None = None

    def click(self, at: PointMm, reach_mm: float) -> None:
        """Receive a click; points within `reach_mm` count as hit."""
        points = self._points
        if self._count is None and len(points) >= 3 and math.dist(at, points[0]) <= reach_mm:
            self.done = PolylineTable(points_mm=tuple(points), closed=True)
        elif not points or rounded(at) != points[-1]:
            points.append(rounded(at))
            if len(points) == self._count:
                self.done = self._make(*points)
            self.move(at)

    def drag(self, start: PointMm, at: PointMm, *, ended: bool) -> None:
        """Receive a drag that began at `start`."""
        if self._count is None:
            self._points = self._points or [rounded(start)]
            self.move(at)
            if ended:
                self.click(at, 0.0)
            return
        self._points = []
        self.sketch = self._make(*(rounded(start), rounded(at))[-self._count :])
        if ended:
            self.done = self.sketch

    def move(self, at: PointMm) -> None:
        """Follow the mouse between clicks."""
        if self._points and not self.done:
            self.sketch = self._make(*self._points, rounded(at))

    def finish(self) -> None:
        """End the path (double click, Enter)."""
        if self._count is None and len(self._points) >= 2:
            self.done = self._make(*self._points)

    def back(self) -> None:
        """Undo the last click."""
        del self._points[-1:]
        self.sketch = self._make(*self._points) if self._count is None and self._points else None


def tool_of(kind: str) -> Tool:
    """The tool that draws a kind of path; there is none for those that are chosen from a file."""
    return {
        "point": lambda: Tool(lambda at: changed(NEW_PATHS["point"], at_mm=at), "Click its position", 1),
        QUIET: lambda: Tool(lambda at: changed(NEW_PATHS["point"], at_mm=at), "Click the place to keep quiet", 1),
        "text": lambda: Tool(lambda at: changed(NEW_PATHS["text"], centre_mm=at), "Click its position", 1),
        "line": lambda: Tool(_line, "Drag from start to end, or click both", 2),
        "circle": lambda: Tool(_circle, "Drag from the centre to the rim, or click both", 2),
        "polyline": lambda: Tool(lambda *points: PolylineTable(points_mm=points), _POLYLINE_HINT, None),
    }[kind]()


def _line(start: PointMm, end: PointMm) -> PathTable | None:
    return LineTable(start_mm=start, end_mm=end) if start != end else None


def _circle(centre: PointMm, rim: PointMm) -> PathTable | None:
    radius_mm = round(math.dist(centre, rim), _DECIMALS)
    return CircleTable(centre_mm=centre, radius_mm=radius_mm) if radius_mm else None
