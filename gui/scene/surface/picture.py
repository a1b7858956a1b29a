"""The items that a scene's canvas draws: ground, snapped positions, paths, sampled points, handles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QRectF, Qt

from gui.scene.draft import CircleDraft, LineDraft, PathDraft, PolylineDraft
from gui.scene.surface.ground import Ground
from gui.scene.surface.handles import Handle
from gui.scene.surface.trace import Trace
from gui.shell.theme import LIGHT, Theme
from gui.surface.view import Spots

Float64Array = NDArray[np.float64]

_COLOURS = 256
_NONE_MM = np.zeros((0, 2))
_CIRCLE_POINTS = 91
_MARK = "#ff7a1a"
_HEAD_PX = 14
_DOT_PX, _SMALL_DOT_PX = 5, 3


def source_colour(theme: Theme, index: int) -> str:
    """The colour of a source's path."""
    return theme.traces[index % len(theme.traces)]


class ScenePicture:
    """Draws into a view box.

    Parameters
    ----------
    box : ViewBox
        Where.
    """

    def __init__(self, box: pyqtgraph.ViewBox) -> None:
        self._box = box
        self._theme = LIGHT
        self._ground: Ground | None = None
        self.colour_map = pyqtgraph.colormap.get("viridis")
        self._cells = pyqtgraph.ImageItem(axisOrder="row-major")
        self._outline = pyqtgraph.PlotCurveItem(antialias=True)
        self._actuators = _spots("t", 9)
        self._dots = _spots("o", _DOT_PX)
        self._off = _spots("x", 7)
        self._starts = _spots("o", 11)
        self._handles = _spots("s", 10)
        self._held = _spots("s", 13)
        self._sketch = pyqtgraph.PlotCurveItem(antialias=True)
        self._lines: list[pyqtgraph.PlotCurveItem] = []
        self._heads: list[pyqtgraph.ArrowItem] = []
        for level, item in enumerate(
            (
                self._cells, self._outline, self._actuators, self._dots, self._off, self._starts, self._sketch,
                self._handles, self._held,
            )
        ):  # fmt: skip
            item.setZValue(10 * level)
            box.addItem(item, ignoreBounds=item is not self._outline)

    def show_ground(self, ground: Ground) -> None:
        """Show another surface."""
        former, self._ground = self._ground, ground
        self._outline.setData(ground.outline_mm[:, 0], ground.outline_mm[:, 1])
        surface = ground.surface
        actuator_mm = _NONE_MM if surface is None else surface.actuator_mm
        known = np.isfinite(actuator_mm).all(axis=1)
        self._actuators.setData(pos=actuator_mm[known])
        if surface is None:
            self._cells.clear()
        self._paint_cells([])
        if former is None or not np.array_equal(former.outline_mm, ground.outline_mm):
            self._box.autoRange()

    def show_traces(self, traces: Sequence[Trace], chosen: int) -> None:
        """Show the sources; the chosen one in front."""
        self._want_lines(len(traces))
        for index, trace in enumerate(traces):
            colour = source_colour(self._theme, index)
            line, head = self._lines[index], self._heads[index]
            line.setData(trace.line_mm[:, 0], trace.line_mm[:, 1], connect="finite")
            line.setPen(pyqtgraph.mkPen(colour, width=2 if index == chosen else 1))
            line.setZValue(29 if index == chosen else 25)
            _point_head(head, trace.line_mm, colour)
        held = [trace for trace in traces if len(trace.points_mm)]
        every = np.concatenate([trace.points_mm for trace in held]) if held else _NONE_MM
        off = np.concatenate([trace.off for trace in held]) if held else np.zeros(0, np.bool_)
        self._dots.setData(pos=every[~off])
        bare = self._ground is None or self._ground.surface is None
        self._dots.setSize(_DOT_PX if bare else _SMALL_DOT_PX)  # the cells beneath have the colours
        if bare and held:
            self._dots.setBrush(self._by_time(traces, np.concatenate([trace.instant_s for trace in held])[~off]))
        else:
            self._dots.setBrush(pyqtgraph.mkBrush(self._theme.text))
        self._off.setData(pos=every[off])
        self._off.setVisible(bool(off.any()))
        self._starts.setData(
            pos=np.array([trace.points_mm[0] for trace in held]).reshape(-1, 2),
            pen=[
                pyqtgraph.mkPen(source_colour(self._theme, index), width=2)
                for index, trace in enumerate(traces)
                if len(trace.points_mm)
            ],
        )
        self._paint_cells(traces)

    def show_handles(self, handles: Sequence[Handle], held: str) -> None:
        """Show what can be taken hold of."""
        at = np.array([handle.at_mm for handle in handles if handle.name != held]).reshape(-1, 2)
        self._handles.setData(pos=at)
        self._held.setData(pos=np.array([one.at_mm for one in handles if one.name == held]).reshape(-1, 2))

    def show_sketch(self, points_mm: Float64Array) -> None:
        """Show a path that is being drawn."""
        self._sketch.setData(points_mm[:, 0], points_mm[:, 1])

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours; the owner shows the traces anew."""
        self._theme = theme
        self._outline.setPen(pyqtgraph.mkPen(theme.faint, width=1))
        self._actuators.setPen(pyqtgraph.mkPen(theme.faint, width=1))
        self._actuators.setBrush(pyqtgraph.mkBrush(theme.base))
        self._dots.setPen(None)
        self._off.setPen(pyqtgraph.mkPen(theme.fault, width=1))
        self._off.setBrush(pyqtgraph.mkBrush(theme.fault))
        self._starts.setBrush(None)
        self._handles.setPen(pyqtgraph.mkPen(_MARK, width=2))
        self._handles.setBrush(pyqtgraph.mkBrush(theme.base))
        self._held.setPen(pyqtgraph.mkPen(theme.text, width=1.5))
        self._held.setBrush(pyqtgraph.mkBrush(_MARK))
        self._sketch.setPen(pyqtgraph.mkPen(_MARK, width=2, style=Qt.PenStyle.DashLine))
        if self._ground is not None:
            self._paint_cells([])

    def _want_lines(self, count: int) -> None:
        while len(self._lines) < count:
            line, head = pyqtgraph.PlotCurveItem(antialias=True), pyqtgraph.ArrowItem(headLen=_HEAD_PX, tipAngle=32)
            head.setZValue(35)
            self._lines.append(line)
            self._heads.append(head)
            self._box.addItem(line, ignoreBounds=True)
            self._box.addItem(head, ignoreBounds=True)
        for surplus in (self._lines, self._heads):
            while len(surplus) > count:
                self._box.removeItem(surplus.pop())

    def _paint_cells(self, traces: Sequence[Trace]) -> None:
        """Positions that are foci in the colour of their first instant, all others faint."""
        ground = self._ground
        if ground is None or ground.surface is None:
            return
        raster, positions = ground.surface.raster, ground.surface.positions
        first = np.full(positions, np.inf)
        for trace in traces:
            if len(trace.rows):
                np.minimum.at(first, trace.rows[~trace.off], trace.instant_s[~trace.off])
        at = np.isfinite(first)
        colours = np.tile(np.array(pyqtgraph.mkColor(self._theme.alternate).getRgb(), np.uint8), (positions + 1, 1))
        colours[-1] = 0
        if ground.usable is not None:
            colours[:-1][ground.usable] = pyqtgraph.mkColor(self._theme.cell).getRgb()
        colours[:-1][at] = self._looked_up(traces, first[at])
        picture = np.take(colours.view(np.uint32).ravel(), raster.index).view(np.uint8).reshape(*raster.index.shape, 4)
        self._cells.setImage(picture, autoLevels=False, levels=None)
        self._cells.setRect(QRectF(raster.left_mm, raster.bottom_mm, raster.width_mm, raster.height_mm))

    def _looked_up(self, traces: Sequence[Trace], instants_s: Float64Array) -> NDArray[np.uint8]:
        low_s, high_s = span_s(traces)
        table: NDArray[np.uint8] = self.colour_map.getLookupTable(nPts=_COLOURS, alpha=True)
        step = (instants_s - low_s) / (high_s - low_s) * (_COLOURS - 1)
        looked_up: NDArray[np.uint8] = table[np.clip(step, 0, _COLOURS - 1).astype(int)]
        return looked_up

    def _by_time(self, traces: Sequence[Trace], instants_s: Float64Array) -> list[pyqtgraph.QtGui.QBrush]:
        brushes = {colour: pyqtgraph.mkBrush(colour) for colour in map(tuple, self._looked_up(traces, instants_s))}
        return [brushes[colour] for colour in map(tuple, self._looked_up(traces, instants_s))]


def span_s(traces: Sequence[Trace]) -> tuple[float, float]:
    """The first and the last focus instant of a scene, apart even where there is one only."""
    instants = [trace.instant_s for trace in traces if len(trace.instant_s)]
    if not instants:
        return 0.0, 1.0
    low_s, high_s = min(float(one.min()) for one in instants), max(float(one.max()) for one in instants)
    return low_s, high_s if high_s > low_s else low_s + 1.0


def sketched(path: PathDraft | None) -> Float64Array:
    """The corners of a path that is being drawn."""
    if isinstance(path, CircleDraft):
        angle = np.linspace(0.0, 2 * np.pi, _CIRCLE_POINTS)
        rim: Float64Array = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return np.array(path.centre_mm) + path.radius_mm * rim
    if isinstance(path, LineDraft):
        return np.array([path.start_mm, path.end_mm])
    return np.array(path.points_mm) if isinstance(path, PolylineDraft) else _NONE_MM


def _spots(symbol: str, size: int) -> Spots:
    return Spots(symbol=symbol, size=size, pxMode=True)


def _point_head(head: pyqtgraph.ArrowItem, line_mm: Float64Array, colour: str) -> None:
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
