"""Picture of a rig's surface: outline, actuators, marks, residuals and laser spot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph
from PyQt5.QtCore import pyqtSignal
from PyQt5.QtGui import QKeyEvent, QResizeEvent

from config.outline import Outline
from gui.rig.messages import Pair
from gui.shell.theme import Theme
from gui.surface.view import STEPS, Keys, PointMm, Spots, SurfaceView

_RIM_POINTS = 180
# Residuals are enlarged until the longest has about this share of the surface's length.
_ARROW_SHARE = 0.12


class SurfacePicture(SurfaceView):
    """Arrow keys emit `stepped`, a click emits `clicked` with the place in mm."""

    clicked = pyqtSignal(float, float)
    stepped = pyqtSignal(int, int)

    def __init__(self, name: str) -> None:
        self._length_mm = 0.0
        self._labels: list[pyqtgraph.TextItem] = []
        self._chosen = Spots(symbol="o", size=15, pxMode=True)
        self._marks = Spots(pxMode=True)
        self._residuals = pyqtgraph.PlotCurveItem(antialias=True, connect="pairs")
        self._tips = Spots(symbol="o", size=6, pxMode=True)
        self._spot = Spots(symbol="o", size=12, pxMode=True)
        super().__init__(name)
        self.setAccessibleDescription("A click sends the beam there; arrow keys move it by a step")
        for depth, item in enumerate((self._chosen, self._marks, self._residuals, self._tips, self._spot), start=30):
            self.add_item(item, depth)

    def show_rig(self, outline: Outline, actuator_mm: Sequence[Pair]) -> None:
        self.show_outline(outline.line(_RIM_POINTS))
        self.show_actuators(_points(actuator_mm))
        left, _, right, _ = outline.box_mm
        self._length_mm = right - left
        self.fit()

    def show_spot(self, place_mm: Pair | None) -> None:
        """Show the beam; None for nowhere on the surface."""
        self._spot.setData(pos=_points([] if place_mm is None else [place_mm]))
        self._cross.setVisible(place_mm is not None)
        if place_mm is not None:
            self._cross.setPos(*place_mm)

    def show_chosen(self, actuator_mm: Pair | None) -> None:
        """Emphasise the actuator that would play."""
        self._chosen.setData(pos=_points([] if actuator_mm is None else [actuator_mm]))

    def show_marks(self, place_mm: Sequence[Pair], current: int, done: int) -> None:
        """Show numbered marks: filled when done, the current one large."""
        theme = self.theme
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
            self.box.removeItem(label)
        self._labels = []
        for number, place in enumerate(place_mm):
            label = pyqtgraph.TextItem(str(number + 1), color=theme.text, anchor=(-0.5, 1.0))
            label.setPos(*place)
            self.add_item(label, 40)
            self._labels.append(label)

    def show_residuals(self, place_mm: Sequence[Pair], off_mm: Sequence[Pair]) -> float:
        """Draw the residuals of a map, enlarged; returns the factor."""
        place, off = _points(place_mm), _points(off_mm)
        largest_mm = float(np.hypot(*off.T).max(initial=0.0))
        times = _rounded_down(_ARROW_SHARE * self._length_mm / largest_mm) if largest_mm > 0 else 1.0
        tips = place[: len(off)] + times * off
        lines = np.stack([place[: len(off)], tips], axis=1).reshape(-1, 2)
        self._residuals.setData(lines[:, 0], lines[:, 1])
        self._tips.setData(pos=tips)
        return times

    def apply_theme(self, theme: Theme) -> None:
        super().apply_theme(theme)
        self._chosen.setBrush(None)
        self._chosen.setPen(pyqtgraph.mkPen(theme.accent, width=3))
        self._residuals.setPen(pyqtgraph.mkPen(theme.fault, width=2.5))
        for item, pen in ((self._tips, None), (self._spot, pyqtgraph.mkPen(theme.base, width=1.5))):
            item.setBrush(pyqtgraph.mkBrush(theme.fault))
            item.setPen(pen)

    def click_at(self, at_mm: PointMm, _keys: Keys) -> None:
        self.clicked.emit(*at_mm)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        if event is None or event.key() not in STEPS:
            super().keyPressEvent(event)
            return
        self.stepped.emit(*(int(step) for step in STEPS[event.key()]))
        event.accept()

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802
        super().resizeEvent(event)
        if self._length_mm and self._fits:
            self.fit()


def _points(place_mm: Sequence[Pair]) -> np.ndarray:
    return np.asarray(place_mm, np.float64).reshape(-1, 2)


def _rounded_down(times: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(times))
    return float(power * max(step for step in (1, 2, 5) if step * power <= times))
