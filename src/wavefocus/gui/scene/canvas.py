"""The surface that scenes are seen and drawn on: tools, paths and foci, the colour bar, a hint or the problem."""

import math
from collections.abc import Sequence

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtWidgets import QWidget

from wavefocus.config.scene import CircleTable, LineTable, PathTable, PointTable, PolylineTable, QuietTable, SourceTable
from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.scene import document as scenes
from wavefocus.gui.scene.preview import Backdrop, LivePreview, Trace
from wavefocus.gui.surface_view import MARK, NOWHERE_MM, Keys, SurfaceView, draw_line, map_colours, rgba
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array

# Drawn with a click; all else with a drag.
_CLICKED = ("point", scenes.QUIET)


def _path_between(kind: str, start: scenes.PointMm, end: scenes.PointMm) -> PathTable:
    """The path that a drag draws."""
    x, y = (round(one, scenes.DECIMALS) for one in start)
    if kind == "line":
        return LineTable(start_mm=(x, y), end_mm=(round(end[0], scenes.DECIMALS), round(end[1], scenes.DECIMALS)))
    if kind == "circle":
        return CircleTable(centre_mm=(x, y), radius_mm=round(math.dist(start, end), scenes.DECIMALS))
    return PointTable(at_mm=(x, y))


class SceneCanvas(SurfaceView):
    """The surface with the scene's sources.

    kind: What is drawn: `QUIET` or a kind of path; empty for nothing, drags pan.
    """

    #: Kind and path of what was drawn.
    drawn = pyqtSignal(str, object)
    #: A source or a quiet place that was clicked.
    chosen = pyqtSignal(object)
    #: A point of the chosen one that was dragged: its keys, and the table with it elsewhere.
    dragged = pyqtSignal(object, object)

    def __init__(self, document: scenes.SceneDocument, live: LivePreview) -> None:
        self._document, self._live = document, live
        self.kind = ""
        self._held: scenes.Keys | None = None
        self._outline_mm = NOWHERE_MM
        super().__init__("Surface to draw on")
        self.colour_map = pyqtgraph.colormap.get("viridis")
        theme = self.theme
        self._dots = self.add_spots(30, "o", 5)
        self._off = self.add_spots(40, "x", 7, theme.fault, theme.fault)
        self._starts = self.add_spots(50, "o", 11)
        self._squares = self.add_spots(70, "s", 9, pyqtgraph.mkPen(MARK, width=2), theme.base)
        self._lines: list[pyqtgraph.PlotCurveItem] = []
        self._quiet = self.add_line(28, pyqtgraph.mkPen(theme.text, width=1.5, style=Qt.PenStyle.DashLine))
        self._sketch = self.add_line(60, pyqtgraph.mkPen(MARK, width=2, style=Qt.PenStyle.DashLine))
        document.chosen_changed.connect(self._show_scene)
        live.updated.connect(self._show_scene)
        live.backdrop_changed.connect(self._show_backdrop)
        self._show_backdrop()

    def _show_scene(self) -> None:
        kind, index = self._document.chosen
        self._show_traces(self._live.traces, index if kind == scenes.SOURCE else -1)
        draw_line(self._quiet, [*map(_quiet_line, self._document.draft.quiet)])
        self._show_handles(self._document.table if self._handles() else None)

    def claims_drag(self, at_mm: scenes.PointMm, _keys: Keys) -> bool:
        near = [(math.dist(point_mm, at_mm), keys) for keys, point_mm in self._handles()]
        away_mm, keys = min(near, key=lambda one: one[0], default=(math.inf, None))
        self._held = keys if away_mm <= self._reach_mm and not self.kind else None
        return bool(self.kind) or self._held is not None

    def drag_to(self, start_mm: scenes.PointMm, at_mm: scenes.PointMm, _keys: Keys, *, ended: bool) -> None:
        table = self._document.table
        if self.kind:
            path = _path_between(self.kind, start_mm, at_mm)
            draw_line(self._sketch, [] if ended else [_sketched(path)])
            if ended:
                self.drawn.emit(self.kind, path)
        elif self._held is not None and table is not None:
            rounded_mm = round(at_mm[0], scenes.DECIMALS), round(at_mm[1], scenes.DECIMALS)
            table = scenes.with_handle(table, self._held, rounded_mm)
            self._show_handles(table)
            draw_line(self._sketch, [] if ended else [_sketched(table.path)])
            if ended:
                self.dragged.emit(self._held, table)

    def click_at(self, at_mm: scenes.PointMm, _keys: Keys) -> None:
        if self.kind in _CLICKED:
            self.drawn.emit(self.kind, _path_between(self.kind, at_mm, at_mm))
        elif not self.kind and (chosen := self._table_at(at_mm)) is not None:
            self.chosen.emit(chosen)

    def fit(self) -> None:
        """Leave the view: another outline changes it, not another bank of the same surface."""

    def _handles(self) -> list[tuple[scenes.Keys, scenes.PointMm]]:
        """Points that can be dragged: those of the chosen table, while the text is the scene that is shown."""
        table = self._document.table
        return [] if table is None or self._document.problem else scenes.handles(table)

    def _table_at(self, at: scenes.PointMm) -> scenes.Chosen | None:
        """The source or the quiet place below the mouse; None for none."""
        lines = [((scenes.SOURCE, index), trace.line_mm) for index, trace in enumerate(self._live.traces)]
        lines += [((scenes.QUIET, index), _quiet_line(place)) for index, place in enumerate(self._document.draft.quiet)]
        near = [(float(np.nanmin(np.hypot(*(line_mm - at).T))), chosen) for chosen, line_mm in lines if len(line_mm)]
        away_mm, chosen = min(near, default=(math.inf, None))
        return chosen if away_mm <= self._reach_mm else None

    @property
    def _reach_mm(self) -> float:
        return _REACH_PX * float(self.box.viewPixelSize()[0])

    def _show_backdrop(self) -> None:
        backdrop, former_mm = self._live.backdrop, self._outline_mm
        self._outline_mm = backdrop.outline_mm
        show_backdrop(self, backdrop)
        if not np.array_equal(former_mm, backdrop.outline_mm):
            self.show_everything()
        self._show_scene()

    def _show_traces(self, traces: Sequence[Trace], chosen: int) -> None:
        """Show the sources, the chosen one in front."""
        while self._lines:
            self.box.removeItem(self._lines.pop())
        for index, trace in enumerate(traces):
            depth, width = (29, 2) if index == chosen else (25, 1)
            self._lines.append(self.add_line(depth, pyqtgraph.mkPen(self.theme.trace(index), width=width)))
            draw_line(self._lines[-1], [trace.line_mm])
        drawn = [trace for trace in traces if len(trace.points_mm)]
        points_mm = np.concatenate([NOWHERE_MM, *(trace.points_mm for trace in drawn)])
        off = np.concatenate([np.zeros(0, np.bool_), *(trace.off for trace in drawn)])
        instant_s = np.concatenate([np.zeros(0), *(trace.instant_s for trace in drawn)])
        colours = map_colours(self.colour_map, instant_s[~off], _span_s(traces), self.theme.cell)
        self._dots.setData(pos=points_mm[~off], brush=[pyqtgraph.mkBrush(*colour) for colour in colours.tolist()])
        self._off.setData(pos=points_mm[off])
        self._off.setVisible(bool(off.any()))
        numbers = (index for index, trace in enumerate(traces) if len(trace.points_mm))
        pens = [pyqtgraph.mkPen(self.theme.trace(index), width=2) for index in numbers]
        self._starts.setData(pos=np.array([trace.points_mm[0] for trace in drawn]).reshape(-1, 2), pen=pens)

    def _show_handles(self, table: SourceTable | QuietTable | None) -> None:
        """Show the points that can be dragged."""
        points_mm = [] if table is None else [at_mm for _, at_mm in scenes.handles(table)]
        self._squares.setData(pos=np.array(points_mm, np.float64).reshape(-1, 2))


