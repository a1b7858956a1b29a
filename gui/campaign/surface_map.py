"""The map of the surface: outline, actuators and positions, coloured by status or by a quality figure."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QRectF, Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QMouseEvent, QPainterPath

from gui.campaign.figures import Figure, Float32Array
from gui.campaign.picking import PickingBox
from gui.campaign.status_look import LOOKS, look_index
from gui.campaign.statuses import status_text
from gui.shell.theme import LIGHT, Theme, theme_axes
from gui.surface.spots import Spots
from gui.surface.surface import Surface
from gui.surface.walking import STEPS, next_position

_COLOURS = 256
_MARK = "#ff7a1a"
# On a large map a few outliers must not press all others into one colour.
_MANY, _OUTLIERS_PERCENT = 100, 1.0


class SurfaceMap(pyqtgraph.PlotWidget):
    """The map; arrow keys walk from position to position, Space selects, Ctrl+A selects all, Esc nothing."""

    shown_changed = pyqtSignal(int)
    selection_changed = pyqtSignal(int)

    def __init__(self) -> None:
        self.box = PickingBox()
        super().__init__(viewBox=self.box)
        self.setAccessibleName("Map of the surface")
        self.setAccessibleDescription("Arrow keys go from position to position, Space selects")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.shown = -1
        self.selected: set[int] = set()
        self._theme = LIGHT
        self._surface: Surface | None = None
        self._status: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._bad: bytes = b""
        self._unplaced = True
        self._levels: tuple[float, float] | None = None
        self.beyond = False, False
        self.colour_map = pyqtgraph.colormap.get("viridis")
        self._image = pyqtgraph.ImageItem(axisOrder="row-major")
        self._outline = pyqtgraph.PlotCurveItem(antialias=True)
        self._actuators = Spots(symbol="o", size=9, pxMode=True)
        self._marks = Spots(pxMode=True)
        self._chosen = Spots(symbol="s", size=11, pxMode=True)
        self._current_rim = Spots(symbol="o", size=17, pxMode=True)
        self._current = Spots(symbol="o", size=17, pxMode=True)
        self._cross = Spots(symbol="crosshair", size=21, pxMode=True)
        for item in (
            self._image,
            self._outline,
            self._actuators,
            self._marks,
            self._chosen,
            self._current_rim,
            self._current,
            self._cross,
        ):
            self.addItem(item)
        plot = self.getPlotItem()
        plot.hideButtons()
        plot.setLabel("bottom", "x (mm)")
        plot.setLabel("left", "y (mm)")
        for side in ("left", "bottom"):  # no prefix: the unit stands in the label
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.box.clicked.connect(self._clicked)
        self.box.surrounded.connect(self._surrounded)
        self.apply_theme(LIGHT)

    @property
    def levels(self) -> tuple[float, float] | None:
        """What the ends of the colour bar mean; None while the status is shown."""
        return self._levels

    def show_surface(self, surface: Surface) -> None:
        """Show another bank's surface."""
        self._surface = surface
        self._status = np.zeros(surface.positions, np.uint8)
        self._bad = b""
        outline_mm = surface.outline_mm if surface.outline_mm is not None else np.zeros((0, 2))
        self._outline.setData(outline_mm[:, 0], outline_mm[:, 1])
        known_mm = surface.actuator_mm[np.isfinite(surface.actuator_mm).all(axis=1)]
        self._actuators.setData(pos=known_mm)
        self._unplaced = True
        self.show_position(-1)
        self.select([])

    def clear_surface(self) -> None:
        """Show nothing."""
        self._surface = None
        self._image.clear()
        self._outline.setData([], [])
        for item in (self._actuators, self._marks, self._current_rim, self._current):
            item.clear()
        self.show_position(-1)
        self.select([])

    def show_status(self, status: NDArray[np.uint8]) -> None:
        """Colour by status."""
        self._status = status
        self._levels = None
        colours = np.array([_rgba(look.colour(self._theme) or self._theme.cell) for look in LOOKS], np.uint8)
        self._paint(colours[look_index(status)])

    def show_figure(self, figure: Figure, values: Float32Array, status: NDArray[np.uint8]) -> None:
        """Colour by a quality figure; positions without one look as not measured."""
        self._status = status
        known = values[np.isfinite(values)]
        outliers = _OUTLIERS_PERCENT if known.size > _MANY and figure.key != "attempts" else 0.0
        low, high = np.percentile(known, [outliers, 100.0 - outliers]).tolist() if known.size else (0.0, 1.0)
        self.beyond = bool(known.size and known.min() < low), bool(known.size and known.max() > high)
        if figure.key == "attempts":
            low, high = min(low, 1.0), max(high, 2.0)
        if high - low < 1e-9 * max(1.0, abs(high)):
            low, high = low - 0.5, high + 0.5
        self._levels = low, high
        table = self.colour_map.getLookupTable(nPts=_COLOURS, alpha=True)
        colours = np.tile(_rgba(self._theme.cell), (len(values), 1))
        at = np.isfinite(values)
        step = np.clip((values[at] - low) / (high - low) * (_COLOURS - 1), 0, _COLOURS - 1)
        colours[at] = table[step.astype(int)]
        self._paint(colours)

    def show_current(self, position: int) -> None:
        """Ring the position that is being measured; -1 for none."""
        for ring in (self._current_rim, self._current):
            self._put(ring, [position] if position >= 0 else [])

    def show_position(self, position: int) -> None:
        """Mark the position whose details are shown; -1 for none."""
        self.shown = position
        self._put(self._cross, [position] if position >= 0 else [])
        self.shown_changed.emit(position)

    def select(self, positions: Iterable[int]) -> None:
        """Select these and no others."""
        self.selected = {int(position) for position in positions}
        self._put(self._chosen, sorted(self.selected))
        self.selection_changed.emit(len(self.selected))

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours; the owner colours the positions anew."""
        self._theme = theme
        self.setBackground(theme.base)
        theme_axes(self.getPlotItem(), theme)
        self._outline.setPen(pyqtgraph.mkPen(theme.faint, width=1))  # wider ones take ten times longer to paint
        self._actuators.setPen(pyqtgraph.mkPen(theme.text, width=1.5))
        self._actuators.setBrush(pyqtgraph.mkBrush(theme.base))
        # On any of the map's colours, in either theme.
        self._chosen.setPen(pyqtgraph.mkPen(_MARK, width=2))
        self._current_rim.setPen(pyqtgraph.mkPen("#000000", width=4.5))
        self._current.setPen(pyqtgraph.mkPen("#ffffff", width=2))
        self._cross.setPen(pyqtgraph.mkPen(_MARK, width=2))
        for item in (self._chosen, self._current_rim, self._current, self._cross):
            item.setBrush(None)
        self._bad = b""

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Walk and select by the keyboard."""
        assert event is not None
        key = event.key()
        if self._surface is not None and key in STEPS:
            here = next_position(self._surface.position_mm, self.shown, key) if self.shown >= 0 else 0
            if here != self.shown:
                self.show_position(here)
        elif key == Qt.Key.Key_Space and self.shown >= 0:
            self.select(self.selected ^ {self.shown})
        elif key == Qt.Key.Key_A and event.modifiers() & Qt.KeyboardModifier.ControlModifier and self._surface:
            self.select(range(self._surface.positions))
        elif key == Qt.Key.Key_Escape and self.selected:
            self.select([])
        else:
            super().keyPressEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Say which position is beneath the mouse."""
        super().mouseMoveEvent(event)
        if self._surface is None or event is None:
            return
        point = self.box.mapSceneToView(self.mapToScene(event.pos()))
        position = self._surface.raster.nearest(point.x(), point.y())
        if position < 0:
            self.setToolTip("")
            return
        x_mm, y_mm = self._surface.position_mm[position]
        self.setToolTip(
            f"position {position} at ({x_mm:.1f}, {y_mm:.1f}) mm: {status_text(int(self._status[position]))}"
        )

    def _paint(self, colours: NDArray[np.uint8]) -> None:
        if self._surface is None or len(colours) != self._surface.positions:
            return
        raster, clear = self._surface.raster, np.zeros((1, 4), np.uint8)
        # A pixel's four bytes are moved as one number: a quarter of the time.
        numbers = np.concatenate([colours, clear]).view(np.uint32).ravel()
        picture = np.take(numbers, raster.index, mode="clip").view(np.uint8).reshape(*raster.index.shape, 4)
        self._image.setImage(picture, autoLevels=False, levels=None)
        if self._unplaced:
            self._unplaced = False
            self._image.setRect(QRectF(raster.left_mm, raster.bottom_mm, raster.width_mm, raster.height_mm))
            self.box.autoRange()
        self._mark()

    def _mark(self) -> None:
        """Shapes over what is not good; drawn anew only when another position is."""
        index = look_index(self._status)
        if self._surface is None or index.tobytes() == self._bad:
            return
        self._bad = index.tobytes()
        ink = "#ffffff" if self._levels is not None else self._theme.text
        spots = [
            {
                "pos": self._surface.position_mm[position],
                "symbol": LOOKS[index[position]].symbol,
                "size": 7,
                "pen": pyqtgraph.mkPen(ink, width=1),
                "brush": pyqtgraph.mkBrush(self._theme.base),
            }
            for position in np.flatnonzero(index < len(LOOKS) - 2)
        ]
        self._marks.setData(spots)

    def _put(self, item: Spots, positions: list[int]) -> None:
        if self._surface is None:
            item.setData(pos=np.zeros((0, 2)))
            return
        inside = [position for position in positions if position < self._surface.positions]
        item.setData(pos=self._surface.position_mm[inside].reshape(-1, 2))
        item.setVisible(bool(inside))  # even an empty one takes time to paint

    def _clicked(self, x_mm: float, y_mm: float, adds: bool) -> None:
        position = -1 if self._surface is None else self._surface.raster.nearest(x_mm, y_mm)
        if position >= 0 and adds:
            self.select(self.selected ^ {position})
        elif position >= 0:
            self.show_position(position)

    def _surrounded(self, corners_mm: NDArray[np.float64], adds: bool) -> None:
        if self._surface is None:
            return
        path = QPainterPath()
        path.addPolygon(pyqtgraph.functions.arrayToQPolygonF(corners_mm[:, 0], corners_mm[:, 1]))
        path.setFillRule(Qt.FillRule.WindingFill)
        inside = {
            number
            for number, (x_mm, y_mm) in enumerate(self._surface.position_mm.tolist())
            if path.contains(pyqtgraph.QtCore.QPointF(x_mm, y_mm))
        }
        self.select(self.selected | inside if adds else inside)


def _rgba(colour: str) -> NDArray[np.uint8]:
    return np.array(pyqtgraph.mkColor(colour).getRgb(), np.uint8)
