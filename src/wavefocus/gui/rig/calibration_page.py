"""Calibration wizard: its options, its questions, the beam and the residuals of the mirror map."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QAbstractItemView, QPlainTextEdit, QPushButton, QWidget

from wavefocus.config.messages.operate import Numbers
from wavefocus.config.messages.rig_checks import AskAgain, AskConnect, AskJog, MapView
from wavefocus.config.outline import default_marks_mm
from wavefocus.config.rig import Surface
from wavefocus.gui import widgets as ui
from wavefocus.gui.rig.manual_page import Arrows, LevelMeter, SurfacePicture
from wavefocus.gui.rig.session import Calibration
from wavefocus.gui.theme import Themed

_PARTS = (
    ("inputs", "&Inputs: delay between response and reference", "You connect the loopback to both inputs"),
    ("outputs", "&Outputs: latency, volts, polarity", "You connect the response input to each output in turn"),
    ("mirror", "&Mirror: bring the beam onto marks", "You jog the beam onto seven marks: middle, corners, ends"),
    ("actuators", "Actuato&rs: polarity and level", "Nothing to do; the mirror map must be measured before"),
)
_RESIDUALS = ("mark", "x (mm)", "y (mm)", "Δx (mm)", "Δy (mm)", "|Δ| (mm)")
# Answers of both buttons.
_YES = {AskJog: "here", MapView: "keep", AskConnect: "done", AskAgain: "again"}
_NO = {MapView: "drop", AskAgain: "skip"}


class CalibrationPage(Themed, QWidget):
    """Picture on the left, question on the right; `start` receives the options of a calibration's command."""

    def __init__(self, calibration: Calibration, start: Callable[[list[str]], object]) -> None:
        super().__init__()
        self._calibration = calibration
        self.arrows = Arrows((0.05, 0.2, 1.0, 5.0, 20.0), "mrad", 2, calibration.step)
        self.picture = SurfacePicture("Surface with the marks of the mirror map", self.arrows)
        self.picture.setToolTip("Squares: marks, filled when done. Arrow keys move the beam by a step")
        self.parts = {part: ui.check(text, tip, on=part == "mirror") for part, text, tip in _PARTS}
        tip = "Its values override the rig file's; a measured bank keeps its own calibration"
        self.use = ui.check("&Name the new file in the rig file", tip, on=True)
        tip = "Open the instruments and measure; you are asked what to connect"
        self.start = ui.push_button("&Start the calibration", tip, lambda: start(self._options()))
        title, self.options = ui.label(text="Measure the rig's own values", role="strong"), QWidget()
        ui.column(title, *self.parts.values(), self.use, ui.row(self.start, None), owner=self.options)
        self.question = ui.label("Question of the calibration", role="strong", wraps=True)
        self.note = ui.label("Notes", wraps=True)
        self.meter = LevelMeter()
        self.residuals = ui.table(_RESIDUALS, "Residuals of the mirror map in mm", stretched=range(len(_RESIDUALS)))
        self.residuals.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        self.residuals.setToolTip("Mapped place less place of the mark, in mm; choose a row to repeat its mark")
        self.yes, self.no = (
            ui.push_button(text, "Answer the question", partial(self._answer, words))
            for text, words in (("&Yes", _YES), ("&No", _NO))
        )
        tip = "Bring the beam onto the chosen mark once more"
        self.redo = ui.push_button(
            "&Repeat the chosen mark", tip, lambda: calibration.answer("redo", mark=self.chosen_mark or 1)
        )
        tip = "End it: outputs muted, mirror parked, results so far are kept"
        self.cancel = ui.push_button("&Cancel", tip, calibration.cancel, "Cancel the calibration")
        self.report = ui.named(QPlainTextEdit(), "", "Report of the calibration")
        self.report.setReadOnly(True)
        self.report.setMaximumHeight(5 * self.fontMetrics().lineSpacing())
        self._spacer, side = QWidget(), QWidget()
        ui.column(
            self.options,
            self.question,
            self.note,
            ui.row(self.arrows, None),
            self.meter,
            (self.residuals, 1),
            ui.row(self.yes, self.no, self.redo, None, self.cancel),
            self.report,
            (self._spacer, 1),
            owner=side,
            margins=(8, 0, 0, 0),
        )
        self.splitter = ui.side_by_side((self.picture, 640), (side, 600))
        ui.column(self.splitter, owner=self, margins=ui.PAGE_MARGINS)
        for box in self.parts.values():
            box.toggled.connect(lambda _on: self.start.setEnabled(bool(self._chosen())))
        calibration.changed.connect(self._show)
        calibration.level_changed.connect(lambda: self.meter.show_levels(calibration.levels))
        self._show()

    def choose(self, part: str) -> None:
        """Tick one part alone, or all if the name is empty."""
        for name, box in self.parts.items():
            box.setChecked(part in ("", name))

    def _chosen(self) -> list[str]:
        return [name for name, box in self.parts.items() if box.isChecked()]

    def _options(self) -> list[str]:
        return ["--only", ",".join(self._chosen()), *(["--use"] if self.use.isChecked() else [])]

    @property
    def chosen_mark(self) -> int | None:
        rows = {index.row() for index in self.residuals.selectedIndexes()}
        return min(rows) + 1 if rows else None

    def show_surface(self, surface: Surface, actuator_mm: list[Numbers]) -> None:
        self.picture.show_rig(surface.outline, actuator_mm)
        if not self._calibration.running:
            marks_mm = self._calibration.marks_mm = list(default_marks_mm(surface.length_mm, surface.width_mm))
            self.picture.show_marks(marks_mm, -1, 0)

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
        done = len(calibration.marks_mm) if outcome is not None and outcome.file else 0
        self.picture.show_marks(calibration.marks_mm, -1, done)
        if outcome is None:
            self._set_texts(calibration.ending, "")
            return
        note = "\n".join(f"▲ {one}" for one in outcome.problems)
        self._set_texts(f"✔ written: {outcome.file}" if outcome.file else "✖ nothing was written", note)

    def _ask_jog(self, question: AskJog) -> None:
        number, place_mm, at_mrad = question.number, question.place_mm, question.at_mrad
        self.picture.show_marks(self._calibration.marks_mm, number - 1, number - 1)
        self.picture.show_spot(question.at_mm)
        self.picture.setFocus(Qt.FocusReason.OtherFocusReason)
        self._set_texts(
            f"Mark {number} of {question.of}: bring the spot onto ({place_mm[0]:g}, {place_mm[1]:g}) mm",
            question.note or f"The mirror is at ({at_mrad[0]:.3f}, {at_mrad[1]:.3f}) mrad.",
        )
        self._set_button(self.yes, "The spot is &on the mark", "Use these angles for the mark (Return)", "Return")

    def _ask_map(self, question: MapView) -> None:
        problem = question.problem
        self.picture.show_spot(None)
        self.picture.show_marks(question.place_mm, question.suspect - 1 if problem else -1, len(question.place_mm))
        self._list_residuals(question)
        self._set_texts(
            f"Residual of the map: {question.rms_mm:.2f} mm rms, {question.worst_mm:.2f} mm at most"
            if math.isfinite(question.rms_mm) else "These marks determine no map",
            f"▲ {problem}" if problem else "",
        )  # fmt: skip
        self._set_button(self.yes, "&Accept and write", "Write the map into a dated calibration file")
        self.yes.setEnabled(not problem)
        self._set_button(self.no, "&Discard the map", "Do not write the map")

    def _list_residuals(self, question: MapView) -> None:
        table, off_mm = self.residuals, question.off_mm
        table.setRowCount(len(off_mm))
        for number, ((x_mm, y_mm), (x_off, y_off)) in enumerate(zip(question.place_mm, off_mm, strict=False)):
            distance_mm = math.hypot(x_off, y_off)
            beyond = distance_mm > question.limit_mm
            distance = f"▲ {distance_mm:.2f}" if beyond else f"{distance_mm:.2f}"
            texts = (f"{number + 1}", f"{x_mm:.1f}", f"{y_mm:.1f}", f"{x_off:+.2f}", f"{y_off:+.2f}", distance)
            colours = dict.fromkeys(range(len(texts)), self.theme.fault) if beyond else {}
            ui.fill_row(table, number, texts, colours, right=range(len(texts)))
        table.clearSelection()
        if 0 < question.suspect <= len(off_mm):
            table.selectRow(question.suspect - 1)

    def _set_texts(self, question: str, note: str) -> None:
        self.question.setText(question)
        self.note.setText(note)

    @staticmethod
    def _set_button(button: QPushButton, text: str, tip: str, key: str = "") -> None:
        button.setText(text)
        ui.named(button, tip)
        button.setEnabled(True)
        if key:
            button.setShortcut(key)

    def _answer(self, words: Mapping[Any, str]) -> None:
        if (question := self._calibration.question) is not None:
            self._calibration.answer(words[type(question)])