def show_backdrop(view: SurfaceView, backdrop: Backdrop) -> None:
    """Show the surface that a scene is drawn over; positions without a valid measurement are faint."""
    view.show_surface(backdrop.surface)
    view.show_outline(backdrop.outline_mm)
    if backdrop.surface is not None and backdrop.usable is not None:
        colours = np.tile(rgba(view.theme.cell), (backdrop.surface.positions, 1))
        colours[~backdrop.usable] = rgba(view.theme.alternate)
        view.paint(colours)


_REACH_PX = 8.0
_CROSS_MM = np.array([(-2.0, -2.0), (2.0, 2.0), (np.nan, np.nan), (-2.0, 2.0), (2.0, -2.0), (np.nan, np.nan)])


def _span_s(traces: Sequence[Trace]) -> tuple[float, float]:
    """Return the first and the last focus instant of a scene; they differ also where there is only one."""
    instants = [trace.instant_s for trace in traces if len(trace.instant_s)]
    if not instants:
        return 0.0, 1.0
    low_s, high_s = min(float(one.min()) for one in instants), max(float(one.max()) for one in instants)
    return low_s, high_s if high_s > low_s else low_s + 1.0


def _sketched(path: PathTable | None) -> Float64Array:
    """Return the corners of a path that is being drawn."""
    if isinstance(path, CircleTable):
        return _circle(path.centre_mm, path.radius_mm)
    if isinstance(path, PolylineTable):
        return np.array(path.points_mm).reshape(-1, 2)
    return np.array([path.start_mm, path.end_mm]) if isinstance(path, LineTable) else NOWHERE_MM


