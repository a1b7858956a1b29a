"""The calibration wizard: asks a person what the command asks, shows where the beam is and how well the map fits."""

from __future__ import annotations

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QHBoxLayout, QLabel, QPlainTextEdit, QPushButton, QVBoxLayout, QWidget

from acquisition.calibration_procedures.marks import default_marks_mm
from gui.rig.arrows import Arrows
from gui.rig.calibration import Ask, Calibration, Pair
from gui.rig.calibration_start import CalibrationStart
from gui.rig.level_meter import LevelMeter
from gui.rig.residual_table import ResidualTable
from gui.rig.surface_picture import SurfacePicture
from gui.shell.settings import Settings
from gui.shell.theme import Theme
from gui.shell.widgets import side_by_side

_STEPS_MRAD = (0.05, 0.2, 1.0, 5.0, 20.0)


class CalibrationPage(QWidget):
    """Picture on the left, question on the right.

    Parameters
    ----------
    calibration : Calibration
        Asks and is answered.
    settings : Settings
        Knows folders.
    """

    def __init__(self, calibration: Calibration, settings: Settings) -> None:
        super().__init__()
        self._calibration = calibration
        self._seen = {"ask": -1, "level": -1}
        self._marks: list[Pair] = []
        self.picture = SurfacePicture("Surface with the marks of the mirror map")
        self.picture.setToolTip("Squares: marks, filled once they were met. Arrow keys move the beam by a step")
        self.start = CalibrationStart(settings)
        self.question, self.note = QLabel(), QLabel()
        self.question.setAccessibleName("What is to be done")
        self.question.setProperty("role", "strong")
        self.note.setAccessibleName("Notes")
        self.arrows = Arrows(_STEPS_MRAD, "mrad", 2)
        self.meter = LevelMeter()
        self.residuals = ResidualTable()
        self.yes, self.no, self.redo = QPushButton(), QPushButton(), QPushButton("&Meet the chosen mark again")
        self._word(self.yes, "&Yes", "Answer what the calibration asks")
        self._word(self.no, "&No", "Answer what the calibration asks")
        self.redo.setAccessibleName("Meet the chosen mark again")
        self.redo.setToolTip("Bring the beam onto the mark that is chosen in the table once more")
        self.cancel = QPushButton("&Cancel")
        self.cancel.setAccessibleName("Cancel the calibration")
        self.cancel.setToolTip("Leave it: the outputs are muted, the mirror is parked, what was measured stays")
        self.told = QPlainTextEdit()
        self.told.setReadOnly(True)
        self.told.setAccessibleName("What the calibration tells")
        self._rest = QWidget()  # keeps what is above it at the top
        self._lay_out()
        self._show()
        self.arrows.stepped.connect(calibration.step)
        self.picture.stepped.connect(self._step)
        self.yes.clicked.connect(self._yes)
        self.no.clicked.connect(self._no)
        self.redo.clicked.connect(lambda: calibration.answer("redo", mark=self.residuals.chosen or 1))
        self.cancel.clicked.connect(calibration.cancel)

    def show_surface(self, length_mm: float, width_mm: float, actuator_mm: list[Pair]) -> None:
        """Show another rig's surface."""
        self.start.size_mm = (length_mm, width_mm)
        self.picture.show_surface(length_mm, width_mm, actuator_mm)
        if not self._calibration.running:
            self._marks = list(default_marks_mm(length_mm, width_mm))
            self.picture.show_marks(self._marks, -1, 0)

    def draw(self, *, has_rig: bool) -> None:
        """Draw what changed."""
        calibration = self._calibration
        self.start.setEnabled(has_rig and not calibration.running)
        if self._seen["ask"] != calibration.revision["ask"]:
            self._seen["ask"] = calibration.revision["ask"]
            self._show()
        if self._seen["level"] != calibration.revision["level"]:
            self._seen["level"] = calibration.revision["level"]
            self.meter.show_levels(calibration.reference, calibration.response, None)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.picture.apply_theme(theme)
        self.meter.apply_theme(theme)
        self.residuals.theme = theme
        if self._marks:
            self.picture.show_marks(self._marks, -1, 0)
        self._seen["ask"] = -1

    def _lay_out(self) -> None:
        for label in (self.question, self.note):
            label.setWordWrap(True)
        self.told.setMaximumHeight(5 * self.fontMetrics().lineSpacing())
        buttons = QHBoxLayout()
        for button in (self.yes, self.no, self.redo):
            buttons.addWidget(button)
        buttons.addStretch(1)
        buttons.addWidget(self.cancel)
        jog = QHBoxLayout()
        jog.addWidget(self.arrows)
        jog.addStretch(1)
        side = QWidget()
        column = QVBoxLayout(side)
        column.setContentsMargins(8, 0, 0, 0)
        column.addWidget(self.start)
        column.addWidget(self.question)
        column.addWidget(self.note)
        column.addLayout(jog)
        column.addWidget(self.meter)
        column.addWidget(self.residuals, stretch=1)
        column.addLayout(buttons)
        column.addWidget(self.told)
        column.addWidget(self._rest, stretch=1)
        self.splitter = side_by_side((self.picture, 640), (side, 600))
        row = QHBoxLayout(self)
        row.setContentsMargins(4, 6, 4, 4)
        row.addWidget(self.splitter)

    def _show(self) -> None:
        calibration = self._calibration
        ask, running = calibration.ask, calibration.running
        what = ask.what if ask is not None else ""
        for widget, seen in (
            (self.start, not running),
            (self.question, True),
            (self.note, True),
            (self.arrows, what == "jog"),
            (self.meter, what == "jog"),
            (self.residuals, what == "map"),
            (self.yes, bool(what)),
            (self.no, what in ("map", "again")),
            (self.redo, what == "map"),
            (self.cancel, running),
            (self.told, bool(calibration.lines)),
            (self._rest, what != "map"),
        ):
            widget.setVisible(seen)
        self.told.setPlainText("\n".join(calibration.lines))
        if ask is None:
            self._show_no_question()
            return
        {"jog": self._ask_jog, "map": self._ask_map, "connect": self._ask_connect}.get(what, self._ask_again)(ask)

    def _show_no_question(self) -> None:
        calibration = self._calibration
        note = ""
        if calibration.running:
            words = "measuring…"
        elif (outcome := calibration.outcome) is not None:
            problems = outcome.get("problems")
            file = outcome.get("file")
            words = f"✔ written: {file}" if file else "✖ nothing was written"
            note = "\n".join(f"▲ {one}" for one in problems) if isinstance(problems, list) else ""
        else:
            words = calibration.ending
        if not calibration.running:
            self.picture.show_spot(None)
        self.question.setText(words)
        self.note.setText(note)

    def _ask_jog(self, ask: Ask) -> None:
        number, of = int(ask.figure("number") or 1), int(ask.figure("of") or 1)
        place, at_mrad = ask.pair("place_mm") or (0.0, 0.0), ask.pair("at_mrad") or (0.0, 0.0)
        self._marks = self._calibration.marks
        self.picture.show_residuals([], [])
        self.picture.show_marks(self._marks, number - 1, number - 1)
        self.picture.show_spot(ask.pair("at_mm"))
        self.picture.setFocus(Qt.FocusReason.OtherFocusReason)
        self.question.setText(f"Mark {number} of {of}: bring the spot onto ({place[0]:g}, {place[1]:g}) mm")
        self.note.setText(ask.words("note") or f"The mirror stands at ({at_mrad[0]:.3f}, {at_mrad[1]:.3f}) mrad.")
        self._word(self.yes, "The spot is &on the mark", "Take these angles for the mark, and go on (Return)")
        self.yes.setShortcut("Return")

    def _ask_map(self, ask: Ask) -> None:
        places, off = ask.pairs("place_mm"), ask.pairs("off_mm")
        rms_mm, worst_mm, limit_mm = (ask.figure(key) for key in ("rms_mm", "worst_mm", "limit_mm"))
        problem = ask.words("problem")
        self._marks = places
        self.picture.show_spot(None)
        self.picture.show_marks(places, int(ask.figure("suspect") or 0) - 1 if problem else -1, len(places))
        times = self.picture.show_residuals(places, off)
        self.residuals.show_residuals(places, off, limit_mm or 0.0, int(ask.figure("suspect") or 0))
        if rms_mm is not None and worst_mm is not None:
            self.question.setText(f"The map misses the marks by {rms_mm:.2f} mm rms, {worst_mm:.2f} mm at most")
        else:
            self.question.setText("These marks give no map")
        drawn = f"Residuals are drawn {times:g} times larger." if off else ""
        self.note.setText(f"▲ {problem}\n{drawn}" if problem else drawn)
        self._word(self.yes, "&Accept and write", "Write the map into a dated calibration file")
        self.yes.setEnabled(not problem)
        self._word(self.no, "&Leave the map", "Write nothing of it")

    def _ask_connect(self, ask: Ask) -> None:
        self.question.setText(ask.words("sentence").capitalize())
        self.note.setText("")
        self._word(self.yes, "It is &plugged in", "Go on measuring (Return)")
        self.yes.setShortcut("Return")

    def _ask_again(self, ask: Ask) -> None:
        self.question.setText(f"▲ {ask.words('problem')}")
        self.note.setText("Look at cables and power first.")
        self._word(self.yes, "&Try once more", "Measure it again")
        self._word(self.no, "&Leave it out", "Go on without it; the rest is measured")

    @staticmethod
    def _word(button: QPushButton, words: str, tip: str) -> None:
        button.setText(words)
        button.setAccessibleName(words.replace("&", ""))
        button.setToolTip(tip)
        button.setEnabled(True)

    def _step(self, x: int, y: int) -> None:
        ask = self._calibration.ask
        if ask is not None and ask.what == "jog":
            self.arrows.step(x, y)

    def _yes(self) -> None:
        ask = self._calibration.ask
        if ask is not None:
            words = {"jog": "here", "map": "keep", "connect": "done", "again": "again"}
            self._calibration.answer(words[ask.what])

    def _no(self) -> None:
        ask = self._calibration.ask
        if ask is not None:
            self._calibration.answer("drop" if ask.what == "map" else "skip")
