"""Moving the beam: the picture of the surface, arrow buttons and coordinates."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pyqtgraph
from msgspec.structs import asdict
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent
from PyQt5.QtWidgets import QFormLayout, QGridLayout, QToolButton, QWidget

from wavefocus.config.messages.operate import Numbers
from wavefocus.config.outline import Outline
from wavefocus.gui import widgets as ui
from wavefocus.gui.rig.session import ManualSession
from wavefocus.gui.surface import surface_from
from wavefocus.gui.surface_view import STEPS, Keys, PointMm, SurfaceView

_FARTHEST_MM = 10_000.0
_ARROWS = (
    ("up", Qt.ArrowType.UpArrow, 0, 1, 0, 1),
    ("left", Qt.ArrowType.LeftArrow, 1, 0, -1, 0),
    ("right", Qt.ArrowType.RightArrow, 1, 2, 1, 0),
    ("down", Qt.ArrowType.DownArrow, 2, 1, 0, -1),
)


class SurfacePicture(SurfaceView):
    """Arrow keys emit `stepped`, a click emits `clicked` with the place in mm."""

    clicked = pyqtSignal(float, float)
    stepped = pyqtSignal(int, int)

    def __init__(self, name: str) -> None:
        self._labels: list[pyqtgraph.TextItem] = []
        super().__init__(name)
        self.setAccessibleDescription("A click sends the beam there; arrow keys move it by a step")
        theme = self.theme
        self._chosen = self.add_spots(30, "o", 15, pyqtgraph.mkPen(theme.accent, width=3))
        self._marks = self.add_spots(31, "s", 11)
        self._spot = self.add_spots(34, "o", 12, pyqtgraph.mkPen(theme.base, width=1.5), theme.fault)

    def show_rig(self, outline: Outline, actuator_mm: Sequence[Numbers]) -> None:
        self.show_outline(outline.line(180))
        self.show_actuators(_points(actuator_mm))
        self.fit()

    def show_spot(self, place_mm: Numbers | None) -> None:
        """Show the beam; None for nowhere on the surface."""
        self._spot.setData(pos=_points([] if place_mm is None else [place_mm]))
        self._cross.setVisible(place_mm is not None)
        if place_mm is not None:
            self._cross.setPos(*place_mm)

    def show_chosen(self, actuator_mm: Numbers | None) -> None:
        """Emphasise the actuator that would play."""
        self._chosen.setData(pos=_points([] if actuator_mm is None else [actuator_mm]))

    def show_marks(self, place_mm: Sequence[Numbers], current: int, done: int) -> None:
        """Show numbered marks: filled when done, the current one large."""
        theme, places = self.theme, range(len(place_mm))
        self._marks.setData(
            pos=_points(place_mm),
            size=[17 if number == current else 11 for number in places],
            brush=[pyqtgraph.mkBrush(theme.good if number < done else theme.base) for number in places],
            pen=[pyqtgraph.mkPen(theme.fault if number == current else theme.text, width=2) for number in places],
        )
        while self._labels:
            self.box.removeItem(self._labels.pop())
        for number, place in enumerate(place_mm):
            label = pyqtgraph.TextItem(str(number + 1), color=theme.text, anchor=(-0.5, 1.0))
            label.setPos(*place)
            self.add_item(label, 40)
            self._labels.append(label)

    def click_at(self, at_mm: PointMm, _keys: Keys) -> None:
        self.clicked.emit(*at_mm)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        if event is None or event.key() not in STEPS:
            super().keyPressEvent(event)
            return
        self.stepped.emit(*(int(step) for step in STEPS[event.key()]))
        event.accept()


def _points(place_mm: Sequence[Numbers]) -> np.ndarray:
    return np.asarray(place_mm, np.float64).reshape(-1, 2)


class Arrows(QWidget):
    """Four arrow buttons around a choice of the step; holding a button repeats it."""

    stepped = pyqtSignal(float, float)

    def __init__(self, steps: Sequence[float], unit: str, chosen: int) -> None:
        super().__init__()
        self._steps = tuple(steps)
        tip = "Step of the arrows; Page up and Page down choose another"
        self.step_choice = ui.choice("Step", tip, [f"{step:g} {unit}" for step in steps], chosen)
        self.buttons: dict[str, QToolButton] = {}
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        for word, arrow, line, place, x, y in _ARROWS:
            tip, name = f"Move the beam {word} by a step (arrow key)", f"Move the beam {word}"
            button = ui.tool_button("", tip, partial(self.step, x, y), name)
            button.setArrowType(arrow)
            button.setAutoRepeat(True)
            button.setAutoRepeatInterval(120)
            grid.addWidget(button, line, place, Qt.AlignmentFlag.AlignCenter)
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
        self.picture = SurfacePicture("Surface: click to send the beam there")
        self.picture.setToolTip("Click: send the beam there. Arrow keys: one step. Wheel: zoom. Drag: pan. Unit: mm")
        self.arrows = Arrows((0.1, 0.5, 1.0, 5.0, 20.0), "mm", 2)
        tip = "{} on the surface in mm, from its middle; seen from the laser, x right, y up"
        self.x_mm, self.y_mm = (
            ui.number_box(f"{axis} in mm", tip.format(axis), " mm", 2, -_FARTHEST_MM, _FARTHEST_MM) for axis in "xy"
        )
        tip = "Send the beam to x, y on the surface"
        self.go = ui.push_button("Go &there", tip, lambda: session.jog_to(self.x_mm.value(), self.y_mm.value()))
        tip = "Send the beam to the middle of the surface, (0, 0) mm"
        self.middle = ui.push_button("&Middle", tip, lambda: session.jog_to(0.0, 0.0))
        tip = "Send the beam to the rig's safe direction (mirror.park_mrad)"
        self.park = ui.button(ui.action(self, "&Park the beam", session.park, "Ctrl+Shift+P", tip=tip))
        self.where = ui.label("Place of the beam", wraps=True, any_width=True)
        form = QFormLayout()
        form.addRow("x", self.x_mm)
        form.addRow("y", self.y_mm)
        controls = ui.row(self.arrows, 12, form, ui.column(self.go, self.middle, self.park), None)
        ui.column((self.picture, 1), self.where, controls, owner=self)
        self.picture.clicked.connect(lambda x, y: session.jog_to(round(x, 2), round(y, 2)))
        self.picture.stepped.connect(self.arrows.step)
        self.arrows.stepped.connect(session.jog_by)
        session.state_changed.connect(self._show_state)
        session.beam_changed.connect(self._show_beam)
        self._show_state()
        self._show_beam()

    def _show_state(self) -> None:
        facts = self._session.facts
        for part in (self.arrows, self.x_mm, self.y_mm, self.go, self.middle):
            part.setEnabled(self._session.state == "ready")
        if facts is not None:
            self.picture.show_rig(surface_from(asdict(facts.surface)).outline, facts.actuator_mm)

    def _show_beam(self) -> None:
        session, beam = self._session, self._session.beam
        self.picture.show_spot(session.place_mm)
        if session.state != "ready":
            text = "The instruments are not open in this window"
        elif beam.x_mrad is None or beam.y_mrad is None:
            text = "Beam: not moved yet"
        else:
            angles = f"({beam.x_mrad:.3f}, {beam.y_mrad:.3f}) mrad"
            if beam.parked:
                text = f"Beam: parked at {angles}"
            elif session.place_mm is None:
                text = f"Beam: at {angles}, outside the surface"
            else:
                text = "Beam: at ({:.2f}, {:.2f}) mm, ".format(*session.place_mm) + angles
        if session.facts is not None and not session.facts.mapped:
            text += "\n▲ The mirror map is not measured: places are as accurate as the rig file"
        self.where.setText(text)
