"""The beam in a person's hands: a picture to click, arrows, places to go to."""

from __future__ import annotations

from PyQt5.QtWidgets import (
    QDoubleSpinBox,
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from gui.rig.arrows import Arrows
from gui.rig.hands import Hands
from gui.rig.surface_picture import SurfacePicture
from gui.shell.theme import Theme

_STEPS_MM = (0.1, 0.5, 1.0, 5.0, 20.0)
_FARTHEST_MM = 10_000.0


class JogPanel(QWidget):
    """Sends the beam about.

    Parameters
    ----------
    hands : Hands
        Moves the mirror.
    """

    def __init__(self, hands: Hands) -> None:
        super().__init__()
        self._hands = hands
        self._seen = {"state": -1, "spot": -1}
        self.picture = SurfacePicture("Surface: click to send the beam there")
        self.picture.setToolTip("Click: the beam goes there. Arrow keys: a step. Wheel: zoom, drag: move, places in mm")
        self.arrows = Arrows(_STEPS_MM, "mm", 2)
        self.x_mm, self.y_mm = _coordinate("x"), _coordinate("y")
        self.go = _button("&Go there", "Send the beam to x, y on the surface")
        self.middle = _button("&Middle", "Send the beam to the middle of the surface, (0, 0) mm")
        self.park = _button("&Park", "Send the beam to the rig's safe direction (mirror.park_mrad)")
        self.where = QLabel()
        self.where.setAccessibleName("Where the beam is")
        self.where.setWordWrap(True)
        self.where.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        form = QFormLayout()
        form.addRow("x", self.x_mm)
        form.addRow("y", self.y_mm)
        buttons = QVBoxLayout()
        for button in (self.go, self.middle, self.park):
            buttons.addWidget(button)
        row = QHBoxLayout()
        row.addWidget(self.arrows)
        row.addSpacing(12)
        row.addLayout(form)
        row.addLayout(buttons)
        row.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.picture, stretch=1)
        column.addWidget(self.where)
        column.addLayout(row)
        self.picture.clicked.connect(lambda x, y: hands.jog_to(round(x, 2), round(y, 2)))
        self.picture.stepped.connect(self.arrows.step)
        self.arrows.stepped.connect(hands.jog_by)
        self.go.clicked.connect(lambda: hands.jog_to(self.x_mm.value(), self.y_mm.value()))
        self.middle.clicked.connect(lambda: hands.jog_to(0.0, 0.0))
        self.park.clicked.connect(hands.park)

    def draw(self) -> None:
        """Draw what changed."""
        hands, seen = self._hands, self._hands.revision
        if self._seen["state"] != seen["state"]:
            self._seen["state"] = seen["state"]
            ready = hands.state == "ready"
            for part in (self.arrows, self.x_mm, self.y_mm, self.go, self.middle, self.park):
                part.setEnabled(ready)
            if hands.facts is not None:
                facts = hands.facts
                self.picture.show_surface(facts.length_mm, facts.width_mm, facts.actuator_mm.tolist())
        if self._seen["spot"] != seen["spot"]:
            self._seen["spot"] = seen["spot"]
            spot = hands.spot
            there = spot.x_mm is not None and spot.y_mm is not None and not spot.parked
            self.picture.show_spot((spot.x_mm, spot.y_mm) if there else None)  # type: ignore[arg-type]
            told = spot.words if hands.state == "ready" else "the instruments are not in the window's hands"
            unmapped = hands.facts is not None and not hands.facts.mapped
            believed = "\n▲ The mirror map is not measured: places are as good as the rig file's" if unmapped else ""
            self.where.setText(f"The beam: {told}{believed}")

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.picture.apply_theme(theme)


def _coordinate(axis: str) -> QDoubleSpinBox:
    box = QDoubleSpinBox()
    box.setRange(-_FARTHEST_MM, _FARTHEST_MM)
    box.setDecimals(2)
    box.setSuffix(" mm")
    box.setAccessibleName(f"{axis} in mm")
    box.setToolTip(f"{axis} on the surface in mm, from its middle; seen from the laser, x right, y up")
    return box


def _button(words: str, tip: str) -> QPushButton:
    button = QPushButton(words)
    button.setAccessibleName(words.replace("&", ""))
    button.setToolTip(tip)
    return button
