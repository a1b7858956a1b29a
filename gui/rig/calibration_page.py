"""Calibration wizard: shows the questions of the calibration, the beam and the residuals of the mirror map."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import (
    QAbstractItemView,
    QHBoxLayout,
    QLabel,
    QPlainTextEdit,
    QPushButton,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)

from config.messages.calibrate import AskAgain, AskConnect, AskJog, MapView
from config.outline import default_marks_mm
from config.rig import Surface
from gui.rig.calibration import Calibration
from gui.rig.calibration_options import CalibrationOptions
from gui.rig.jog import Arrows, SurfacePicture
from gui.rig.manual_page import LevelMeter
from gui.rig.messages import Pair
from gui.shell.files import Settings
from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import make_table, named, side_by_side

_STEPS_MRAD = (0.05, 0.2, 1.0, 5.0, 20.0)
_RESIDUALS = ("mark", "x (mm)", "y (mm)", "Δx (mm)", "Δy (mm)", "|Δ| (mm)")
_YES = {AskJog: "here", MapView: "keep", AskConnect: "done", AskAgain: "again"}


class CalibrationPage(QWidget):
    """Picture on the left, question on the right."""

    def __init__(self, calibration: Calibration, settings: Settings) -> None:
        super().__init__()
        self._calibration = calibration
        self._theme = LIGHT
        self._drawn = {"question": -1, "level": -1}
        self._marks_mm: list[Pair] = []
        self.picture = SurfacePicture("Surface with the marks of the mirror map")
        self.picture.setToolTip("Squares: marks, filled when done. Arrow keys move the beam by a step")
        self.options = CalibrationOptions(settings)
        self.question, self.note = QLabel(), QLabel()
        self.question.setAccessibleName("Question of the calibration")
        self.question.setProperty("role", "strong")
        self.note.setAccessibleName("Notes")
        self.arrows = Arrows(_STEPS_MRAD, "mrad", 2)
        self.meter = LevelMeter()
        self.residuals = make_table(_RESIDUALS, "Residuals of the mirror map in mm", stretched=range(len(_RESIDUALS)))
        self.residuals.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        self.residuals.setToolTip("Mapped place less place of the mark, in mm; choose a row to repeat its mark")
        self.yes, self.no = (named(QPushButton(text), "Answer the question") for text in ("&Yes", "&No"))
        self.redo = named(QPushButton("&Repeat the chosen mark"), "Bring the beam onto the chosen mark once more")
        self.cancel = named(
            QPushButton("&Cancel"), "End it: outputs muted, mirror parked, results so far are kept",
            "Cancel the calibration",
        )  # fmt: skip
        self.report = QPlainTextEdit()
        self.report.setReadOnly(True)
        self.report.setAccessibleName("Report of the calibration")
        self._spacer = QWidget()
        self._lay_out()
        self._show()
        self.arrows.stepped.connect(calibration.step)
        self.picture.stepped.connect(self._step)
        self.yes.clicked.connect(self._answer_yes)
        self.no.clicked.connect(self._answer_no)
        self.redo.clicked.connect(lambda: calibration.answer("redo", mark=self.chosen_mark or 1))
        self.cancel.clicked.connect(calibration.cancel)

    @property
    def chosen_mark(self) -> int | None:
        rows = {index.row() for index in self.residuals.selectedIndexes()}
        return min(rows) + 1 if rows else None

    def show_surface(self, surface: Surface, actuator_mm: list[Pair]) -> None:
        self.options.size_mm = (surface.length_mm, surface.width_mm)
        self.picture.show_rig(surface.outline, actuator_mm)
        if not self._calibration.running:
            self._marks_mm = list(default_marks_mm(surface.length_mm, surface.width_mm))
            self.picture.show_marks(self._marks_mm, -1, 0)

    def draw(self, *, has_rig: bool) -> None:
        calibration = self._calibration
        self.options.setEnabled(has_rig and not calibration.running)
        if self._drawn["question"] != calibration.revision["question"]:
            self._drawn["question"] = calibration.revision["question"]
            self._show()
        if self._drawn["level"] != calibration.revision["level"]:
            self._drawn["level"] = calibration.revision["level"]
            self.meter.show_levels(calibration.levels)

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        self.picture.apply_theme(theme)
        self.meter.apply_theme(theme)
        if self._marks_mm:
            self.picture.show_marks(self._marks_mm, -1, 0)
        self._drawn["question"] = -1

    def _lay_out(self) -> None:
        for label in (self.question, self.note):
            label.setWordWrap(True)
        self.report.setMaximumHeight(5 * self.fontMetrics().lineSpacing())
        buttons, jog, side = QHBoxLayout(), QHBoxLayout(), QWidget()
        for button in (self.yes, self.no, self.redo):
            buttons.addWidget(button)
        buttons.addStretch(1)
        buttons.addWidget(self.cancel)
        jog.addWidget(self.arrows)
        jog.addStretch(1)
        column = QVBoxLayout(side)
        column.setContentsMargins(8, 0, 0, 0)
        for widget in (self.options, self.question, self.note):
            column.addWidget(widget)
        column.addLayout(jog)
        column.addWidget(self.meter)
        column.addWidget(self.residuals, stretch=1)
        column.addLayout(buttons)
        column.addWidget(self.report)
        column.addWidget(self._spacer, stretch=1)
        self.splitter = side_by_side((self.picture, 640), (side, 600))
        row = QHBoxLayout(self)
        row.setContentsMargins(4, 6, 4, 4)
        row.addWidget(self.splitter)

    def _show(self) -> None:
        calibration = self._calibration
        question, running = calibration.question, calibration.running
        jogs, maps = isinstance(question, AskJog), isinstance(question, MapView)
        for widget, visible in (
            (self.options, not running),
            (self.arrows, jogs),
            (self.meter, jogs),
            (self.residuals, maps),
            (self.yes, question is not None),
            (self.no, isinstance(question, MapView | AskAgain)),
            (self.redo, maps),
            (self.cancel, running),
            (self.report, bool(calibration.lines)),
            (self._spacer, not maps),
        ):
            widget.setVisible(visible)
        self.report.setPlainText("\n".join(calibration.lines))
        match question:
            case None:
                self._show_state()
            case AskJog():
                self._ask_jog(question)
            case MapView():
                self._ask_map(question)
            case AskConnect(sentence=sentence):
                self._set_texts(sentence.capitalize(), "")
                self._set_button(self.yes, "It is &connected", "Continue (Return)", "Return")
            case AskAgain(problem=problem):
                self._set_texts(f"▲ {problem}", "Check cables and power first.")
                self._set_button(self.yes, "&Try again", "Measure it again")
                self._set_button(self.no, "&Leave it out", "Continue without it; the rest is measured")

    def _show_state(self) -> None:
        calibration, outcome = self._calibration, self._calibration.outcome
        if calibration.running:
            self._set_texts("measuring…", "")
            return
        self.picture.show_spot(None)
        if outcome is None:
            self._set_texts(calibration.ending, "")
            return
        note = "\n".join(f"▲ {one}" for one in outcome.problems)
        self._set_texts(f"✔ written: {outcome.file}" if outcome.file else "✖ nothing was written", note)

    def _ask_jog(self, question: AskJog) -> None:
        number, count, place_mm, at_mrad = question.number, question.of, question.place_mm, question.at_mrad
        self._marks_mm = self._calibration.marks_mm
        self.picture.show_residuals([], [])
        self.picture.show_marks(self._marks_mm, number - 1, number - 1)
        self.picture.show_spot(question.at_mm)
        self.picture.setFocus(Qt.FocusReason.OtherFocusReason)
        self._set_texts(
            f"Mark {number} of {count}: bring the spot onto ({place_mm[0]:g}, {place_mm[1]:g}) mm",
            question.note or f"The mirror is at ({at_mrad[0]:.3f}, {at_mrad[1]:.3f}) mrad.",
        )
        self._set_button(self.yes, "The spot is &on the mark", "Use these angles for the mark (Return)", "Return")

    def _ask_map(self, question: MapView) -> None:
        places_mm, off_mm, problem, suspect = question.place_mm, question.off_mm, question.problem, question.suspect
        self._marks_mm = list(places_mm)
        self.picture.show_spot(None)
        self.picture.show_marks(places_mm, suspect - 1 if problem else -1, len(places_mm))
        times = self.picture.show_residuals(places_mm, off_mm)
        self._list_residuals(places_mm, off_mm, question.limit_mm, suspect)
        scale = f"Residuals are drawn {times:g} times larger." if off_mm else ""
        self._set_texts(
            f"Residual of the map: {question.rms_mm:.2f} mm rms, {question.worst_mm:.2f} mm at most"
            if math.isfinite(question.rms_mm) else "These marks determine no map",
            f"▲ {problem}\n{scale}" if problem else scale,
        )  # fmt: skip
        self._set_button(self.yes, "&Accept and write", "Write the map into a dated calibration file")
        self.yes.setEnabled(not problem)
        self._set_button(self.no, "&Discard the map", "Do not write the map")

    def _list_residuals(self, places_mm: Sequence[Pair], off_mm: Sequence[Pair], limit_mm: float, suspect: int) -> None:
        table = self.residuals
        table.setRowCount(len(off_mm))
        for row, ((x_mm, y_mm), (x_off, y_off)) in enumerate(zip(places_mm, off_mm, strict=False)):
            distance_mm = math.hypot(x_off, y_off)
            beyond = distance_mm > limit_mm
            numbers = (f"{row + 1}", f"{x_mm:.1f}", f"{y_mm:.1f}", f"{x_off:+.2f}", f"{y_off:+.2f}")
            for column, text in enumerate((*numbers, f"▲ {distance_mm:.2f}" if beyond else f"{distance_mm:.2f}")):
                item = QTableWidgetItem(text)
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                if beyond:
                    item.setForeground(QColor(self._theme.fault))
                table.setItem(row, column, item)
        table.clearSelection()
        if 0 < suspect <= len(off_mm):
            table.selectRow(suspect - 1)

    def _set_texts(self, question: str, note: str) -> None:
        self.question.setText(question)
        self.note.setText(note)

    @staticmethod
    def _set_button(button: QPushButton, text: str, tip: str, key: str = "") -> None:
        button.setText(text)
        named(button, tip)
        button.setEnabled(True)
        if key:
            button.setShortcut(key)

    def _step(self, x: int, y: int) -> None:
        question = self._calibration.question
        if isinstance(question, AskJog):
            self.arrows.step(x, y)

    def _answer_yes(self) -> None:
        if (question := self._calibration.question) is not None:
            self._calibration.answer(_YES[type(question)])

    def _answer_no(self) -> None:
        if (question := self._calibration.question) is not None:
            self._calibration.answer("drop" if isinstance(question, MapView) else "skip")
