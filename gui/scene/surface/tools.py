"""What draws a path: from clicks and drags on the surface to the path they mean."""

from __future__ import annotations

import math
from collections.abc import Callable

from gui.scene.draft import CircleDraft, LineDraft, PathDraft, PointDraft, PointMm, PolylineDraft, TextDraft

_DECIMALS = 2


class Tool:
    """One way to draw; `sketch` is what it would be now, `done` what it has become."""

    #: What to do with the mouse.
    hint = ""

    def __init__(self) -> None:
        self.sketch: PathDraft | None = None
        self.done: PathDraft | None = None

    def click(self, at: PointMm, reach_mm: float) -> None:
        """Take a click; `reach_mm` is how near counts as there."""
        raise NotImplementedError

    def drag(self, start: PointMm, at: PointMm, *, over: bool) -> None:
        """Take a drag that began at `start`."""
        raise NotImplementedError

    def move(self, at: PointMm) -> None:
        """Follow the mouse between clicks."""

    def finish(self) -> None:
        """Take what is there as it is (double click, Enter)."""

    def back(self) -> None:
        """Take the last click back."""

    def cancel(self) -> None:
        """Begin anew."""
        self.sketch = self.done = None


class PlaceTool(Tool):
    """A path that one click puts in its place.

    Parameters
    ----------
    make : callable
        From a place to the path there.
    """

    hint = "Click where it shall be"

    def __init__(self, make: Callable[[PointMm], PathDraft]) -> None:
        super().__init__()
        self._make = make

    def click(self, at: PointMm, reach_mm: float) -> None:
        self.done = self._make(_round(at))

    def drag(self, start: PointMm, at: PointMm, *, over: bool) -> None:
        self.sketch = self._make(_round(at))
        if over:
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

    def __init__(self, make: Callable[[PointMm, PointMm], PathDraft | None], hint: str) -> None:
        super().__init__()
        self._make, self.hint = make, hint
        self._first: PointMm | None = None

    def click(self, at: PointMm, reach_mm: float) -> None:
        if self._first is None:
            self._first = at
        else:
            self.done = self._make(self._first, at)

    def drag(self, start: PointMm, at: PointMm, *, over: bool) -> None:
        self._first = None
        self.sketch = self._make(start, at)
        if over:
            self.done = self.sketch

    def move(self, at: PointMm) -> None:
        if self._first is not None:
            self.sketch = self._make(self._first, at)

    def back(self) -> None:
        self.cancel()

    def cancel(self) -> None:
        super().cancel()
        self._first = None


class PolylineTool(Tool):
    """Straight lines from click to click."""

    hint = "Click each corner; double click or Enter ends, a click on the first closes, Backspace takes one back"

    def __init__(self) -> None:
        super().__init__()
        self._points: list[PointMm] = []

    def click(self, at: PointMm, reach_mm: float) -> None:
        points = self._points
        if len(points) >= 3 and math.dist(at, points[0]) <= reach_mm:
            self.done = PolylineDraft(tuple(points), closed=True)
        elif not points or math.dist(at, points[-1]) > 0:
            points.append(_round(at))
            self.move(at)

    def drag(self, start: PointMm, at: PointMm, *, over: bool) -> None:
        if not self._points:
            self._points.append(_round(start))
        self.move(at)
        if over:
            self.click(at, 0.0)

    def move(self, at: PointMm) -> None:
        if self._points:
            self.sketch = PolylineDraft((*self._points, _round(at)))

    def finish(self) -> None:
        if len(self._points) >= 2:
            self.done = PolylineDraft(tuple(self._points))

    def back(self) -> None:
        if self._points:
            self._points.pop()
        self.sketch = PolylineDraft(tuple(self._points)) if self._points else None

    def cancel(self) -> None:
        super().cancel()
        self._points = []


def tool_of(kind: str) -> Tool | None:
    """The tool that draws a kind of path; None for those that are chosen from a file."""
    match kind:
        case "point":
            return PlaceTool(PointDraft)
        case "text":
            return PlaceTool(lambda at: TextDraft(centre_mm=at))
        case "line":
            return TwoPointTool(_line, "Drag from start to end, or click both")
        case "circle":
            return TwoPointTool(_circle, "Drag from the centre to the rim, or click both")
        case "polyline":
            return PolylineTool()
    return None


def _line(start: PointMm, end: PointMm) -> PathDraft | None:
    start, end = _round(start), _round(end)
    return LineDraft(start, end) if start != end else None


def _circle(centre: PointMm, rim: PointMm) -> PathDraft | None:
    radius_mm = round(math.dist(centre, rim), _DECIMALS)
    return CircleDraft(_round(centre), radius_mm) if radius_mm else None


def _round(at: PointMm) -> PointMm:
    return round(at[0], _DECIMALS) + 0.0, round(at[1], _DECIMALS) + 0.0
