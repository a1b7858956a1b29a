"""The surface that scenes are drawn on: paths are drawn, chosen, moved and shaped with mouse and keyboard."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QMouseEvent

from wavefocus.config.scene import CircleTable, LineTable, PathTable, PointTable, PolylineTable, QuietTable
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import PointMm, changed
from wavefocus.gui.scene.preview import Backdrop, LivePreview, Trace
from wavefocus.gui.scene.tools import (
    QUIET,
    Box,
    Handle,
    Tool,
    anchor_of,
    box_of,
    handles_of,
    rounded,
    shifted,
    tool_of,
    with_handle_at,
    with_vertex,
    without_vertex,
)
from wavefocus.gui.surface_view import MARK, STEPS, Keys, Spots, SurfaceView, map_colours, rgba
from wavefocus.rendering.arrays import Float64Array

_HANDLE_PX, _LINE_PX = 9.0, 7.0
_NUDGE_MM, _LONG_NUDGE_MM = 1.0, 10.0
_DELETES = (Qt.Key.Key_Delete, Qt.Key.Key_Backspace)
_SELECT_HINT = "Drag a path or its handles; arrow keys nudge (Shift: 10 mm); drag empty space to pan; wheel zooms"
_POLYLINE_HINT = "Double-click a line to add a vertex; Del deletes the chosen one; arrow keys nudge it"


class SceneCanvas(SurfaceView):
    """The surface with the scene's sources."""

    #: A path that was drawn.
    drawn = pyqtSignal(object)
    #: Another tool: the kind of path that it draws, empty for selecting.
    tool_changed = pyqtSignal(str)
    #: Position of the mouse, None off the surface.
    hovered = pyqtSignal(object)
    delete_wanted = pyqtSignal()

    def __init__(self, document: SceneDocument, live: LivePreview) -> None:
        self._document, self._live = document, live
        self.snaps = False
        self.kind = ""
        self._tool: Tool | None = None
        self._held = ""
        self._dragged: tuple[PathTable, Box | None, str] | None = None
        self._dragged_quiet: PointMm | None = None
        self._gesture = 0
        self._outline_mm = np.zeros((0, 2))
        self.items: SceneItems | None = None
        super().__init__("Surface to draw on")
        self.setAccessibleDescription("Arrow keys move the chosen source, Del deletes it")
        self.picture = self.items = SceneItems(self)
        document.edited.connect(self._show_handles)
        document.edited.connect(self._show_quiet)
        document.chosen_changed.connect(self._release)
        live.updated.connect(self.show_scene)
        live.backdrop_changed.connect(self._show_backdrop)
        self.redraw()
        self._show_backdrop()

    @property
    def hint(self) -> str:
        """What the mouse does now."""
        if self._tool is not None:
            return f"{self._tool.hint}; Esc stops drawing"
        source = self._document.source
        return _POLYLINE_HINT if source and isinstance(source.path, PolylineTable) else _SELECT_HINT

    @property
    def handles(self) -> list[Handle]:
        source = self._document.source
        return [] if source is None or self._tool is not None else handles_of(source.path, self._box_mm())

    def use_tool(self, kind: str) -> None:
        """Draw paths of a kind, or select where it is empty."""
        self._tool, self.kind = (tool_of(kind), kind) if kind else (None, "")
        self.picture.show_sketch(sketched(None))
        self.setCursor(Qt.CursorShape.CrossCursor if self._tool else Qt.CursorShape.ArrowCursor)
        self._show_handles()
        self.tool_changed.emit(self.kind)

    def show_scene(self) -> None:
        preview = self._live.preview
        # Points snapped to another bank's positions are out of date.
        traces = preview.traces if preview.backdrop is self._live.backdrop else []
        self.picture.show_traces(traces, self._document.chosen, self._live.backdrop)
        self._show_handles()
        self._show_quiet()

    def redraw(self) -> None:
        super().redraw()
        if self.items is not None:
            self.items.redraw()
            self.show_scene()

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Nudge, delete, end a drawing, and choose no source."""
        assert event is not None
        key, tool, source = event.key(), self._tool, self._document.source
        if tool is not None and key in (Qt.Key.Key_Return, Qt.Key.Key_Enter, Qt.Key.Key_Backspace):
            tool.back() if key == Qt.Key.Key_Backspace else tool.finish()
            self._show_tool()
        elif tool is not None and key == Qt.Key.Key_Escape:
            self.use_tool("")
        elif key == Qt.Key.Key_Escape and source is not None:
            self._document.choose(-1)
        elif key == Qt.Key.Key_Escape and self._document.chosen_quiet >= 0:
            self._document.choose_quiet(-1)
        elif tool is None and key in _DELETES and self._document.chosen_quiet >= 0:
            self._document.delete_quiet()
        elif tool is None and key in STEPS and source is not None:
            long = bool(event.modifiers() & Qt.KeyboardModifier.ShiftModifier)
            self._nudge(STEPS[key], _LONG_NUDGE_MM if long else _NUDGE_MM)
        elif tool is None and key in _DELETES and source is not None:
            self._delete()
        elif key not in STEPS:
            super().keyPressEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Report the mouse's position; the path being drawn follows it."""
        super().mouseMoveEvent(event)
        if event is None:
            return
        point = self.box.mapSceneToView(self.mapToScene(event.pos()))
        at = point.x(), point.y()
        self.hovered.emit(at)
        if self._tool is not None and not event.buttons():
            self._tool.move(self._snapped(at))
            self._show_tool()
        elif self._tool is None and not event.buttons():
            self._point_at(at)

    def leaveEvent(self, event: object) -> None:  # noqa: N802
        super().leaveEvent(event)
        self.hovered.emit(None)

    def claims_drag(self, at_mm: PointMm, _keys: Keys) -> bool:
        """Whether a drag from here draws, or moves something."""
        self._gesture += 1
        self._dragged = self._dragged_quiet = None
        if self._tool is not None:
            return True
        handle = self._handle_at(at_mm)
        if not handle and (place := self._quiet_at(at_mm)) >= 0:
            self._document.choose_quiet(place)
            self._dragged_quiet = self._document.draft.quiet[place].at_mm
            return self._dragged_quiet is not None
        index = self._document.chosen if handle else self._source_at(at_mm)
        if index < 0:
            return False
        self._document.choose(index)
        self._held = handle
        source = self._document.source
        assert source is not None
        self._dragged = source.path, self._box_mm(), handle
        return True

    def drag_to(self, start_mm: PointMm, at_mm: PointMm, _keys: Keys, *, ended: bool) -> None:
        if self._tool is not None:
            self._tool.drag(self._snapped(start_mm), self._snapped(at_mm), ended=ended)
            self._show_tool()
        elif self._dragged_quiet is not None:
            (x, y), index = self._dragged_quiet, self._document.chosen_quiet
            to = rounded(self._snapped((x + at_mm[0] - start_mm[0], y + at_mm[1] - start_mm[1])))
            moved = changed(self._document.draft.quiet[index], at_mm=to)
            self._document.edit_quiet(index, "move a quiet place", moved, f"drag {self._gesture}")
        elif self._dragged is not None:
            path, box_mm, handle = self._dragged
            if handle:
                path = with_handle_at(path, handle, self._snapped(at_mm), box_mm)
            else:
                anchor = anchor_of(path)
                to = self._snapped((anchor[0] + at_mm[0] - start_mm[0], anchor[1] + at_mm[1] - start_mm[1]))
                path = shifted(path, (to[0] - anchor[0], to[1] - anchor[1]))
            self._document.edit_source("reshape" if handle else "move", f"drag {self._gesture}", path=path)

    def click_at(self, at_mm: PointMm, _keys: Keys) -> None:
        if self._tool is not None:
            self._tool.click(self._snapped(at_mm), _HANDLE_PX * self.box.mm_per_pixel)
            self._show_tool()
            return
        self._held = self._handle_at(at_mm)
        if not self._held and (place := self._quiet_at(at_mm)) >= 0:
            self._document.choose_quiet(place)
        elif not self._held:
            self._document.choose(self._source_at(at_mm))
            self._document.choose_quiet(-1)
        self._show_handles()

    def double_click_at(self, at_mm: PointMm) -> None:
        if self._tool is not None:
            self._tool.finish()
            self._show_tool()
            return
        source = self._document.source
        if self._source_at(at_mm) < 0:
            self.show_everything()
        elif (
            source is not None
            and isinstance(source.path, PolylineTable)
            and self._source_at(at_mm) == self._document.chosen
            and not self._handle_at(at_mm)
        ):
            self._document.edit_source("add a vertex", path=with_vertex(source.path, self._snapped(at_mm)))

    def _show_tool(self) -> None:
        tool = self._tool
        if tool is not None and tool.done is not None:
            quiet = self.kind == QUIET
            self.use_tool("")
            if quiet and isinstance(tool.done, PointTable):
                self._document.add_quiet(tool.done.at_mm)
            else:
                self.drawn.emit(tool.done)
        elif tool is not None:
            self.picture.show_sketch(sketched(tool.sketch))

    def _nudge(self, way: PointMm, step_mm: float) -> None:
        source = self._document.source
        assert source is not None
        by = way[0] * step_mm, way[1] * step_mm
        held = self._handle(self._held)
        if held is None:
            self._document.edit_source("nudge", "nudge", path=shifted(source.path, by))
        else:
            to = held.at_mm[0] + by[0], held.at_mm[1] + by[1]
            path = with_handle_at(source.path, held.name, to, self._box_mm())
            self._document.edit_source("nudge", f"nudge {held.name}", path=path)

    def _delete(self) -> None:
        source = self._document.source
        if source is not None and isinstance(source.path, PolylineTable) and self._held:
            path, self._held = without_vertex(source.path, int(self._held)), ""
            self._document.edit_source("delete a vertex", path=path)
        else:
            self.delete_wanted.emit()

    def _snapped(self, at: PointMm) -> PointMm:
        """The bank's nearest position, or whole millimetres without a bank; unchanged where snapping is off."""
        if not self.snaps:
            return at
        row, surface = self.position_at(at), self.surface
        if surface is None or row < 0:
            return float(round(at[0])), float(round(at[1]))
        x_mm, y_mm = surface.position_mm[row].tolist()
        return x_mm, y_mm

    def _handle(self, name: str) -> Handle | None:
        return next((one for one in self.handles if one.name == name), None)

    def _handle_at(self, at: PointMm) -> str:
        reach_mm = _HANDLE_PX * self.box.mm_per_pixel
        near = [(math.dist(at, one.at_mm), place, one.name) for place, one in enumerate(self.handles)]
        distance_mm, _, name = min(near, default=(math.inf, 0, ""))
        return name if distance_mm <= reach_mm else ""

    def _source_at(self, at: PointMm) -> int:
        """The source whose path is below the mouse, the chosen one first; -1 for none."""
        reach_mm = _LINE_PX * self.box.mm_per_pixel
        near = []
        for index, trace in enumerate(self._live.preview.traces[: len(self._document.draft.source)]):
            if len(trace.line_mm):
                away = float(np.nanmin(np.hypot(*(trace.line_mm - at).T)))
                near.append((away > reach_mm, index != self._document.chosen, away, index))
        best = min(near, default=(True, True, 0.0, -1))
        return -1 if best[0] else best[3]

    def _quiet_at(self, at: PointMm) -> int:
        """The quiet place below the mouse: its disc, or its mark; -1 for none."""
        reach_mm = _HANDLE_PX * self.box.mm_per_pixel
        near = [
            (math.dist(at, place.at_mm), index)
            for index, place in enumerate(self._document.draft.quiet)
            if place.at_mm is not None and math.dist(at, place.at_mm) <= max(place.radius_mm, reach_mm)
        ]
        return min(near, default=(0.0, -1))[1]

    def _show_quiet(self) -> None:
        self.picture.show_quiet(self._document.draft.quiet, self._document.chosen_quiet)

    def _box_mm(self) -> Box | None:
        """Corners of the chosen path as it is drawn; None where the preview is of another kind of path."""
        preview, chosen, source = self._live.preview, self._document.chosen, self._document.source
        if source is None or chosen >= len(preview.traces):
            return None
        if type(preview.draft.source[chosen].path) is not type(source.path):
            return None
        line_mm = preview.traces[chosen].line_mm
        line_mm = line_mm[np.isfinite(line_mm).all(axis=1)]
        return box_of(line_mm.tolist()) if len(line_mm) else None

    def _point_at(self, at: PointMm) -> None:
        """Show by the cursor and the tooltip what a drag would move."""
        handle = self._handle(self._handle_at(at))
        over = handle is not None or self._source_at(at) >= 0 or self._quiet_at(at) >= 0
        self.setCursor(Qt.CursorShape.SizeAllCursor if over else Qt.CursorShape.ArrowCursor)
        self.setToolTip("" if handle is None else f"{handle.words}: ({handle.at_mm[0]:.6g}, {handle.at_mm[1]:.6g}) mm")

    def _release(self) -> None:
        self._held = ""
        self._dragged = None
        self.show_scene()

    def _show_handles(self) -> None:
        self.picture.show_handles(self.handles, self._held)

    def fit(self) -> None:
        self.show_everything()

    def _show_backdrop(self) -> None:
        backdrop, former_mm, view = self._live.backdrop, self._outline_mm, self.box.viewRect()
        self._outline_mm = backdrop.outline_mm
        self.show_surface(backdrop.surface)
        self.show_outline(backdrop.outline_mm)
        for side in ("left", "bottom"):
            self.getPlotItem().showAxis(side)
        if np.array_equal(former_mm, backdrop.outline_mm):
            self.box.setRange(view, padding=0)
        else:
            self.show_everything()
        self.show_scene()


