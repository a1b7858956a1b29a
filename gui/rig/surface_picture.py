"""Picture of the surface: outline, actuators, marks, residuals and laser spot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent

from config.stadium import stadium_rim
from gui.rig.messages import Pair
from gui.shell.theme import LIGHT, Theme, theme_axes

_RIM_POINTS = 180
_MARGIN = 0.08
_STEPS = {
    Qt.Key.Key_Left: (-1, 0),
    Qt.Key.Key_Right: (1, 0),
    Qt.Key.Key_Up: (0, 1),
    Qt.Key.Key_Down: (0, -1),
}
# Residuals are a thousandth of the surface: drawn so many times larger, they reach about this share of it.
_ARROW_SHARE = 0.12


class SurfacePicture(pyqtgraph.PlotWidget):
    """The surface; arrow keys ask for a step, a click for a place."""

    clicked = pyqtSignal(float, float)
    stepped = pyqtSignal(int, int)

    def __init__(self, name: str) -> None:
        super().__init__(enableMenu=False)
        self.setAccessibleName(name)
        self.setAccessibleDescription("A click sends the beam there; arrow keys move it by a step")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._theme = LIGHT
        self._size_mm: Pair | None = None
        self._labels: list[pyqtgraph.TextItem] = []
        self._outline = pyqtgraph.PlotCurveItem(antialias=True)
        self._actuators = pyqtgraph.ScatterPlotItem(symbol="o", size=9, pxMode=True)
        self._chosen = pyqtgraph.ScatterPlotItem(symbol="o", size=15, pxMode=True)
        self._marks = pyqtgraph.ScatterPlotItem(pxMode=True)
        self._residuals = pyqtgraph.PlotCurveItem(antialias=True, connect="pairs")
        self._tips = pyqtgraph.ScatterPlotItem(symbol="o", size=6, pxMode=True)
        self._spot = pyqtgraph.ScatterPlotItem(symbol="o", size=12, pxMode=True)
        self._cross = pyqtgraph.ScatterPlotItem(symbol="crosshair", size=23, pxMode=True)
        for item in (self._outline, self._actuators, self._chosen, self._marks, self._residuals, self._tips,
                     self._spot, self._cross):  # fmt: skip
            self.addItem(item)
        plot = self.getPlotItem()
        plot.hideButtons()
        plot.setAspectLocked(True)
        plot.setLabel("bottom", "x (mm)")
        plot.setLabel("left", "y (mm)")
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.scene().sigMouseClicked.connect(self._mouse_clicked)
        self.apply_theme(LIGHT)

    def show_surface(self, length_mm: float, width_mm: float, actuator_mm: Sequence[Pair]) -> None:
        """Show a stadium and where its actuators touch it."""
        rim_mm = stadium_rim(length_mm, width_mm, 0.0, _RIM_POINTS)
        rim_mm = np.vstack([rim_mm, rim_mm[:1]])
        self._outline.setData(rim_mm[:, 0], rim_mm[:, 1])
        self._actuators.setData(pos=np.asarray(actuator_mm, np.float64).reshape(-1, 2))
        if self._size_mm != (length_mm, width_mm):
            self._size_mm = (length_mm, width_mm)
            self.show_all()

    def show_all(self) -> None:
        """Show the whole surface."""
        if self._size_mm is not None:
            x_mm, y_mm = (0.5 * side for side in self._size_mm)
            self.getPlotItem().getViewBox().setRange(xRange=(-x_mm, x_mm), yRange=(-y_mm, y_mm), padding=_MARGIN)

    def show_spot(self, place: Pair | None) -> None:
        """Show where the beam is, as far as the map knows; None for nowhere on the surface."""
        where = [] if place is None else [place]
        for item in (self._spot, self._cross):
            item.setData(pos=np.asarray(where, np.float64).reshape(-1, 2))

    def show_chosen(self, actuator_mm: Pair | None) -> None:
        """Show which actuator would sound."""
        where = [] if actuator_mm is None else [actuator_mm]
        self._chosen.setData(pos=np.asarray(where, np.float64).reshape(-1, 2))

    def show_marks(self, place_mm: Sequence[Pair], current: int, done: int) -> None:
        """Show numbered marks: those met are filled, the current one is large."""
        theme = self._theme
        self._marks.setData(
            [
                {
                    "pos": place,
                    "symbol": "s",
                    "size": 17 if number == current else 11,
                    "brush": pyqtgraph.mkBrush(theme.good if number < done else theme.base),
                    "pen": pyqtgraph.mkPen(theme.fault if number == current else theme.text, width=2),
                }
                for number, place in enumerate(place_mm)
            ]
        )
        for label in self._labels:
            self.removeItem(label)
        self._labels = []
        for number, place in enumerate(place_mm):
            label = pyqtgraph.TextItem(str(number + 1), color=theme.text, anchor=(-0.5, 1.0))
            label.setPos(*place)
            self.addItem(label)
            self._labels.append(label)

    def show_residuals(self, place_mm: Sequence[Pair], off_mm: Sequence[Pair]) -> float:
        """Draw by how much a map misses each mark, enlarged; returns how many times."""
        place, off = np.asarray(place_mm, np.float64).reshape(-1, 2), np.asarray(off_mm, np.float64).reshape(-1, 2)
        if not len(off) or self._size_mm is None:
            self._residuals.setData([], [])
            self._tips.clear()
            return 1.0
        largest_mm = float(np.hypot(*off.T).max(initial=0.0))
        times = _rounded_down(_ARROW_SHARE * self._size_mm[0] / largest_mm) if largest_mm > 0 else 1.0
        ends = place + times * off
        lines = np.stack([place, ends], axis=1).reshape(-1, 2)
        self._residuals.setData(lines[:, 0], lines[:, 1])
        self._tips.setData(pos=ends)
        return times

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.setBackground(theme.base)
        theme_axes(self.getPlotItem(), theme)
        self._outline.setPen(pyqtgraph.mkPen(theme.text, width=1.5))
        self._actuators.setBrush(pyqtgraph.mkBrush(theme.faint))
        self._actuators.setPen(pyqtgraph.mkPen(theme.text))
        self._chosen.setBrush(pyqtgraph.mkBrush(None))
        self._chosen.setPen(pyqtgraph.mkPen(theme.accent, width=3))
        self._residuals.setPen(pyqtgraph.mkPen(theme.fault, width=2.5))
        self._tips.setBrush(pyqtgraph.mkBrush(theme.fault))
        self._tips.setPen(pyqtgraph.mkPen(None))
        self._spot.setBrush(pyqtgraph.mkBrush(theme.fault))
        self._spot.setPen(pyqtgraph.mkPen(theme.base, width=1.5))
        self._cross.setBrush(pyqtgraph.mkBrush(None))
        self._cross.setPen(pyqtgraph.mkPen(theme.fault, width=1.5))

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        """Arrow keys ask for a step."""
        step = _STEPS.get(Qt.Key(event.key())) if event is not None else None
        if step is None or event is None:
            super().keyPressEvent(event)
            return
        self.stepped.emit(*step)
        event.accept()

    def _mouse_clicked(self, event) -> None:  # type: ignore[no-untyped-def]
        if event.button() != Qt.MouseButton.LeftButton or event.double():
            return
        box = self.getPlotItem().getViewBox()
        if box.sceneBoundingRect().contains(event.scenePos()):
            at = box.mapSceneToView(event.scenePos())
            self.clicked.emit(at.x(), at.y())


def _rounded_down(times: float) -> float:
    """To 1, 2 or 5 times a power of ten, so that it can be said."""
    power = 10.0 ** np.floor(np.log10(times))
    return float(power * max(step for step in (1, 2, 5) if step * power <= times))