def _quiet_line(place: QuietTable) -> Float64Array:
    """A cross and, of a disc, its rim; of a place that moves, its path as far as its table says it."""
    if place.at_mm is None:
        return _sketched(place.path)
    rim_mm = _circle(place.at_mm, place.radius_mm) if place.radius_mm > 0 else NOWHERE_MM
    return np.concatenate([np.array(place.at_mm) + _CROSS_MM, rim_mm])


def _circle(centre_mm: scenes.PointMm, radius_mm: float) -> Float64Array:
    angle = np.linspace(0.0, 2 * np.pi, 91)
    return np.array(centre_mm) + radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)


_TOOLS = (
    ("", "Select", "Click a path or a quiet place for its table; drag its squares to move it; elsewhere a drag pans"),
    ("point", "Point", "Click: adds a source at rest"),
    ("line", "Line", "Drag from start to end: adds a source on a line"),
    ("circle", "Circle", "Drag from the centre to the rim: adds a source on a circle"),
    (scenes.QUIET, "Quiet", "Click: adds a place that is kept quiet"),
)
_LONGEST = 240


class SurfacePanel(Themed, QWidget):
    """Where scenes are seen."""

    def __init__(self, document: scenes.SceneDocument, live: LivePreview) -> None:
        super().__init__()
        self._document, self._live = document, live
        self.canvas = SceneCanvas(document, live)
        self.tools = ui.exclusive_buttons(_TOOLS, self.use_tool)
        self.colours = ColourBar(self.canvas.colour_map)
        self.hint = ui.label("Hint, or problem of the scene", wraps=True, selectable=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
        # A fixed height: the surface must not move below the mouse when a problem appears.
        self.hint.setFixedHeight(3 * self.hint.fontMetrics().lineSpacing() + 2)
        tools = ui.row(*self.tools.values(), None, spacing=3)
        ui.column(tools, (self.canvas, 1), self.colours, self.hint, owner=self, spacing=4)
        live.updated.connect(self._show_preview)
        document.changed.connect(self._show_preview)
        self.use_tool("")

    @property
    def problem(self) -> str:
        """What is wrong with the scene; empty where nothing is."""
        return self._document.problem or self._live.problem

    def use_tool(self, kind: str) -> None:
        """Draw paths of a kind, or quiet places; nothing where it is empty."""
        self.canvas.kind = kind
        self.tools[kind].setChecked(True)
        self.canvas.setCursor(Qt.CursorShape.CrossCursor if kind else Qt.CursorShape.ArrowCursor)
        self._show_hint()

    def _show_preview(self) -> None:
        self.colours.show_range("Focus instant", "s", _span_s(self._live.traces))
        self._show_hint()

    def _show_hint(self) -> None:
        """Show the problem; without one, what the mouse does."""
        hint = next(tip for kind, _, tip in _TOOLS if kind == self.canvas.kind)
        text = self.problem or (hint if self._document.draft.source else scenes.EMPTY)
        self.hint.setText(text if len(text) < _LONGEST else f"{text[:_LONGEST]}…")
        self.hint.setToolTip(text)
        self.hint.setStyleSheet(f"QLabel {{ color: {self.theme.fault if self.problem else self.theme.faint}; }}")