_NONE_MM = np.zeros((0, 2))
_CIRCLE_POINTS = 91
_GAP_MM = np.full((1, 2), np.nan)
_CROSS_MM = np.array([(-2.0, -2.0), (2.0, 2.0), (np.nan, np.nan), (-2.0, 2.0), (2.0, -2.0), (np.nan, np.nan)])
_HEAD_PX = 14
_DOT_PX, _SMALL_DOT_PX = 5, 3


class SceneItems:
    """Draws a scene into a surface view."""

    def __init__(self, view: SurfaceView) -> None:
        self._view = view
        self.colour_map = pyqtgraph.colormap.get("viridis")
        self._dots = Spots(symbol="o", size=_DOT_PX)
        self._off = Spots(symbol="x", size=7)
        self._starts = Spots(symbol="o", size=11)
        self._sketch = pyqtgraph.PlotCurveItem(antialias=True)
        self._quiet, self._chosen_quiet = (pyqtgraph.PlotCurveItem(antialias=True) for _ in range(2))
        view.add_item(self._quiet, 28)
        view.add_item(self._chosen_quiet, 28)
        self._handles = Spots(symbol="s", size=10)
        self._held = Spots(symbol="s", size=13)
        self._lines: list[pyqtgraph.PlotCurveItem] = []
        self._heads: list[pyqtgraph.ArrowItem] = []
        items = (self._dots, self._off, self._starts, self._sketch, self._handles, self._held)
        for level, item in enumerate(items):
            view.add_item(item, 30 + 10 * level)

    def show_traces(self, traces: Sequence[Trace], chosen: int, backdrop: Backdrop) -> None:
        """Show the sources, the chosen one in front."""
        self._make_lines(len(traces))
        for index, trace in enumerate(traces):
            colour = self._view.theme.trace(index)
            line, head = self._lines[index], self._heads[index]
            line.setData(trace.line_mm[:, 0], trace.line_mm[:, 1], connect="finite")
            line.setPen(pyqtgraph.mkPen(colour, width=2 if index == chosen else 1))
            line.setZValue(29 if index == chosen else 25)
            _place_head(head, trace.line_mm, colour)
        drawn = [trace for trace in traces if len(trace.points_mm)]
        points_mm = np.concatenate([_NONE_MM, *(trace.points_mm for trace in drawn)])
        off = np.concatenate([np.zeros(0, np.bool_), *(trace.off for trace in drawn)])
        self._dots.setData(pos=points_mm[~off])
        if backdrop.surface is None and drawn:
            instant_s = np.concatenate([trace.instant_s for trace in drawn])[~off]
            colours = map_colours(self.colour_map, instant_s, span_s(traces), self._view.theme.cell)
            self._dots.setSize(_DOT_PX)
            self._dots.setBrush([pyqtgraph.mkBrush(*colour) for colour in colours.tolist()])
        else:  # the cells below have the colours
            self._dots.setSize(_SMALL_DOT_PX)
            self._dots.setBrush(pyqtgraph.mkBrush(self._view.theme.text))
        self._off.setData(pos=points_mm[off])
        self._off.setVisible(bool(off.any()))
        pens = [
            pyqtgraph.mkPen(self._view.theme.trace(index), width=2)
            for index, trace in enumerate(traces)
            if len(trace.points_mm)
        ]
        self._starts.setData(pos=np.array([trace.points_mm[0] for trace in drawn]).reshape(-1, 2), pen=pens)
        self._paint_cells(traces, backdrop)

    def show_handles(self, handles: Sequence[Handle], held: str) -> None:
        """Show the handles; the one named `held` is filled."""
        self._handles.setData(pos=np.array([one.at_mm for one in handles if one.name != held]).reshape(-1, 2))
        self._held.setData(pos=np.array([one.at_mm for one in handles if one.name == held]).reshape(-1, 2))

    def show_quiet(self, places: Sequence[QuietTable], chosen: int) -> None:
        """Show quiet places as crosses in their discs, dashed; the chosen one is marked."""
        for item, indices in ((self._quiet, range(len(places))), (self._chosen_quiet, [chosen] if chosen >= 0 else [])):
            lines = [_NONE_MM, *(_quiet_line(places[index]) for index in indices if index < len(places))]
            line_mm = np.concatenate(lines)
            item.setData(line_mm[:, 0], line_mm[:, 1], connect="finite")

    def show_sketch(self, points_mm: Float64Array) -> None:
        self._sketch.setData(points_mm[:, 0], points_mm[:, 1])

    def redraw(self) -> None:
        """Apply the theme's colours; the owner shows the traces again."""
        theme = self._view.theme
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
        self._quiet.setPen(pyqtgraph.mkPen(theme.text, width=1.5, style=Qt.PenStyle.DashLine))
        self._chosen_quiet.setPen(pyqtgraph.mkPen(MARK, width=2))

    def _make_lines(self, count: int) -> None:
        while len(self._lines) < count:
            self._lines.append(pyqtgraph.PlotCurveItem(antialias=True))
            self._heads.append(pyqtgraph.ArrowItem(headLen=_HEAD_PX, tipAngle=32))
            self._view.add_item(self._lines[-1], 25)
            self._view.add_item(self._heads[-1], 35)
        for surplus in (self._lines, self._heads):
            while len(surplus) > count:
                self._view.box.removeItem(surplus.pop())

    def _paint_cells(self, traces: Sequence[Trace], backdrop: Backdrop) -> None:
        """Colour positions that are foci by their first instant; all others are faint."""
        if backdrop.surface is None or backdrop.usable is None:
            return
        first_s = np.full(backdrop.surface.positions, np.inf)
        for trace in traces:
            if len(trace.rows):
                np.minimum.at(first_s, trace.rows[~trace.off], trace.instant_s[~trace.off])
        colours = map_colours(self.colour_map, first_s, span_s(traces), self._view.theme.cell)
        colours[~backdrop.usable & ~np.isfinite(first_s)] = rgba(self._view.theme.alternate)
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


def _quiet_line(place: QuietTable) -> Float64Array:
    """A cross and, of a disc, its rim; of a place that moves, its path as far as its table says it."""
    if place.at_mm is None:
        return np.concatenate([sketched(place.path), _GAP_MM])
    angle = np.linspace(0.0, 2 * np.pi, _CIRCLE_POINTS)
    rim = place.radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc_mm = rim if place.radius_mm > 0 else _NONE_MM
    return np.asarray(np.array(place.at_mm) + np.concatenate([_CROSS_MM, disc_mm, _GAP_MM]))


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
