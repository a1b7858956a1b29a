"""Drives, field and figures of a scene, kept up with its editing, with what saves and plays them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtWidgets import (
    QAction,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QSizePolicy,
    QTabWidget,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.scene.document import EMPTY, SceneDocument
from gui.scene.results.actions_bar import ActionsBar
from gui.scene.results.calculation import Calculation
from gui.scene.results.drives_view import DrivesView
from gui.scene.results.field_view import FieldView
from gui.scene.results.figures import drive_figures, focus_figures
from gui.scene.results.figures_view import FiguresView
from gui.scene.results.messages import (
    Broken,
    Done,
    Driven,
    Failed,
    FieldBegun,
    FieldPart,
    FocusFigures,
    Gone,
    Plate,
    Progress,
    Told,
)
from gui.scene.results.rig_play import RigPlay
from gui.scene.results.saving import Saving
from gui.shell.tab import TabContext
from gui.shell.theme import Theme
from gui.shell.toml_files import names_virtual_rig

_FINDINGS_PER_TICK = 8
# A movie needs more frames than the field has samples while it is edited.
_MOVIE_FINER = 4
_WORDS = {"scene": "reading the scene", "drives": "drives", "field": "field", "figures": "figures"}
# Which part of the bar each stage fills.
_PARTS = {"scene": (0.0, 0.02), "drives": (0.02, 0.25), "field": (0.25, 0.85), "figures": (0.85, 1.0)}
NO_BANK = "choose a bank: drives and field are made of what was measured"
_LOST = "the calculation's process was ended, perhaps for want of memory; it starts anew with the next edit"


class CalculationError(RuntimeError):
    """A defect in the process that calculates; its traceback is the message."""


class ResultsPanel(QWidget):
    """Shows what comes of a scene.

    Parameters
    ----------
    context : TabContext
        What the tabs share.
    document : SceneDocument
        The scene and its bank.
    """

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self.setAccessibleName("Results of the scene")
        self._context, self._document = context, document
        self.calculation = Calculation(context.front)
        self._wanted = self._stopped = False
        self._plate: Plate | None = None
        self.driven: Driven | None = None
        self._begun: FieldBegun | None = None
        self._gathering: NDArray[np.float32] = np.zeros((0, 0), np.float32)
        self._gathered = 0
        self.complete = False
        self.drives, self.field, self.figures = DrivesView(), FieldView(), FiguresView()
        self.saving, self.playing = Saving(context, document, self), RigPlay(context, document, self)
        self.bar = ActionsBar(context, self.saving, self.playing)
        self.stage, self.state = QLabel(), QLabel()
        self.stage.setAccessibleName("Stage of the calculation")
        self.stage.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.state.setAccessibleName("What stands in the way")
        self.state.setWordWrap(True)
        self.state.setMinimumWidth(1)
        self.state.setContentsMargins(4, 0, 4, 0)
        self.state.hide()
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setTextVisible(False)
        self.progress.setAccessibleName("Progress of the calculation")
        self.cancel = QToolButton()
        self.cancel.setText("Stop")
        self.cancel.setAccessibleName("Stop calculating")
        self.cancel.setToolTip("Stop calculating until the next edit")
        self.pages = QTabWidget()
        self.pages.setDocumentMode(True)
        self.pages.setAccessibleName("Results")
        for view, word in ((self.drives, "Drives"), (self.field, "Field"), (self.figures, "Figures")):
            self.pages.addTab(view, word)
        self._lay_out()
        document.changed.connect(self._edited)
        document.bank_changed.connect(self._bank_changed)
        self.cancel.clicked.connect(self._stop)
        self.bar.rig_field.line.editingFinished.connect(self._rig_changed)
        self.bar.rig_field.chosen.connect(lambda _path: self._rig_changed())
        self.bar.save_asked = self.save
        self.bar.play_asked = self.play
        self._rig = self.bar.rig
        self._edited()

    def menu_actions(self) -> list[QAction | None]:
        """What the buttons do, for the tab's menu."""
        return [*self.bar.saves.values(), None, self.bar.play, self.bar.stop]

    def poll(self) -> None:
        """Ask for the latest scene, and take up what was told about it."""
        if self._wanted and self.isVisible():
            self._wanted = False
            self._ask()
        for told in self.calculation.take(_FINDINGS_PER_TICK):
            self._take(told)

    def draw(self) -> None:
        """Nothing is drawn but when it changes."""

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        for part in (self.drives, self.field, self.figures, self.bar):
            part.apply_theme(theme)

    def shut_down(self) -> None:
        """End the calculation; what plays falls silent."""
        self._wanted = False
        self.saving.close()
        self.calculation.close()
        self.playing.close()

    def save(self, kind: str, path: Path) -> None:
        """Save the scene as it is now; see `Saving.save`."""
        rate_hz = None
        if self.driven is not None and self._begun is not None:
            factor = round(self.driven.sample_rate_hz / self._begun.sample_rate_hz)
            rate_hz = self.driven.sample_rate_hz / max(1, factor // _MOVIE_FINER)
        self.saving.save(kind, path, self.bar.rig, rate_hz)

    def play(self) -> None:
        """Play the scene as it is now on the rig."""
        lasts_s = 0.0 if self.driven is None else self.driven.lasts_s
        rig, gain_db, loops = self.bar.rig, self.bar.gain.value(), self.bar.loops.value()
        self._context.claim_instruments(
            self, "Play", lambda: self.playing.play(rig, gain_db, loops, lasts_s), virtual=names_virtual_rig(rig)
        )

    def _lay_out(self) -> None:
        row = QHBoxLayout()
        row.setContentsMargins(4, 0, 4, 0)
        row.addWidget(self.stage, stretch=1)
        row.addWidget(self.progress)
        row.addWidget(self.cancel)
        self.progress.setFixedWidth(120)
        for part in (self.progress, self.cancel):  # what lies below does not jump with every edit
            kept = part.sizePolicy()
            kept.setRetainSizeWhenHidden(True)
            part.setSizePolicy(kept)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(3)
        column.addLayout(row)
        column.addWidget(self.state)
        column.addWidget(self.pages, stretch=1)
        column.addWidget(self.bar)

    def _edited(self) -> None:
        self._wanted = True
        self.complete = False

    def _bank_changed(self) -> None:
        self._clear()
        self._edited()

    def _rig_changed(self) -> None:
        if self.bar.rig != self._rig:
            self._rig = self.bar.rig
            self._context.settings.keep("scene/rig", self._rig)
            self.bar.show_state()
            self._edited()

    def _ask(self) -> None:
        document, rig = self._document, self.bar.rig
        if document.bank is None or not document.draft.source:
            self._halt()
            self._clear()
            self._say(NO_BANK if document.bank is None else EMPTY)
            return
        try:
            self.calculation.ask(
                document.toml(),
                document.place,
                document.bank,
                Path(rig) if rig else None,
                allow_large=document.allow_large,
            )
        except OSError as failure:
            self._context.report_failure(failure)
            return
        self.complete = self._stopped = False
        self._progress("scene", 0.0)

    def _stop(self) -> None:
        self._halt()
        self._say("what is shown may be of an earlier scene: edit the scene to go on", "stopped")

    def _halt(self) -> None:
        self._stopped = True
        if self.calculation.process_id is not None:
            self.calculation.stop()

    def _take(self, told: Told) -> None:
        match told:
            case Progress():
                self._progress(told.stage, told.share)
            case Plate():
                self._plate = told
            case Driven():
                self.driven = told
                self.drives.show_driven(told)
                self.figures.show_figures(drive_figures(told), told.warnings)
                self.bar.show_ready(True)
            case FieldBegun():
                assert self._plate is not None
                self._begun, self._gathered = told, 0
                self._gathering = np.empty((told.samples, len(self._plate.rows)), np.float32)
            case FieldPart():
                self._gather(told)
            case FocusFigures():
                assert self.driven is not None
                assert self._begun is not None
                figures = [*drive_figures(self.driven), *focus_figures(told, self._begun)]
                self.figures.show_figures(figures, self.driven.warnings)
            case Done():
                if not self._stopped:
                    self.complete = True
                    self._say("", "up to date with the scene")
            case Failed():
                self._clear()
                self._say(told.sentence, "not calculated")
            case Gone():
                self._clear()
                self._say(_LOST, "not calculated")
            case Broken():
                self._clear()
                self._say("the calculation met a defect; details are in the message", "not calculated")
                raise CalculationError(told.details)

    def _gather(self, part: FieldPart) -> None:
        self._gathering[:, part.first : part.first + part.values.shape[1]] = part.values
        self._gathered += part.values.shape[1]
        if self._gathered == self._gathering.shape[1]:
            assert self._plate is not None
            assert self.driven is not None
            assert self._begun is not None
            self.field.show_field(self._plate, self.driven, self._begun, self._gathering)
            self._gathering = np.zeros((0, 0), np.float32)

    def _clear(self) -> None:
        self.driven = None
        self.complete = False
        self.drives.show_driven(None)
        self.field.clear()
        self.figures.show_figures([], [])
        self.bar.show_ready(False)

    def _progress(self, stage: str, share: float) -> None:
        first, last = _PARTS[stage]
        self.progress.setValue(round(1000 * (first + share * (last - first))))
        self.progress.setVisible(True)
        self.cancel.setVisible(True)
        self._show("", f"calculating: {_WORDS[stage]}")

    def _say(self, sentence: str, stage: str = "nothing to calculate") -> None:
        self.progress.setVisible(False)
        self.cancel.setVisible(False)
        self._show(sentence, stage)

    def _show(self, sentence: str, stage: str) -> None:
        if stage != self.stage.text():
            self.stage.setText(stage)
        if sentence != self.state.text():
            self.state.setText(sentence)
            self.state.setToolTip(sentence)
            self.state.setVisible(bool(sentence))
