"""The surface view: outline, actuators, coloured cells, paths and marks, with picking, pan and zoom."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QRectF, Qt, pyqtSignal
from PyQt5.QtGui import QColor, QKeyEvent, QMouseEvent, QPen
from PyQt5.QtWidgets import QGraphicsItem

from wavefocus.gui.surface import PlotSurface, Raster
from wavefocus.gui.theme import Themed, theme_axes
from wavefocus.rendering.arrays import Float64Array

PointMm = tuple[float, float]
Keys = Qt.KeyboardModifiers | Qt.KeyboardModifier

#: Directions of the arrow keys.
STEPS = {
    int(Qt.Key.Key_Left): (-1.0, 0.0),
    int(Qt.Key.Key_Right): (1.0, 0.0),
    int(Qt.Key.Key_Up): (0.0, 1.0),
    int(Qt.Key.Key_Down): (0.0, -1.0),
}
#: Colour of marks: visible on every colour of the maps, in either theme.
MARK = "#ff7a1a"
# Cells that fill less than this share of the view are shown nearer.
_CLOSER_BELOW = 0.4
NOWHERE_MM = np.zeros((0, 2))


Spots: TypeAlias = pyqtgraph.ScatterPlotItem


class SurfaceView(Themed, pyqtgraph.PlotWidget):
    """A map of the surface.

    Clicks and drags arrive at `click_at`, `claims_drag` and `drag_to`, in millimetres; subclasses
    override them. What no subclass claims pans the view; the wheel zooms; a double click shows everything.

    name: Its accessible name.
    """

    #: A position that was clicked, or reached with the arrow keys.
    picked = pyqtSignal(int)

    surface: PlotSurface | None = None

    def __init__(self, name: str) -> None:
        self.box = _SurfaceBox(self)
        super().__init__(viewBox=self.box)
        self.name = name
        self.setAccessibleName(name)
        self.setAccessibleDescription("Click a position, or walk with the arrow keys")
        self.marked = -1
        self.texts: list[pyqtgraph.TextItem] = []
        self._leader = self  # whose part of the surface is shown
        theme = self.theme
        self._cells = pyqtgraph.ImageItem(axisOrder="row-major")
        self._add_item(self._cells, 0, bounds=True)
        self._outline = self.add_line(10, pyqtgraph.mkPen(theme.faint, width=1), bounds=True)  # wider ones paint slowly
        self._paths = self.add_line(15, pyqtgraph.mkPen(theme.text, width=1), bounds=True)
        self._actuators = self.add_spots(20, "t1", 9, pyqtgraph.mkPen(theme.text, width=1), theme.base)
        self._checks = self.add_spots(30, "o", 8, pyqtgraph.mkPen(theme.text))
        self._sources = self.add_spots(80, "o", 12, pyqtgraph.mkPen(theme.text, width=2))
        self._cross = self.add_spots(90, "crosshair", 19, pyqtgraph.mkPen(MARK, width=2.5))
        plot = self.getPlotItem()
        plot.hideButtons()
        plot.setLabel("bottom", "x (mm)")
        plot.setLabel("left", "y (mm)")
        plot.getAxis("left").setWidth(46)  # equal in maps side by side
        theme_axes(plot)
        self._show_axes(False)  # there is nothing to measure yet

    def _add_item(self, item: QGraphicsItem, depth: float, *, bounds: bool = False) -> None:
        """Add an item; only those with `bounds` count where everything is to be seen."""
        item.setZValue(depth)
        self.box.addItem(item, ignoreBounds=not bounds)

    def add_spots(self, depth: float, symbol: str, size: int, pen: object = None, brush: str | None = None) -> Spots:
        """Add spots of a size in pixels; `pen` as of `pyqtgraph.mkPen`, None for no rim or no filling."""
        spots = Spots(symbol=symbol, size=size, pxMode=True, pen=pen, brush=brush)
        spots.setEnabled(False)  # else it would keep clicks from the view
        self._add_item(spots, depth)
        return spots

    def add_line(self, depth: float, pen: QPen, *, bounds: bool = False) -> pyqtgraph.PlotCurveItem:
        """Add a line, which is shown by `draw_line`."""
        line = pyqtgraph.PlotCurveItem(antialias=True, connect="finite", pen=pen)
        self._add_item(line, depth, bounds=bounds)
        return line

    def show_texts(self, texts: Sequence[str], at_mm: Sequence[PointMm], anchor: PointMm) -> None:
        """Show texts beside places, in place of the former ones; `anchor` as of `pyqtgraph.TextItem`."""
        while self.texts:
            self.box.removeItem(self.texts.pop())
        for text, place_mm in zip(texts, at_mm, strict=True):
            self.texts.append(item := pyqtgraph.TextItem(text, color=self.theme.text, anchor=anchor))
            item.setPos(*place_mm)
            self._add_item(item, 95)

    def link(self, other: SurfaceView) -> None:
        """Show the same part of the surface as another map."""
        self.box.setXLink(other.box)
        self.box.setYLink(other.box)
        self._leader = other

    def show_surface(self, surface: PlotSurface | None) -> None:
        """Show another surface, or none; cells are painted by `paint`. The part of a bank that is shown stays."""
        former, self.surface = self.surface, surface
        self._cells.clear()
        self._checks.clear()
        self.mark(-1)
        self.show_sources(NOWHERE_MM)
        self._show_axes(surface is not None)
        self.show_outline(NOWHERE_MM if surface is None or surface.outline_mm is None else surface.outline_mm)
        self.show_actuators(NOWHERE_MM if surface is None else surface.actuator_mm)
        draw_line(self._paths, () if surface is None else surface.paths_mm)
        if surface is not None:
            self.paint(np.zeros((surface.positions, 4), np.uint8))
            if former is None or former.bank != surface.bank or not surface.bank.name:
                self.fit()

    def show_outline(self, outline_mm: Float64Array) -> None:
        """Draw the rim, shape (points, 2)."""
        draw_line(self._outline, [outline_mm])
        if len(outline_mm):
            self._show_axes(True)

    def _show_axes(self, shown: bool) -> None:
        for side in ("left", "bottom"):
            self.getPlotItem().showAxis(side, shown)

    def show_actuators(self, actuator_mm: Float64Array) -> None:
        """Draw the actuators that are not NaN, shape (actuators, 2)."""
        self._actuators.setData(pos=actuator_mm[np.isfinite(actuator_mm).all(axis=1)])

    def paint(self, colours: NDArray[np.uint8]) -> None:
        """Colour the cells; `colours` has shape (positions, 4), red, green, blue and opacity."""
        if self.surface is None or len(colours) != self.surface.positions:
            return
        raster = self.surface.raster
        # A pixel's four bytes are moved as one number: a quarter of the time.
        numbers = np.ascontiguousarray(np.concatenate([colours, np.zeros((1, 4), np.uint8)])).view(np.uint32).ravel()
        picture = np.take(numbers, raster.index, mode="clip").view(np.uint8).reshape(*raster.index.shape, 4)
        placed = self._cells.image is not None
        self._cells.setImage(picture, autoLevels=False, levels=None)
        checks = self.surface.checks
        if len(checks):
            brushes = [pyqtgraph.mkBrush(*colour) for colour in colours[checks].tolist()]
            self._checks.setData(pos=self.surface.position_mm[checks], brush=brushes)
        if not placed:
            self._cells.setRect(_rectangle(raster))

    def mark(self, position: int) -> None:
        """Mark a position; -1 for none."""
        self.marked = position
        inside = self.surface is not None and 0 <= position < self.surface.positions
        self._cross.setData(pos=self.surface.position_mm[[position]] if self.surface and inside else NOWHERE_MM)

    def show_sources(self, at_mm: Float64Array) -> None:
        """Draw a ring around each source, shape (sources, 2)."""
        self._sources.setData(pos=at_mm)

    def show_everything(self) -> None:
        """Show the whole surface, at any size of the window, until it is panned or zoomed."""
        self._leader.box.enableAutoRange()

    def fit(self) -> None:
        """Show the whole surface; a small grid on a large surface is shown nearer."""
        self.show_everything()
        if self.surface is not None and self.surface.positions:
            raster, whole = self.surface.raster, self.box.childrenBoundingRect()
            if max(raster.width_mm, raster.height_mm) < _CLOSER_BELOW * whole.width():
                self._leader.box.setRange(_rectangle(raster), padding=0.3)

    def position_at(self, at_mm: PointMm) -> int:
        """The position nearest to a point, -1 for none."""
        return -1 if self.surface is None or not self.surface.positions else self.surface.raster.nearest(*at_mm)

    def position_text(self, position: int) -> str:
        assert self.surface is not None
        x_mm, y_mm = self.surface.position_mm[position]
        return f"position {position} at ({x_mm:.1f}, {y_mm:.1f}) mm"

    def click_at(self, at_mm: PointMm, _keys: Keys) -> None:
        """Pick the position that was clicked."""
        position = self.position_at(at_mm)
        if position >= 0:
            self.picked.emit(position)

    def claims_drag(self, _at_mm: PointMm, _keys: Keys) -> bool:
        """Whether a drag that begins here is for `drag_to`; else it pans the view."""
        return False

    def drag_to(self, start_mm: PointMm, at_mm: PointMm, keys: Keys, *, ended: bool) -> None:
        """Receive a drag that was claimed."""

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Walk from position to position with the arrow keys."""
        assert event is not None
        if self.surface is None or event.key() not in STEPS:
            super().keyPressEvent(event)
            return
        position = _next_position(self.surface.position_mm, self.marked, event.key())
        if position != self.marked:
            self.picked.emit(position)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Show the tooltip of the position below the mouse, or the place of the mouse."""
        super().mouseMoveEvent(event)
        if event is not None:
            point = self.box.mapSceneToView(self.mapToScene(event.pos()))
            position = self.position_at((point.x(), point.y()))
            place = f"({point.x():.1f}, {point.y():.1f}) mm"
            self.setToolTip(self.position_text(position) if position >= 0 else place)


class _SurfaceBox(pyqtgraph.ViewBox):
    """Passes clicks and claimed drags of the left button on to its view, in millimetres."""

    def __init__(self, view: SurfaceView) -> None:
        super().__init__(lockAspect=True, enableMenu=False)
        self._view = view
        self._claimed = False

    def mouseClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        if event.button() != Qt.MouseButton.LeftButton:
            return
        event.accept()
        at_mm = self._at_mm(event.scenePos())
        if event.double():
            self._view.show_everything()
        else:
            self._view.click_at(at_mm, event.modifiers())

    def mouseDragEvent(self, event, axis=None) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        start_mm, keys = self._at_mm(event.buttonDownScenePos()), event.modifiers()
        if event.isStart():
            self._claimed = event.button() == Qt.MouseButton.LeftButton and self._view.claims_drag(start_mm, keys)
        if not self._claimed:
            super().mouseDragEvent(event, axis)
            return
        event.accept()
        self._claimed = not event.isFinish()
        self._view.drag_to(start_mm, self._at_mm(event.scenePos()), keys, ended=event.isFinish())

    def _at_mm(self, point: object) -> PointMm:
        place = self.mapSceneToView(point)
        return float(place.x()), float(place.y())


def _next_position(position_mm: Float64Array, here: int, key: int) -> int:
    """Return the nearest position in an arrow key's direction, within 45 degrees of it.

    position_mm, float64 (positions, 2): The grid.
    here: Where to start; returned where nothing lies in that direction. -1 goes to the middle of the grid.
    key: One of `STEPS`.
    """
    if here < 0:
        return int(np.hypot(*(position_mm - position_mm.mean(axis=0)).T).argmin())
    step = np.array(STEPS[key])
    away_mm = position_mm - position_mm[here]
    along_mm, aside_mm = away_mm @ step, np.abs(away_mm @ step[::-1])
    cost = np.where((along_mm > 0) & (aside_mm <= along_mm), along_mm + aside_mm, np.inf)
    return int(cost.argmin()) if np.isfinite(cost).any() else here


def rgba(colour: str) -> NDArray[np.uint8]:
    """Return a colour as red, green, blue and opacity."""
    return np.array(QColor(colour).getRgb(), np.uint8)


def map_colours(
    colour_map: pyqtgraph.ColorMap, values: NDArray[np.floating], levels: tuple[float, float], missing: str
) -> NDArray[np.uint8]:
    """Return the colours of values between two levels, shape (n, 4); those that are NaN get the colour `missing`."""
    colours = np.tile(rgba(missing), (len(values), 1))
    known = np.isfinite(values)
    share = (np.asarray(values, np.float64)[known] - levels[0]) / (levels[1] - levels[0])
    colours[known] = colour_map.map(share, mode="byte")
    return colours


def _rectangle(raster: Raster) -> QRectF:
    return QRectF(raster.left_mm, raster.bottom_mm, raster.width_mm, raster.height_mm)


def draw_line(line: pyqtgraph.PlotCurveItem, parts_mm: Sequence[Float64Array]) -> None:
    """Draw parts (points, 2) with gaps between them, and where a point is NaN."""
    gap_mm = np.full((1, 2), np.nan)
    points_mm = np.concatenate([NOWHERE_MM, *(one for part_mm in parts_mm for one in (part_mm, gap_mm))])[:-1]
    line.setData(points_mm[:, 0], points_mm[:, 1])
