"""Moving the beam: the picture of the surface, arrow buttons and coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QResizeEvent
from PyQt5.QtWidgets import (
    QComboBox,
    QFormLayout,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from config.outline import Outline
from gui.rig.manual_session import ManualSession
from gui.rig.messages import Pair
from gui.shell.theme import Theme
from gui.shell.widgets import named, number_box
from gui.surface.surface import surface_from
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


_STEPS_MM = (0.1, 0.5, 1.0, 5.0, 20.0)
_FARTHEST_MM = 10_000.0
_ARROWS = (
    ("up", Qt.ArrowType.UpArrow, 0, 1, 0, 1),
    ("left", Qt.ArrowType.LeftArrow, 1, 0, -1, 0),
    ("right", Qt.ArrowType.RightArrow, 1, 2, 1, 0),
    ("down", Qt.ArrowType.DownArrow, 2, 1, 0, -1),
)


class Arrows(QWidget):
    """Four arrow buttons around a choice of the step; holding a button repeats it."""

    stepped = pyqtSignal(float, float)

    def __init__(self, steps: Sequence[float], unit: str, chosen: int) -> None:
        super().__init__()
        self._steps = tuple(steps)
        self.step_choice = named(QComboBox(), "Step of the arrows; Page up and Page down choose another", "Step")
        self.step_choice.addItems([f"{step:g} {unit}" for step in steps])
        self.step_choice.setCurrentIndex(chosen)
        self.buttons: dict[str, QToolButton] = {}
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        for word, arrow, row, column, x, y in _ARROWS:
            button = named(QToolButton(), f"Move the beam {word} by a step (arrow key)", f"Move the beam {word}")
            button.setArrowType(arrow)
            button.setAutoRepeat(True)
            button.setAutoRepeatInterval(120)
            button.clicked.connect(lambda _checked=False, x=x, y=y: self.step(x, y))
            grid.addWidget(button, row, column, Qt.AlignmentFlag.AlignCenter)
            self.buttons[word] = button
        grid.addWidget(self.step_choice, 1, 1)

    def step(self, x: int, y: int) -> None:
        """Ask for a step along x, y or both."""
        size = self._steps[self.step_choice.currentIndex()]
        self.stepped.emit(size * x, size * y)


class JogPanel(QWidget):
    """Moves the beam by clicks on the picture, arrows and coordinates."""

    def __init__(self, session: ManualSession) -> None:
        super().__init__()
        self._session = session
        self._drawn = {"state": -1, "spot": -1}
        self.picture = SurfacePicture("Surface: click to send the beam there")
        self.picture.setToolTip("Click: send the beam there. Arrow keys: one step. Wheel: zoom. Drag: pan. Unit: mm")
        self.arrows = Arrows(_STEPS_MM, "mm", 2)
        self.x_mm, self.y_mm = (
            number_box(
                f"{axis} in mm", f"{axis} on the surface in mm, from its middle; seen from the laser, x right, y up",
                " mm", 2, -_FARTHEST_MM, _FARTHEST_MM,
            )
            for axis in "xy"
        )  # fmt: skip
        self.go = named(QPushButton("&Go there"), "Send the beam to x, y on the surface")
        self.middle = named(QPushButton("&Middle"), "Send the beam to the middle of the surface, (0, 0) mm")
        self.park = named(QPushButton("&Park"), "Send the beam to the rig's safe direction (mirror.park_mrad)")
        self.where = QLabel()
        self.where.setAccessibleName("Place of the beam")
        self.where.setWordWrap(True)
        self.where.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        form, buttons, row, column = QFormLayout(), QVBoxLayout(), QHBoxLayout(), QVBoxLayout(self)
        form.addRow("x", self.x_mm)
        form.addRow("y", self.y_mm)
        for button in (self.go, self.middle, self.park):
            buttons.addWidget(button)
        row.addWidget(self.arrows)
        row.addSpacing(12)
        row.addLayout(form)
        row.addLayout(buttons)
        row.addStretch(1)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.picture, stretch=1)
        column.addWidget(self.where)
        column.addLayout(row)
        self.picture.clicked.connect(lambda x, y: session.jog_to(round(x, 2), round(y, 2)))
        self.picture.stepped.connect(self.arrows.step)
        self.arrows.stepped.connect(session.jog_by)
        self.go.clicked.connect(lambda: session.jog_to(self.x_mm.value(), self.y_mm.value()))
        self.middle.clicked.connect(lambda: session.jog_to(0.0, 0.0))
        self.park.clicked.connect(session.park)

    def draw(self) -> None:
        session, revision, facts = self._session, self._session.revision, self._session.facts
        ready = session.state == "ready"
        if self._drawn["state"] != revision["state"]:
            self._drawn["state"] = revision["state"]
            for part in (self.arrows, self.x_mm, self.y_mm, self.go, self.middle, self.park):
                part.setEnabled(ready)
            if facts is not None:
                self.picture.show_rig(surface_from(asdict(facts.surface)).outline, facts.actuator_mm)
        if self._drawn["spot"] != revision["spot"]:
            self._drawn["spot"] = revision["spot"]
            self.picture.show_spot(None if session.spot.parked else session.spot.place_mm)
            text = f"Beam: {session.spot.text}" if ready else "The instruments are not open in this window"
            if facts is not None and not facts.mapped:
                text += "\n▲ The mirror map is not measured: places are as accurate as the rig file"
            self.where.setText(text)
