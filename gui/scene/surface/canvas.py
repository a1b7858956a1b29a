"""The surface that scenes are drawn on: chooses, moves and shapes paths with mouse and keyboard, and draws new ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QMouseEvent

from gui.scene.document import SceneDocument
from gui.scene.draft import PathDraft, PointMm, PolylineDraft
from gui.scene.live import Live
from gui.scene.surface.drawing_box import DrawingBox
from gui.scene.surface.handles import (
    Box,
    Handle,
    anchor_of,
    box_of,
    handles_of,
    shifted,
    with_handle_at,
    with_vertex,
    without_vertex,
)
from gui.scene.surface.picture import ScenePicture, sketched
from gui.scene.surface.tools import Tool, tool_of
from gui.shell.theme import LIGHT, Theme, theme_axes

_HANDLE_PX, _LINE_PX = 9.0, 7.0
_NUDGE_MM, _LONG_NUDGE_MM = 1.0, 10.0
_STEPS = {
    Qt.Key.Key_Left: (-1.0, 0.0),
    Qt.Key.Key_Right: (1.0, 0.0),
    Qt.Key.Key_Up: (0.0, 1.0),
    Qt.Key.Key_Down: (0.0, -1.0),
}
_DELETES = (Qt.Key.Key_Delete, Qt.Key.Key_Backspace)
_SELECT_HINT = "Drag a path or its handles; arrow keys nudge (Shift: 10 mm); drag elsewhere moves the view, wheel zooms"
_POLYLINE_HINT = "Double click on a line adds a vertex, Del deletes the one held; arrow keys nudge it"


class SceneCanvas(pyqtgraph.PlotWidget):
    """The surface.

    Parameters
    ----------
    document : SceneDocument
        What is edited.
    live : Live
        What it looks like.
    """

    #: A path that was drawn.
    drawn = pyqtSignal(object)
    #: Another tool: the kind that it draws, empty for choosing and moving.
    tool_changed = pyqtSignal(str)
    #: Where the mouse is, None where it is not on the surface.
    hovered = pyqtSignal(object)
    delete_wanted = pyqtSignal()

    def __init__(self, document: SceneDocument, live: Live) -> None:
        self.box = DrawingBox()
        super().__init__(viewBox=self.box)
        self.setAccessibleName("Surface to draw on")
        self.setAccessibleDescription("Arrow keys move the chosen source, Del deletes it")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        plot = self.getPlotItem()
        plot.hideButtons()
        plot.setLabel("bottom", "x (mm)")
        plot.setLabel("left", "y (mm)")
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.picture = ScenePicture(self.box)
        self.snaps = False
        self.kind = ""
        self._document, self._live = document, live
        self._tool: Tool | None = None
        self._held = ""
        self._dragged: tuple[PathDraft, Box | None, str] | None = None
        self._gesture = 0
        self.box.takes = self._takes
        self.box.clicked.connect(self._clicked)
        self.box.double_clicked.connect(self._double_clicked)
        self.box.dragged.connect(lambda start, at: self._drag(start, at, over=False))
        self.box.dropped.connect(lambda start, at: self._drag(start, at, over=True))
        document.edited.connect(self._show_handles)
        document.chosen_changed.connect(self._let_go)
        live.came.connect(self.show_scene)
        live.ground_changed.connect(self._show_ground)
        self.apply_theme(LIGHT)
        self._show_ground()

    @property
    def hint(self) -> str:
        """What the mouse does now."""
        if self._tool is not None:
            return f"{self._tool.hint}; Esc stops drawing"
        source = self._document.source
        return _POLYLINE_HINT if source and isinstance(source.path, PolylineDraft) else _SELECT_HINT

    @property
    def handles(self) -> list[Handle]:
        """What of the chosen source can be taken hold of."""
        source = self._document.source
        return [] if source is None or self._tool is not None else handles_of(source.path, self._box_mm())

    def use_tool(self, kind: str) -> None:
        """Draw paths of a kind, or choose and move where it is empty."""
        self._tool, self.kind = (tool_of(kind), kind) if kind else (None, "")
        self.picture.show_sketch(sketched(None))
        self.setCursor(Qt.CursorShape.CrossCursor if self._tool else Qt.CursorShape.ArrowCursor)
        self._show_handles()
        self.tool_changed.emit(self.kind)

    def show_scene(self) -> None:
        """Show what came of the scene; of an older one until then."""
        drawn = self._live.drawn
        # What was snapped to another bank's positions says nothing here.
        self.picture.show_traces(drawn.traces if drawn.ground is self._live.ground else [], self._document.chosen)
        self._show_handles()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.setBackground(theme.base)
        theme_axes(self.getPlotItem(), theme)
        self.picture.apply_theme(theme)
        self.show_scene()

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Nudge, delete, end a drawing, and choose the next source."""
        assert event is not None
        key, tool = event.key(), self._tool
        if tool is not None and key in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            tool.finish()
            self._follow_tool()
        elif tool is not None and key == Qt.Key.Key_Backspace:
            tool.back()
            self._follow_tool()
        elif key == Qt.Key.Key_Escape and (tool is not None or self._document.chosen >= 0):
            self.use_tool("") if tool is not None else self._document.choose(-1)
        elif tool is None and key in _STEPS and self._document.source is not None:
            long = bool(event.modifiers() & Qt.KeyboardModifier.ShiftModifier)
            self._nudge(_STEPS[Qt.Key(key)], _LONG_NUDGE_MM if long else _NUDGE_MM)
        elif tool is None and key in _DELETES and self._document.source is not None:
            self._delete()
        else:
            super().keyPressEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Say where the mouse is, and let the path being drawn follow it."""
        super().mouseMoveEvent(event)
        if event is None:
            return
        point = self.box.mapSceneToView(self.mapToScene(event.pos()))
        at = point.x(), point.y()
        self.hovered.emit(at)
        if self._tool is not None and not event.buttons():
            self._tool.move(self._snapped(at))
            self._follow_tool()
        elif self._tool is None and not event.buttons():
            self._point_at(at)

    def leaveEvent(self, event: object) -> None:  # noqa: N802
        """The mouse is elsewhere."""
        super().leaveEvent(event)
        self.hovered.emit(None)

    def _takes(self, at: PointMm) -> bool:
        """Whether a drag from here draws, or moves something."""
        self._gesture += 1
        if self._tool is not None:
            return True
        handle = self._handle_at(at)
        index = self._document.chosen if handle else self._source_at(at)
        if index < 0:
            return False
        self._document.choose(index)
        self._held = handle
        source = self._document.source
        assert source is not None
        self._dragged = source.path, self._box_mm(), handle
        return True

    def _drag(self, start: PointMm, at: PointMm, *, over: bool) -> None:
        if self._tool is not None:
            self._tool.drag(self._snapped(start), self._snapped(at), over=over)
            self._follow_tool()
        elif self._dragged is not None:
            path, box_mm, handle = self._dragged
            if handle:
                path = with_handle_at(path, handle, self._snapped(at), box_mm)
            else:
                anchor = anchor_of(path)
                to = self._snapped((anchor[0] + at[0] - start[0], anchor[1] + at[1] - start[1]))
                path = shifted(path, (to[0] - anchor[0], to[1] - anchor[1]))
            self._put(path, "reshape" if handle else "move", f"drag {self._gesture}")

    def _clicked(self, at: PointMm) -> None:
        if self._tool is not None:
            self._tool.click(self._snapped(at), _HANDLE_PX * self.box.mm_per_pixel)
            self._follow_tool()
            return
        handle = self._handle_at(at)
        if handle:
            self._held = handle
            self._show_handles()
        else:
            self._held = ""
            self._document.choose(self._source_at(at))
            self._show_handles()

    def _double_clicked(self, at: PointMm) -> None:
        if self._tool is not None:
            self._tool.finish()
            self._follow_tool()
            return
        source = self._document.source
        on_it = source is not None and self._source_at(at) == self._document.chosen and not self._handle_at(at)
        if on_it and source is not None and isinstance(source.path, PolylineDraft):
            self._put(with_vertex(source.path, self._snapped(at)), "add a vertex")
        elif self._source_at(at) < 0:
            self.box.autoRange()

    def _follow_tool(self) -> None:
        tool = self._tool
        if tool is None:
            return
        if tool.done is None:
            self.picture.show_sketch(sketched(tool.sketch))
            return
        path = tool.done
        self.use_tool("")
        self.drawn.emit(path)

    def _nudge(self, way: PointMm, step_mm: float) -> None:
        source = self._document.source
        assert source is not None
        by = way[0] * step_mm, way[1] * step_mm
        held = next((one for one in self.handles if one.name == self._held), None)
        if held is None:
            self._put(shifted(source.path, by), "nudge", "nudge")
        else:
            to = held.at_mm[0] + by[0], held.at_mm[1] + by[1]
            self._put(with_handle_at(source.path, held.name, to, self._box_mm()), "nudge", f"nudge {held.name}")

    def _delete(self) -> None:
        source = self._document.source
        if source is not None and isinstance(source.path, PolylineDraft) and self._held:
            path, self._held = without_vertex(source.path, int(self._held)), ""
            self._put(path, "delete a vertex")
        else:
            self.delete_wanted.emit()

    def _put(self, path: PathDraft, words: str, gesture: str = "") -> None:
        source = self._document.source
        if source is not None:
            self._document.edit_source(words, replace(source, path=path), gesture=gesture)

    def _snapped(self, at: PointMm) -> PointMm:
        """The bank's nearest position, or whole millimetres without a bank; as it is where snapping is off."""
        if not self.snaps:
            return at
        near = self._live.ground.nearest(*at)
        return near or (float(round(at[0])), float(round(at[1])))

    def _handle_at(self, at: PointMm) -> str:
        reach_mm = _HANDLE_PX * self.box.mm_per_pixel
        near = [(math.dist(at, one.at_mm), place, one.name) for place, one in enumerate(self.handles)]
        distance_mm, _, name = min(near, default=(math.inf, 0, ""))
        return name if distance_mm <= reach_mm else ""

    def _source_at(self, at: PointMm) -> int:
        """The source whose path is beneath the mouse, the chosen one first; -1 for none."""
        reach_mm = _LINE_PX * self.box.mm_per_pixel
        chosen = self._document.chosen
        traces = self._live.drawn.traces
        near = []
        for index, trace in enumerate(traces[: len(self._document.draft.sources)]):
            if len(trace.line_mm):
                away = float(np.nanmin(np.hypot(*(trace.line_mm - at).T)))
                near.append((away > reach_mm, index != chosen, away, index))
        best = min(near, default=(True, True, 0.0, -1))
        return -1 if best[0] else best[3]

    def _box_mm(self) -> Box | None:
        drawn, chosen, source = self._live.drawn, self._document.chosen, self._document.source
        if source is None or chosen >= len(drawn.traces):
            return None
        if type(drawn.draft.sources[chosen].path) is not type(source.path):
            return None
        line_mm = drawn.traces[chosen].line_mm
        line_mm = line_mm[np.isfinite(line_mm).all(axis=1)]
        return box_of(line_mm.tolist()) if len(line_mm) else None

    def _point_at(self, at: PointMm) -> None:
        """Show by the mouse's shape what it would take hold of."""
        name = self._handle_at(at)
        handle = next((one for one in self.handles if one.name == name), None)
        over = handle is not None or self._source_at(at) >= 0
        self.setCursor(Qt.CursorShape.SizeAllCursor if over else Qt.CursorShape.ArrowCursor)
        self.setToolTip("" if handle is None else f"{handle.words}: ({handle.at_mm[0]:.6g}, {handle.at_mm[1]:.6g}) mm")

    def _let_go(self) -> None:
        self._held = ""
        self._dragged = None
        self.show_scene()

    def _show_handles(self) -> None:
        self.picture.show_handles(self.handles, self._held)

    def _show_ground(self) -> None:
        self.picture.show_ground(self._live.ground)
        self.show_scene()
