"""Drives, field and figures of a scene, calculated while it is edited, with the buttons that save and play it."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QAction, QToolButton, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.files import PathField, choose_place, file_state, names_virtual_rig
from wavefocus.gui.scene.calculation import Calculation, SceneResults
from wavefocus.gui.scene.document import EMPTY, SceneDocument
from wavefocus.gui.scene.exports import IDLE, KINDS, PLAYING, STOPPING, PlayTask, Saving
from wavefocus.gui.scene.result_views import DrivesView, FieldView, figures_table, fill_figures
from wavefocus.gui.surface import VIRTUAL, PlotSurface
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed

if TYPE_CHECKING:
    from wavefocus.storage.field_file import Field


class ActionsBar(Themed, QWidget):
    """Rows of controls for saving and playing; the owner places `rig_field`, which other pages use, too."""

    rig_changed = pyqtSignal()

    def __init__(
        self,
        context: TabContext,
        saving: Saving,
        playing: PlayTask,
        save: Callable[[Path], None],
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
        self.loops = ui.number_box(
            "Repetitions", "Number of repetitions, without a gap", "", 0, 1.0, 10_000.0, value=1.0, prefix="× "
        )
        self.state = ui.label(role="faint", any_width=True)
        self.state.setMinimumWidth(60)
        tip = "Render the scene exactly and save the drives (V), or the sound file of the rig's interface (.wav)"
        self.save = ui.action(self, "Save &drive…", self._choose, "Ctrl+E", tip=tip)
        self.cancel = ui.action(self, "&Cancel", saving.cancel, tip="Cancel saving")
        self.play = ui.action(self, "&Play", play, "F9", tip="Render within the rig's limits and play")
        self.stop = ui.action(self, "&Stop", playing.stop, "Shift+F9", tip="Stop at once and mute the outputs")
        actions = {"drive": self.save, "cancel": self.cancel, "play": self.play, "stop": self.stop}
        self.buttons: dict[str, QToolButton] = {name: ui.button(action) for name, action in actions.items()}
        *saves, plays, stops = self.buttons.values()
        stops.setStyleSheet(f"QToolButton:enabled {{ color: {self.theme.warning}; font-weight: 600; }}")
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
        self.save.setEnabled(self.ready and not saving)
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

    def _check_rig(self) -> None:
        if self.rig != self._rig:
            self._rig = self.rig
            self._context.settings.keep("scene/rig", self._rig)
            self.show_state()
            self.rig_changed.emit()

    def _choose(self) -> None:
        choose_place(self, "Save the drives", self._saving.suggested, KINDS, self._save)


NO_BANK = "choose a bank: drives and field are computed from its measurements"


class ResultsPanel(Themed, QWidget):
    """Results of the present scene, its warnings above them."""

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self.setAccessibleName("Results of the scene")
        self._context, self._document = context, document
        self.calculation = Calculation(document, self)
        self._due_s = self._look_due_s = 0.0
        self._wanted = False
        self._stage = ""
        self._bank_state: object = None
        self.results: SceneResults | None = None
        self.complete = False
        self.drives, self.field, self.figures = DrivesView(), FieldView(), figures_table()
        self.saving, self.playing = Saving(context, document), PlayTask(context, document)
        self.bar = ActionsBar(context, self.saving, self.playing, self.save, self.play)
        self.stage = ui.label("Stage of the calculation", any_width=True)
        self.problem = ui.label("Problem of the calculation", wraps=True)
        self.problem.setMinimumWidth(1)
        self.warnings = ui.label("Warnings of the scene", wraps=True, selectable=True)
        self.warnings.setMinimumWidth(1)
        self.warnings.setStyleSheet(f"QLabel {{ color: {self.theme.warning}; }}")
        self._warned = ui.scrolling(self.warnings)
        self._warned.setMaximumHeight(4 * self.warnings.fontMetrics().lineSpacing())
        self._warned.hide()
        self.cancel = ui.tool_button("Stop", "Stop calculating until the next edit", self._stop, "Stop calculating")
        self.pages = ui.tab_pages("Results", {"Drives": self.drives, "Field": self.field, "Figures": self.figures})
        head = ui.row((self.stage, 1), self.cancel, margins=(4, 0, 4, 0))
        ui.column(head, self.problem, self._warned, (self.pages, 1), self.bar, owner=self, spacing=3)
        for changed in (document.changed, document.bank_changed, self.bar.rig_changed):
            changed.connect(self._edited)
        self.calculation.stage.connect(self._begin)
        self.calculation.made.connect(self._show)
        self.calculation.refused.connect(self._refuse)
        self._edited()

    def menu_actions(self) -> list[QAction | None]:
        """The buttons' actions, for the tab's menu."""
        return [self.bar.save, None, self.bar.play, self.bar.stop]

    def poll(self) -> None:
        """Calculate the latest scene once it is not edited any more, and again when the bank has changed."""
        now_s, document = time.monotonic(), self._document
        if self.playing.state == PLAYING:  # its time goes on
            self.bar.show_state()
        if now_s >= self._look_due_s and not self.complete and document.bank is not None:
            self._look_due_s = now_s + 1.0
            if (state := file_state(document.bank)) != self._bank_state:
                self._bank_state, self._wanted = state, True
        if not (self._wanted and self.isVisible() and now_s >= self._due_s):
            return
        if self.calculation.busy:
            self.calculation.cancel()  # the newest edit wins
        elif document.bank is None or document.problem or not document.draft.source:
            self._wanted = False
            self._show(None, NO_BANK if document.bank is None else document.problem or EMPTY)
        else:
            self._wanted = False
            self._bank_state = file_state(document.bank)
            self.calculation.start(self.bar.rig)

    def pause(self) -> None:
        """Calculate nothing until the panel is shown again."""
        if not self.complete:
            self.calculation.cancel()
            self._wanted = True

    def shut_down(self) -> None:
        """End all processes; what plays is muted."""
        self._wanted = False
        for task in (self.saving, self.calculation, self.playing):
            task.close()

    def save(self, path: Path) -> None:
        """Save the drives of the present scene; see `Saving.save`."""
        self.saving.save(path, self.bar.rig)

    def play(self) -> None:
        """Play the present scene on the rig."""
        drive = None if self.results is None else self.results.drive
        lasts_s = 0.0 if drive is None else drive.drive_v.shape[1] / drive.sample_rate_hz
        rig, gain_db, loops = self.bar.rig, self.bar.gain.value(), self.bar.loops.whole()
        self._context.claim_instruments(
            self, "Play", lambda: self.playing.play(rig, gain_db, loops, lasts_s), virtual=names_virtual_rig(rig)
        )

    def show_field_file(self, path: Path, field: Field, surface: PlotSurface) -> None:
        """Play the field of a file until it is closed."""
        self.field.show_file(path, field, surface)
        self.pages.setCurrentWidget(self.field)

    def _edited(self) -> None:
        self._wanted, self.complete = True, False
        self._due_s = time.monotonic() + 0.3

    def _stop(self) -> None:
        self.calculation.cancel()
        self._wanted = False
        self._say("stopped: the results may be of an earlier scene")

    def _show(self, results: SceneResults | None, problem: str = "") -> None:
        self.results = results
        self.drives.show_results(results)
        fill_figures(self.figures, results)
        if results is None or results.field is not None:
            self.field.show_results(results)
            self.complete = results is not None and results.figures is not None
            if not self.calculation.busy:
                self._say("up to date with the scene" if self.complete else "not calculated")
        self.bar.show_ready(results is not None)
        ui.put(self.problem, problem)
        self.problem.setVisible(bool(problem))
        warnings = () if results is None else results.facts["warnings"]
        ui.put(self.warnings, "\n".join(f"⚠ {warning}" for warning in warnings))
        self._warned.setVisible(bool(warnings))

    def _refuse(self, problem: str) -> None:
        """Say why a stage cannot be calculated; drives stay where only their field cannot."""
        self._show(self.results if self._stage == "field" else None, problem)

    def _begin(self, stage: str) -> None:
        self._stage = stage
        self._say(f"calculating: {stage}")

    def _say(self, stage: str) -> None:
        ui.put(self.stage, stage)
        self.cancel.setEnabled(self.calculation.busy and stage.startswith("calculating"))
