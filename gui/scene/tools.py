"""Tools that draw a path with clicks and drags on the surface."""

from __future__ import annotations

import math
from collections.abc import Callable

from config.scene import CircleTable, LineTable, PathTable, PolylineTable
from gui.scene.draft import NEW_PATHS, PointMm, changed
from gui.scene.handles import rounded


class Tool:
    """A way to draw; `sketch` is the path so far, `done` the finished one."""

    #: Instruction for the user.
    hint = ""

    def __init__(self) -> None:
        self.sketch: PathTable | None = None
        self.done: PathTable | None = None

    def click(self, at: PointMm, reach_mm: float) -> None:
        """Receive a click; points within `reach_mm` count as hit."""
        raise NotImplementedError

    def drag(self, start: PointMm, at: PointMm, *, ended: bool) -> None:
        """Receive a drag that began at `start`."""
        raise NotImplementedError

    def move(self, at: PointMm) -> None:
        """Follow the mouse between clicks."""

    def finish(self) -> None:
        """End the path (double click, Enter)."""

    def back(self) -> None:
        """Undo the last click."""


class PlaceTool(Tool):
    """A path that one click puts in its place.

    Parameters
    ----------
    make : callable
        From a place to the path there.
    """

    hint = "Click its position"

    def __init__(self, make: Callable[[PointMm], PathTable]) -> None:
        super().__init__()
        self._make = make

    def click(self, at: PointMm, reach_mm: float) -> None:
        self.done = self._make(rounded(at))

    def drag(self, start: PointMm, at: PointMm, *, ended: bool) -> None:
        self.sketch = self._make(rounded(at))
        if ended:
            self.done = self.sketch


class TwoPointTool(Tool):
    """A path that two points make: dragged from one to the other, or clicked one after the other.

    Parameters
    ----------
    make : callable
        From two points to a path; None where they are too near.
    hint : str
        What the points are.
    """

    def __init__(self, make: Callable[[PointMm, PointMm], PathTable | None], hint: str) -> None:
        super().__init__()
        self._make, self.hint = make, hint
        self._first: PointMm | None = None

    def click(self, at: PointMm, reach_mm: float) -> None:
        if self._first is None:
            self._first = at
        else:
            self.done = self._make(self._first, at)

    def drag(self, start: PointMm, at: PointMm, *, ended: bool) -> None:
        self._first = None
        self.sketch = self._make(start, at)
        if ended:
            self.done = self.sketch

    def move(self, at: PointMm) -> None:
        if self._first is not None:
            self.sketch = self._make(self._first, at)

    def back(self) -> None:
        self.sketch = self._first = None


class PolylineTool(Tool):
    """Straight lines from click to click."""

    hint = "Click each corner; double click or Enter ends, a click on the first closes, Backspace takes one back"

    def __init__(self) -> None:
        super().__init__()
        self._points: list[PointMm] = []

    def click(self, at: PointMm, reach_mm: float) -> None:
        points = self._points
        if len(points) >= 3 and math.dist(at, points[0]) <= reach_mm:
            self.done = PolylineTable(points_mm=tuple(points), closed=True)
        elif not points or math.dist(at, points[-1]) > 0:
            points.append(rounded(at))
            self.move(at)

    def drag(self, start: PointMm, at: PointMm, *, ended: bool) -> None:
        if not self._points:
            self._points.append(rounded(start))
        self.move(at)
        if ended:
            self.click(at, 0.0)

    def move(self, at: PointMm) -> None:
        if self._points:
            self.sketch = PolylineTable(points_mm=(*self._points, rounded(at)))

    def finish(self) -> None:
        if len(self._points) >= 2:
            self.done = PolylineTable(points_mm=tuple(self._points))

    def back(self) -> None:
        if self._points:
            self._points.pop()
        self.sketch = PolylineTable(points_mm=tuple(self._points)) if self._points else None


def tool_of(kind: str) -> Tool | None:
    """The tool that draws a kind of path; None for those that are chosen from a file."""
    match kind:
        case "point":
            return PlaceTool(lambda at: changed(NEW_PATHS["point"], at_mm=at))
        case "text":
            return PlaceTool(lambda at: changed(NEW_PATHS["text"], centre_mm=at))
        case "line":
            return TwoPointTool(_line, "Drag from start to end, or click both")
        case "circle":
            return TwoPointTool(_circle, "Drag from the centre to the rim, or click both")
        case "polyline":
            return PolylineTool()
    return None


def _line(start: PointMm, end: PointMm) -> PathTable | None:
    start, end = rounded(start), rounded(end)
    return LineTable(start_mm=start, end_mm=end) if start != end else None


def _circle(centre: PointMm, rim: PointMm) -> PathTable | None:
    radius_mm = round(math.dist(centre, rim), 2)
    return CircleTable(centre_mm=rounded(centre), radius_mm=radius_mm) if radius_mm else None
