"""A field over the surface at one instant: one value per position, in colours, with outline, actuators and paths."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QRectF, Qt, pyqtSignal
from PyQt5.QtGui import QColor, QKeyEvent, QMouseEvent, QPainterPath, QResizeEvent
from PyQt5.QtWidgets import QGraphicsPathItem

from gui.shell.theme import LIGHT, Theme, theme_axes
from gui.surface.colours import magnitude_map, signed_map
from gui.surface.ground import Float64Array, Ground, actuator_triangles
from gui.surface.signs import cross_path, ring_path, sign_of
from gui.surface.walking import STEPS, next_position

Real = NDArray[np.float32] | NDArray[np.float64]

_COLOURS = 256
_AXIS_PX = 46
_PADDING = 0.02
# A grid that takes less than this of the view is shown nearer.
_CLOSER_BELOW = 0.4


class FieldMap(pyqtgraph.PlotWidget):
    """One value per position as colours; a click, or an arrow key, goes to a position.

    The owner sets the ground once, then the scale, then values as often as it likes:
    ``show_ground``, ``show_scale``, ``show_values``. A map of 1500 positions takes new values in
    about a millisecond.

    Parameters
    ----------
    name : str
        What it shows, for the accessible name and the title.
    """

    #: Index of the position that was clicked, in the ground's order.
    picked = pyqtSignal(int)

    _ground: Ground | None = None  # it is resized before it is made
    _fits = True

    def __init__(self, name: str) -> None:
        self.box = _ClickBox()
        super().__init__(viewBox=self.box)
        self.name = name
        self.setAccessibleName(name)
        self.setAccessibleDescription("Click a position, or walk with the arrow keys")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.marked = -1
        self.levels = (-1.0, 1.0)
        self.values: Float64Array = np.zeros(0)
        self._signed = True
        self._unit = ""
        self._theme = LIGHT
        self._linked: list[FieldMap] = []
        self._table: NDArray[np.uint32] = np.zeros(_COLOURS + 2, np.uint32)
        self._image = pyqtgraph.ImageItem(axisOrder="row-major")
        self._outline = pyqtgraph.PlotCurveItem(antialias=True)
        self._paths: list[pyqtgraph.PlotCurveItem] = []
        self._actuators = pyqtgraph.PlotCurveItem(antialias=True, connect="finite")
        self._rings: list[QGraphicsPathItem] = []
        self._cross = self._sign(cross_path(), 40)
        for depth, item in enumerate((self._image, self._outline, self._actuators)):
            item.setZValue(10 * depth)
            self.addItem(item)
        plot = self.getPlotItem()
        plot.hideButtons()
        plot.setLabel("bottom", "x (mm)")
        plot.setLabel("left", "y (mm)")
        plot.getAxis("left").setWidth(_AXIS_PX)  # equal in maps that stand side by side
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.box.clicked.connect(self._clicked)
        self.box.everything_wanted.connect(self.show_everything)
        self.box.sigRangeChangedManually.connect(lambda *_: self._keep_view())
        self.apply_theme(LIGHT)

    def link(self, other: FieldMap) -> None:
        """Show the same part of the surface as another map, for ever."""
        self.setXLink(other)
        self.setYLink(other)
        self._linked.append(other)
        other._linked.append(self)

    def show_ground(self, ground: Ground | None) -> None:
        """Show another surface, or none; values are to be set anew."""
        self._ground = ground
        self.values = np.zeros(0)
        self._image.clear()
        for path in self._paths:
            self.removeItem(path)
        self._paths = []
        self.show_sources(np.zeros((0, 2)))
        self.mark(-1)
        for side in ("left", "bottom"):
            self.getPlotItem().showAxis(side, ground is not None)
        if ground is None:
            self._outline.setData([], [])
            self._actuators.setData([], [])
            return
        outline_mm = ground.outline_mm if ground.outline_mm is not None else np.zeros((0, 2))
        self._outline.setData(outline_mm[:, 0], outline_mm[:, 1])
        self._actuators.setData(*actuator_triangles(ground).T)
        for points_mm in ground.paths_mm:
            path = pyqtgraph.PlotCurveItem(points_mm[:, 0], points_mm[:, 1], antialias=True)
            path.setZValue(15)
            self.addItem(path)
            self._paths.append(path)
        self._dress_paths()
        raster = ground.raster
        self._image.setImage(np.zeros((*raster.index.shape, 4), np.uint8), levels=None)
        self._image.setRect(QRectF(raster.left_mm, raster.bottom_mm, raster.width_mm, raster.height_mm))
        self._fits = True
        self._fit()

    def show_everything(self) -> None:
        """Show all there is, at any size of the window."""
        for one in (self, *self._linked):
            one._fits = True
        self.box.autoRange(padding=_PADDING)

    def show_scale(self, low: float, high: float, unit: str, *, signed: bool) -> None:
        """Choose what the ends of the colours mean; a signed scale has zero in its middle and is symmetric."""
        self.levels = low, high
        self._unit, self._signed = unit, signed
        self._choose_colours()
        self._paint()

    def show_values(self, values: Real) -> None:
        """Colour the positions, in the ground's order; NaN where there is no value."""
        self.values = np.asarray(values, np.float64)
        self._paint()

    def show_sources(self, at_mm: Float64Array) -> None:
        """Ring where the sources are now, shape (sources, 2); none for an empty array."""
        while len(self._rings) < len(at_mm):
            ring = self._sign(ring_path(), 30)
            ring.setPen(pyqtgraph.mkPen(self._theme.text, width=2))
            self._rings.append(ring)
        for number, ring in enumerate(self._rings):
            ring.setVisible(number < len(at_mm))
            if number < len(at_mm):
                ring.setPos(*at_mm[number].tolist())

    def mark(self, position: int) -> None:
        """Mark a position; -1 for none."""
        self.marked = position
        there = self._ground is not None and 0 <= position < len(self._ground.position_mm)
        self._cross.setVisible(there)
        if there and self._ground is not None:
            self._cross.setPos(*self._ground.position_mm[position].tolist())

    @property
    def colour_map(self) -> pyqtgraph.ColorMap:
        """What its colour bar shows."""
        return signed_map(self._theme) if self._signed else magnitude_map()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.setBackground(theme.base)
        theme_axes(self.getPlotItem(), theme)
        self._outline.setPen(pyqtgraph.mkPen(theme.faint, width=1))
        self._actuators.setPen(pyqtgraph.mkPen(theme.text, width=1))
        self._cross.setPen(pyqtgraph.mkPen(theme.traces[3], width=2.5))  # neither blue nor orange
        for ring in self._rings:
            ring.setPen(pyqtgraph.mkPen(theme.text, width=2))
        self._dress_paths()
        self._choose_colours()
        self._paint()

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802
        """Make use of the room, unless somebody chose what is seen."""
        super().resizeEvent(event)
        if self._ground is not None and self._fits:
            self._fit()

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Walk from position to position."""
        assert event is not None
        if self._ground is None or event.key() not in STEPS:
            super().keyPressEvent(event)
            return
        position = next_position(self._ground.position_mm, self.marked, event.key())
        if position != self.marked:
            self.picked.emit(position)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Say where the mouse is, and what the value is there."""
        super().mouseMoveEvent(event)
        if self._ground is None or event is None:
            return
        point = self.box.mapSceneToView(self.mapToScene(event.pos()))
        position = self._ground.raster.nearest(point.x(), point.y())
        self.setToolTip(self.words(position) if position >= 0 else "")

    def words(self, position: int) -> str:
        """Place and value of a position."""
        assert self._ground is not None
        x_mm, y_mm = self._ground.position_mm[position]
        value = self.values[position] if position < len(self.values) else np.nan
        told = f"{value:.3g} {self._unit}".rstrip() if np.isfinite(value) else "no value"
        return f"{self.name} at ({x_mm:.1f}, {y_mm:.1f}) mm: {told}"

    def _clicked(self, x_mm: float, y_mm: float) -> None:
        position = -1 if self._ground is None else self._ground.raster.nearest(x_mm, y_mm)
        if position >= 0:
            self.picked.emit(position)

    def _sign(self, path: QPainterPath, depth: int) -> QGraphicsPathItem:
        sign = sign_of(path, depth)
        self.box.addItem(sign, ignoreBounds=True)
        return sign

    def _fit(self) -> None:
        """Show everything; a few positions of a large surface nearer, for who wants to see all double clicks."""
        assert self._ground is not None
        self.box.autoRange(padding=_PADDING)
        raster, whole = self._ground.raster, self.box.viewRect()
        if max(raster.width_mm, raster.height_mm) < _CLOSER_BELOW * whole.width():
            place = QRectF(raster.left_mm, raster.bottom_mm, raster.width_mm, raster.height_mm)
            self.box.setRange(place, padding=0.3)

    def _keep_view(self) -> None:
        for one in (self, *self._linked):
            one._fits = False

    def _dress_paths(self) -> None:
        for path in self._paths:
            path.setPen(pyqtgraph.mkPen(self._theme.text, width=1))

    def _choose_colours(self) -> None:
        """The last two entries: a position without a value, and no position."""
        table = np.zeros((_COLOURS + 2, 4), np.uint8)
        table[:_COLOURS] = self.colour_map.getLookupTable(nPts=_COLOURS, alpha=True)
        cell = QColor(self._theme.cell)
        table[_COLOURS] = cell.red(), cell.green(), cell.blue(), 255
        self._table = np.ascontiguousarray(table).view(np.uint32).ravel()

    def _paint(self) -> None:
        if self._ground is None or len(self.values) != len(self._ground.position_mm):
            return
        low, high = self.levels
        step = np.full(len(self.values) + 1, _COLOURS, np.intp)
        step[-1] = _COLOURS + 1
        known = np.isfinite(self.values)
        share = (self.values[known] - low) / (high - low)
        step[:-1][known] = np.clip(share * _COLOURS, 0, _COLOURS - 1).astype(np.intp)
        # A pixel's four bytes are moved as one number: a quarter of the time.
        picture = self._table[step][self._ground.raster.index]
        shape = self._ground.raster.index.shape
        self._image.setImage(picture.view(np.uint8).reshape(*shape, 4), autoLevels=False, levels=None)


class _ClickBox(pyqtgraph.ViewBox):
    """Tells where it was clicked; a double click shows everything."""

    clicked = pyqtSignal(float, float)
    everything_wanted = pyqtSignal()

    def __init__(self) -> None:
        super().__init__(lockAspect=True, enableMenu=False)

    def mouseClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Tell where it was clicked."""
        if event.button() != Qt.MouseButton.LeftButton:
            return
        event.accept()
        if event.double():
            self.everything_wanted.emit()
            return
        point = self.mapSceneToView(event.scenePos())
        self.clicked.emit(point.x(), point.y())
