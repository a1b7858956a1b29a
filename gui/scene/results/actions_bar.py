"""The buttons below the results: save as drive, WAV or movie; play on the rig, and stop."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QAction, QHBoxLayout, QLabel, QSizePolicy, QSpinBox, QToolButton, QVBoxLayout, QWidget

from gui.scene.results.exports import DRIVE, ENDINGS, IDLE, MOVIE, STOPPING, WAV, Playing, Saving
from gui.shell.files import PathField, choose_place
from gui.shell.tab import TabContext
from gui.shell.theme import Theme
from gui.shell.toml_files import VIRTUAL
from gui.shell.widgets import make_action, make_button, named, number_box

# Button, kind, key, tooltip.
_SAVES = (
    ("Save &drive…", DRIVE, "Ctrl+E", "Render the scene exactly and save the drives (V) of all actuators"),
    ("Save &WAV…", WAV, "Ctrl+Shift+E", "Render the scene exactly and save it as a sound file of the rig's interface"),
    ("Save &movie…", MOVIE, "Ctrl+Alt+E", "Predict the field and save it as a moving picture (GIF)"),
)
_KINDS = {DRIVE: "drive file", WAV: "sound file", MOVIE: "movie"}


class ActionsBar(QWidget):
    """Rows of controls for saving and playing."""

    rig_changed = pyqtSignal()
    #: Kind and file.
    save_requested = pyqtSignal(str, object)
    play_requested = pyqtSignal()

    def __init__(self, context: TabContext, saving: Saving, playing: Playing) -> None:
        super().__init__()
        self._context, self._saving, self._playing = context, saving, playing
        self.ready = False
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context.settings, words=(VIRTUAL,))
        self.rig_field.line.setToolTip(
            "Rig file whose limits count and that plays the scene; virtual: the built-in rig"
        )
        self.rig_field.line.setText(context.settings.text("scene/rig"))
        self._rig = self.rig
        tip = "Softer (negative) or louder than saved (dB); the rig's limits hold"
        self.gain = number_box("Gain in dB", tip, " dB", 1, -60.0, 60.0)
        self.gain.setPrefix("gain ")
        self.loops = named(QSpinBox(), "Number of repetitions, without a gap", "Repetitions")
        self.loops.setRange(1, 10_000)
        self.loops.setPrefix("× ")
        self.state = QLabel()
        self.state.setMinimumWidth(60)
        self.state.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.state.setProperty("role", "faint")
        self.saves: dict[str, QAction] = {
            kind: make_action(self, words, partial(self._choose, kind), keys, tip=tip)
            for words, kind, keys, tip in _SAVES
        }
        self.cancel = make_action(self, "&Cancel", saving.cancel, tip="Cancel saving")
        self.play = make_action(
            self, "&Play", self.play_requested.emit, "F9", tip="Render within the rig's limits and play"
        )
        self.stop = make_action(self, "&Stop", playing.stop, "Shift+F9", tip="Stop at once and mute the outputs")
        self.buttons: dict[str, QToolButton] = {}
        self._lay_out()
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

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self.buttons["stop"].setStyleSheet(f"QToolButton:enabled {{ color: {theme.warning}; font-weight: 600; }}")

    def _lay_out(self) -> None:
        saves, plays = QHBoxLayout(), QHBoxLayout()
        for name, action in (*self.saves.items(), ("cancel", self.cancel)):
            saves.addWidget(self._button(name, action))
        saves.addStretch(1)
        for part in (self.gain, self.loops, self._button("play", self.play), self._button("stop", self.stop)):
            plays.addWidget(part)
        plays.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 2, 4, 2)
        column.setSpacing(4)
        column.addLayout(saves)
        column.addWidget(self.rig_field)
        column.addLayout(plays)
        column.addWidget(self.state)

    def _button(self, name: str, action: QAction) -> QToolButton:
        button = make_button(action)
        button.setAccessibleName(button.accessibleName().rstrip("…"))
        self.buttons[name] = button
        return button

    def _check_rig(self) -> None:
        if self.rig != self._rig:
            self._rig = self.rig
            self._context.settings.keep("scene/rig", self._rig)
            self.show_state()
            self.rig_changed.emit()

    def _choose(self, kind: str) -> None:
        def chosen(file: Path) -> None:
            self.save_requested.emit(kind, file)

        choose_place(self, f"Save {kind}", self._saving.suggested(kind), _KINDS[kind], ENDINGS[kind], chosen)
