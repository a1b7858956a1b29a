"""Arrow buttons and coordinates that move the beam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from PyQt5.QtCore import Qt, pyqtSignal
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

from gui.rig.manual_session import ManualSession
from gui.rig.surface_picture import SurfacePicture
from gui.shell.widgets import named, number_box
from gui.surface.surface import surface_from

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
