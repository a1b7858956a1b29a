"""Drives, field and figures of a scene, calculated while it is edited, with the buttons that save and play it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QAction, QToolButton, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.advice import in_window
from wavefocus.gui.files import PathField, choose_place, names_virtual_rig
from wavefocus.gui.scene.calculation import (
    Answer,
    CalculationProgress,
    DriveResult,
    Finished,
    FocusFigures,
    PredictedField,
)
from wavefocus.gui.scene.calculation_process import Calculation
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import EMPTY
from wavefocus.gui.scene.exports import DRIVE, ENDINGS, IDLE, MOVIE, STOPPING, WAV, PlayTask, Saving
from wavefocus.gui.scene.figures_view import FiguresView, drive_figures, field_figures
from wavefocus.gui.scene.result_views import DrivesView, FieldView
from wavefocus.gui.surface import VIRTUAL
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed

# Button, kind, key, tooltip.
_SAVES = (
    ("Save &drive…", DRIVE, "Ctrl+E", "Render the scene exactly and save the drives (V) of all actuators"),
    ("Save &WAV…", WAV, "Ctrl+Shift+E", "Render the scene exactly and save it as a sound file of the rig's interface"),
    ("Save &movie…", MOVIE, "Ctrl+Alt+E", "Predict the field and save it as a moving picture (GIF)"),
)
_KINDS = {DRIVE: "drive file", WAV: "sound file", MOVIE: "movie"}


class ActionsBar(Themed, QWidget):
    """Rows of controls for saving and playing; the owner places `rig_field`, which other pages use, too."""

    rig_changed = pyqtSignal()

    def __init__(
        self,
        context: TabContext,
        saving: Saving,
        playing: PlayTask,
        save: Callable[[str, Path], None],
        play: Callable[[], None],
    ) -> None:
        super().__init__()
        self._context, self._saving, self._playing, self._save = context, saving, playing, save
        self.ready = False
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context.settings, words=(VIRTUAL,))
        self.rig_field.line.setToolTip(
            "Rig file whose limits count and that plays the scene; virtual: the built-in rig"
        )
        self.rig_field.line.setText(context.settings.text("scene/rig"))
        self._rig = self.rig
        tip = "Softer (negative) or louder than saved (dB); the rig's limits hold"
        self.gain = ui.number_box("Gain in dB", tip, " dB", 1, -60.0, 60.0, prefix="gain ")
        self.loops = ui.whole_box("Repetitions", "Number of repetitions, without a gap", 1, 10_000, "× ")
        self.state = ui.label(role="faint", any_width=True)
        self.state.setMinimumWidth(60)
        self.saves: dict[str, QAction] = {
            kind: ui.action(self, words, partial(self._choose, kind), keys, tip=tip)
            for words, kind, keys, tip in _SAVES
        }
        self.cancel = ui.action(self, "&Cancel", saving.cancel, tip="Cancel saving")
        self.play = ui.action(self, "&Play", play, "F9", tip="Render within the rig's limits and play")
        self.stop = ui.action(self, "&Stop", playing.stop, "Shift+F9", tip="Stop at once and mute the outputs")
        actions = {**self.saves, "cancel": self.cancel, "play": self.play, "stop": self.stop}
        self.buttons: dict[str, QToolButton] = {name: ui.button(action) for name, action in actions.items()}
        *saves, plays, stops = self.buttons.values()
        player = ui.row(self.gain, self.loops, plays, stops, None)
        ui.column(ui.row(*saves, None), player, self.state, owner=self, margins=(4, 2, 4, 2), spacing=4)
        for part in (saving, playing):
            part.changed.connect(self.show_state)
        self.rig_field.line.editingFinished.connect(self._check_rig)
        self.rig_field.chosen.connect(lambda _path: self._check_rig())
        self.show_state()

    @property
    def rig(self) -> str:
        """The rig file, or ``virtual``, as the command line takes it; empty where there is none."""
        text = self.rig_field.line.text().strip()
        return text if text in ("", VIRTUAL) else str(self.rig_field.path)

    def use_rig(self, path: Path) -> None:
        """Use a rig file that was chosen elsewhere."""
        self.rig_field.show_path(path)
        self._check_rig()

    def show_ready(self, ready: bool) -> None:
        """Set whether there is a scene that can be rendered."""
        if ready != self.ready:
            self.ready = ready
            self.show_state()

    def show_state(self) -> None:
        """Show what can be done now, and what is being done."""
        saving, playing = self._saving.busy, self._playing.state
        for action in self.saves.values():
            action.setEnabled(self.ready and not saving)
        self.cancel.setEnabled(saving)
        self.buttons["cancel"].setVisible(saving)
        self.play.setEnabled(self.ready and playing == IDLE and bool(self.rig))
        self.stop.setEnabled(playing not in (IDLE, STOPPING))
        texts = [self._saving.text] if saving else []
        if playing != IDLE:
            texts.append(self._playing.text)
        elif self.ready and not self.rig and not saving:
            texts.append("choose a rig to play")
        self.state.setText("; ".join(texts))
        self.state.setToolTip(self.state.text())

    def redraw(self) -> None:
        self.buttons["stop"].setStyleSheet(f"QToolButton:enabled {{ color: {self.theme.warning}; font-weight: 600; }}")

    def _check_rig(self) -> None:
        if self.rig != self._rig:
            self._rig = self.rig
            self._context.settings.keep("scene/rig", self._rig)
            self.show_state()
            self.rig_changed.emit()

    def _choose(self, kind: str) -> None:
        suggested, save = self._saving.suggested(kind), partial(self._save, kind)
        choose_place(self, f"Save {kind}", suggested, _KINDS[kind], ENDINGS[kind], save)


_ANSWERS_PER_TICK = 8
# A movie needs more frames than the field has samples while it is edited.
_MOVIE_FINER = 4
# Where each stage begins and ends on the progress bar.
_STAGES = {"scene": (0.0, 0.02), "drives": (0.02, 0.25), "field": (0.25, 0.85), "figures": (0.85, 1.0)}
NO_BANK = "choose a bank: drives and field are computed from its measurements"


class CalculationError(RuntimeError):
    """A defect in the process that calculates; its traceback is the message."""


class ResultsPanel(QWidget):
    """Results of the present scene."""

    #: Levels at the quiet places of the latest drives.
    levels_changed = pyqtSignal(object)

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self.setAccessibleName("Results of the scene")
        self._context, self._document = context, document
        self.calculation = Calculation()
        self._wanted = self._stopped = False
        self.driven: DriveResult | None = None
        self.predicted: PredictedField | None = None
        self.complete = False
        self.drives, self.field, self.figures = DrivesView(), FieldView(), FiguresView()
        self.saving, self.playing = Saving(context, document, self), PlayTask(context, document, self)
        self.bar = ActionsBar(context, self.saving, self.playing, self.save, self.play)
        self.stage = ui.label("Stage of the calculation", any_width=True)
        self.problem = ui.label("Problem of the calculation", wraps=True)
        self.problem.setMinimumWidth(1)
        self.problem.setContentsMargins(4, 0, 4, 0)
        self.problem.hide()
        self.progress = ui.progress_bar("Progress of the calculation")
        self.progress.setRange(0, 1000)
        self.progress.setFixedWidth(120)
        self.cancel = ui.tool_button("Stop", "Stop calculating until the next edit", self._stop, "Stop calculating")
        self.pages = ui.tab_pages("Results", {"Drives": self.drives, "Field": self.field, "Figures": self.figures})
        for part in (self.progress, self.cancel):
            policy = part.sizePolicy()
            policy.setRetainSizeWhenHidden(True)  # widgets below stay in place while they come and go
            part.setSizePolicy(policy)
        head = ui.row((self.stage, 1), self.progress, self.cancel, margins=(4, 0, 4, 0))
        ui.column(head, self.problem, (self.pages, 1), self.bar, owner=self, spacing=3)
        document.changed.connect(self._edited)
        for act in (self._clear, self._edited):
            document.bank_changed.connect(act)
        self.bar.rig_changed.connect(self._edited)
        self._edited()

    def menu_actions(self) -> list[QAction | None]:
        """The buttons' actions, for the tab's menu."""
        return [*self.bar.saves.values(), None, self.bar.play, self.bar.stop]

    def poll(self) -> None:
        """Ask for the latest scene, and show answers."""
        if self._wanted and self.isVisible():
            self._wanted = False
            self._ask()
        for answer in self.calculation.take(_ANSWERS_PER_TICK):
            self._show_answer(answer)

    def pause(self) -> None:
        """Calculate nothing until the panel is shown again."""
        if not self.complete:
            self._halt()
            self._wanted = True

    def shut_down(self) -> None:
        """End all processes; what plays is muted."""
        self._wanted = False
        self.saving.close()
        self.calculation.close()
        self.playing.close()

    def save(self, kind: str, path: Path) -> None:
        """Save the present scene; see `Saving.save`."""
        rate_hz = None
        if self.driven is not None and self.predicted is not None:
            factor = round(self.driven.sample_rate_hz / self.predicted.sample_rate_hz)
            rate_hz = self.driven.sample_rate_hz / max(1, factor // _MOVIE_FINER)
        self.saving.save(kind, path, self.bar.rig, rate_hz)

    def play(self) -> None:
        """Play the present scene on the rig."""
        lasts_s = 0.0 if self.driven is None else self.driven.lasts_s
        rig, gain_db, loops = self.bar.rig, self.bar.gain.value(), self.bar.loops.whole()
        self._context.claim_instruments(
            self, "Play", lambda: self.playing.play(rig, gain_db, loops, lasts_s), virtual=names_virtual_rig(rig)
        )

    def _edited(self) -> None:
        self._wanted = True
        self.complete = False

    def _ask(self) -> None:
        document, rig = self._document, self.bar.rig
        if document.bank is None or not document.draft.source:
            self._halt()
            self._clear()
            self._show_state(NO_BANK if document.bank is None else EMPTY)
            return
        draft, place, bank = document.draft, document.place, document.bank
        try:
            self.calculation.ask(draft, place, bank, Path(rig) if rig else None, allow_large=document.allow_large)
        except OSError as failure:
            self._context.report_failure(failure)
            return
        self.complete = self._stopped = False
        self._show_progress("scene", 0.0)

    def _stop(self) -> None:
        self._halt()
        self._show_state("the results may be of an earlier scene: edit the scene to go on", "stopped")

    def _halt(self) -> None:
        self._stopped = True
        if self.calculation.process_id is not None:
            self.calculation.stop()

    def _show_answer(self, answer: Answer) -> None:
        match answer:
            case CalculationProgress():
                self._show_progress(answer.stage, answer.share)
            case DriveResult():
                self.driven = answer
                self.drives.show_driven(answer)
                self.figures.show_figures(drive_figures(answer), answer.warnings)
                self.levels_changed.emit(answer.levels)
                self.bar.show_ready(True)
            case PredictedField():
                assert self.driven is not None
                self.predicted = answer
                self.field.show_field(self.driven, answer)
            case FocusFigures():
                assert self.driven is not None
                assert self.predicted is not None
                figures = [*drive_figures(self.driven), *field_figures(answer, self.predicted)]
                self.figures.show_figures(figures, self.driven.warnings)
            case Finished():
                if answer.problem:
                    self._clear()
                    self._show_state(answer.problem, "not calculated")
                elif not self._stopped:
                    self.complete = True
                    self._show_state("", "up to date with the scene")
                if answer.defect:
                    raise CalculationError(answer.defect)

    def _clear(self) -> None:
        self.driven = self.predicted = None
        self.complete = False
        self.drives.show_driven(None)
        self.field.clear()
        self.figures.show_figures([], [])
        self.levels_changed.emit(())
        self.bar.show_ready(False)

    def _show_progress(self, stage: str, share: float) -> None:
        first, last = _STAGES[stage]
        self.progress.setValue(round(1000 * (first + share * (last - first))))
        self._show_state("", f"calculating: {stage}", busy=True)

    def _show_state(self, problem: str, stage: str = "nothing to calculate", *, busy: bool = False) -> None:
        self.progress.setVisible(busy)
        self.cancel.setVisible(busy)
        self.stage.setText(stage)
        problem = in_window(problem)
        if problem != self.problem.text():
            self.problem.setText(problem)
            self.problem.setToolTip(problem)
            self.problem.setVisible(bool(problem))
