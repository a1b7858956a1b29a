"""Items of the scene's canvas: coloured foci, paths with arrow heads, sampled points, handles, the path being drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt

from config.scene import CircleTable, LineTable, PathTable, PolylineTable
from gui.scene.preview import Ground, Trace
from gui.scene.tools import Handle
from gui.surface_view import MARK, Spots, SurfaceView, looked_up, rgba
from gui.theme import LIGHT, Theme

Float64Array = NDArray[np.float64]

_NONE_MM = np.zeros((0, 2))
_CIRCLE_POINTS = 91
_HEAD_PX = 14
_DOT_PX, _SMALL_DOT_PX = 5, 3


def source_colour(theme: Theme, index: int) -> str:
    """Return the colour of a source's path."""
    return theme.traces[index % len(theme.traces)]


class SceneItems:
    """Draws a scene into a surface view."""

    def __init__(self, view: SurfaceView) -> None:
        self._view = view
        self._theme = LIGHT
        self.colour_map = pyqtgraph.colormap.get("viridis")
        self._dots = Spots(symbol="o", size=_DOT_PX)
        self._off = Spots(symbol="x", size=7)
        self._starts = Spots(symbol="o", size=11)
        self._sketch = pyqtgraph.PlotCurveItem(antialias=True)
        self._handles = Spots(symbol="s", size=10)
        self._held = Spots(symbol="s", size=13)
        self._lines: list[pyqtgraph.PlotCurveItem] = []
        self._heads: list[pyqtgraph.ArrowItem] = []
        items = (self._dots, self._off, self._starts, self._sketch, self._handles, self._held)
        for level, item in enumerate(items):
            view.add_item(item, 30 + 10 * level)

    def show_traces(self, traces: Sequence[Trace], chosen: int, ground: Ground) -> None:
        """Show the sources, the chosen one in front."""
        self._make_lines(len(traces))
        for index, trace in enumerate(traces):
            colour = source_colour(self._theme, index)
            line, head = self._lines[index], self._heads[index]
            line.setData(trace.line_mm[:, 0], trace.line_mm[:, 1], connect="finite")
            line.setPen(pyqtgraph.mkPen(colour, width=2 if index == chosen else 1))
            line.setZValue(29 if index == chosen else 25)
            _place_head(head, trace.line_mm, colour)
        drawn = [trace for trace in traces if len(trace.points_mm)]
        points_mm = np.concatenate([_NONE_MM, *(trace.points_mm for trace in drawn)])
        off = np.concatenate([np.zeros(0, np.bool_), *(trace.off for trace in drawn)])
        self._dots.setData(pos=points_mm[~off])
        if ground.surface is None and drawn:
            instant_s = np.concatenate([trace.instant_s for trace in drawn])[~off]
            colours = looked_up(self.colour_map, instant_s, span_s(traces), self._theme.cell)
            self._dots.setSize(_DOT_PX)
            self._dots.setBrush([pyqtgraph.mkBrush(*colour) for colour in colours.tolist()])
        else:  # the cells below have the colours
            self._dots.setSize(_SMALL_DOT_PX)
            self._dots.setBrush(pyqtgraph.mkBrush(self._theme.text))
        self._off.setData(pos=points_mm[off])
        self._off.setVisible(bool(off.any()))
        pens = [
            pyqtgraph.mkPen(source_colour(self._theme, index), width=2)
            for index, trace in enumerate(traces)
            if len(trace.points_mm)
        ]
        self._starts.setData(pos=np.array([trace.points_mm[0] for trace in drawn]).reshape(-1, 2), pen=pens)
        self._paint_cells(traces, ground)

    def show_handles(self, handles: Sequence[Handle], held: str) -> None:
        """Show the handles; the one named `held` is filled."""
        self._handles.setData(pos=np.array([one.at_mm for one in handles if one.name != held]).reshape(-1, 2))
        self._held.setData(pos=np.array([one.at_mm for one in handles if one.name == held]).reshape(-1, 2))

    def show_sketch(self, points_mm: Float64Array) -> None:
        """Show a path that is being drawn."""
        self._sketch.setData(points_mm[:, 0], points_mm[:, 1])

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours; the owner shows the traces again."""
        self._theme = theme
        for item, pen, brush in (
            (self._dots, None, None),
            (self._off, pyqtgraph.mkPen(theme.fault, width=1), theme.fault),
            (self._starts, None, None),
            (self._handles, pyqtgraph.mkPen(MARK, width=2), theme.base),
            (self._held, pyqtgraph.mkPen(theme.text, width=1.5), MARK),
        ):
            item.setPen(pen)
            item.setBrush(None if brush is None else pyqtgraph.mkBrush(brush))
        self._sketch.setPen(pyqtgraph.mkPen(MARK, width=2, style=Qt.PenStyle.DashLine))

    def _make_lines(self, count: int) -> None:
        while len(self._lines) < count:
            self._lines.append(pyqtgraph.PlotCurveItem(antialias=True))
            self._heads.append(pyqtgraph.ArrowItem(headLen=_HEAD_PX, tipAngle=32))
            self._view.add_item(self._lines[-1], 25)
            self._view.add_item(self._heads[-1], 35)
        for surplus in (self._lines, self._heads):
            while len(surplus) > count:
                self._view.box.removeItem(surplus.pop())

    def _paint_cells(self, traces: Sequence[Trace], ground: Ground) -> None:
        """Colour positions that are foci by their first instant; all others are faint."""
        if ground.surface is None or ground.usable is None:
            return
        first_s = np.full(ground.surface.positions, np.inf)
        for trace in traces:
            if len(trace.rows):
                np.minimum.at(first_s, trace.rows[~trace.off], trace.instant_s[~trace.off])
        colours = looked_up(self.colour_map, first_s, span_s(traces), self._theme.cell)
        colours[~ground.usable & ~np.isfinite(first_s)] = rgba(self._theme.alternate)
        self._view.paint(colours)


def span_s(traces: Sequence[Trace]) -> tuple[float, float]:
    """Return the first and the last focus instant of a scene; they differ also where there is only one."""
    instants = [trace.instant_s for trace in traces if len(trace.instant_s)]
    if not instants:
        return 0.0, 1.0
    low_s, high_s = min(float(one.min()) for one in instants), max(float(one.max()) for one in instants)
    return low_s, high_s if high_s > low_s else low_s + 1.0


def sketched(path: PathTable | None) -> Float64Array:
    """Return the corners of a path that is being drawn."""
    if isinstance(path, CircleTable):
        angle = np.linspace(0.0, 2 * np.pi, _CIRCLE_POINTS)
        rim: Float64Array = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.array(path.centre_mm) + path.radius_mm * rim
    if isinstance(path, LineTable):
        return np.array([path.start_mm, path.end_mm])
    return np.array(path.points_mm) if isinstance(path, PolylineTable) else _NONE_MM


def _place_head(head: pyqtgraph.ArrowItem, line_mm: Float64Array, colour: str) -> None:
    """Put an arrow head a quarter along the path."""
    step_mm = np.hypot(*np.diff(line_mm, axis=0).T)
    along_mm = np.nancumsum(step_mm)
    head.setVisible(bool(len(along_mm) and along_mm[-1] > 0))
    if not head.isVisible():
        return
    at = int(np.searchsorted(along_mm, 0.25 * along_mm[-1]))
    while at < len(step_mm) - 1 and not step_mm[at] > 0:
        at += 1
    tail, tip = line_mm[at], line_mm[at + 1]
    angle = float(np.degrees(np.arctan2(tip[1] - tail[1], tip[0] - tail[0])))
    head.setStyle(angle=180.0 - angle, brush=colour, pen=None)  # an angle of 0 points to the left, and y is down
    head.setPos(float(tip[0]), float(tip[1]))
