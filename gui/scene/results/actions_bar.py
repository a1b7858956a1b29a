"""Buttons below the results: save as drive, WAV or movie; play on the rig, and stop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt5.QtWidgets import (
    QAction,
    QDoubleSpinBox,
    QHBoxLayout,
    QLabel,
    QSizePolicy,
    QSpinBox,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.scene.results.rig_play import IDLE, STOPPING, RigPlay
from gui.scene.results.saving import DRIVE, ENDINGS, MOVIE, WAV, Saving
from gui.shell.file_choice import PathField, choose_place
from gui.shell.tab import TabContext
from gui.shell.theme import Theme
from gui.shell.toml_files import VIRTUAL
from gui.shell.widgets import make_action, make_button

# Word, what it saves, key, tooltip.
_SAVES = (
    ("Save &drive…", DRIVE, "Ctrl+E", "Render the scene exactly and save the drives (V) of all actuators"),
    ("Save &WAV…", WAV, "Ctrl+Shift+E", "Render the scene exactly and save it as a sound file of the rig's interface"),
    ("Save &movie…", MOVIE, "Ctrl+Alt+E", "Predict the field and save it as a moving picture (GIF)"),
)
_KINDS = {DRIVE: "drive file", WAV: "sound file", MOVIE: "movie"}


class ActionsBar(QWidget):
    """Three rows of controls.

    Parameters
    ----------
    context : TabContext
        Its memory knows the rig file of last time.
    saving, playing : Saving, RigPlay
        What the buttons are for.
    """

    def __init__(self, context: TabContext, saving: Saving, playing: RigPlay) -> None:
        super().__init__()
        self._context, self._saving, self._playing = context, saving, playing
        self.save_asked: Callable[[str, Path], object] = lambda _kind, _path: None
        self.play_asked: Callable[[], object] = lambda: None
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context.settings, words=(VIRTUAL,))
        self.rig_field.line.setToolTip("Rig file whose limits count and that plays the scene; virtual for the built-in")
        self.rig_field.line.setText(context.settings.text("scene/rig"))
        self.gain = QDoubleSpinBox()
        self.gain.setRange(-60.0, 60.0)
        self.gain.setSingleStep(1.0)
        self.gain.setDecimals(1)
        self.gain.setPrefix("gain ")
        self.gain.setSuffix(" dB")
        self.gain.setAccessibleName("Gain of the play in dB")
        self.gain.setToolTip("Softer (negative) or louder than saved (dB); the rig's limits hold all the same")
        self.loops = QSpinBox()
        self.loops.setRange(1, 10_000)
        self.loops.setPrefix("× ")
        self.loops.setAccessibleName("How many times it is played")
        self.loops.setToolTip("How many times the scene is played, without a gap")
        self.said = QLabel()
        self.said.setMinimumWidth(60)
        self.said.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.said.setProperty("role", "faint")
        self.saves: dict[str, QAction] = {}
        for words, kind, keys, tip in _SAVES:
            self.saves[kind] = make_action(self, words, partial(self._choose, kind), keys, tip=tip)
        self.cancel = make_action(self, "&Cancel", saving.cancel, tip="Give up what is being saved")
        self.play = make_action(self, "&Play", self._play, "F9", tip="Render within the rig's limits and play")
        self.stop = make_action(
            self, "&Stop", playing.stop, "Shift+F9", tip="Fall silent at once: the outputs are muted"
        )
        self.buttons: dict[str, QToolButton] = {}
        self._lay_out()
        for part in (saving, playing):
            part.changed.connect(self.show_state)
        self.ready = False
        self.show_state()

    @property
    def rig(self) -> str:
        """The rig file, or ``virtual``, as the command line takes it; empty where there is none."""
        text = self.rig_field.line.text().strip()
        return text if text in ("", VIRTUAL) else str(self.rig_field.path)

    def show_ready(self, ready: bool) -> None:
        """Say whether there is a scene that can be rendered."""
        if ready != self.ready:
            self.ready = ready
            self.show_state()

    def show_state(self) -> None:
        """Show what can be done now, and what is being done."""
        saving, state = self._saving.busy, self._playing.state
        for action in self.saves.values():
            action.setEnabled(self.ready and not saving)
        self.cancel.setEnabled(saving)
        self.buttons["cancel"].setVisible(saving)
        self.play.setEnabled(self.ready and state == IDLE and bool(self.rig))
        self.stop.setEnabled(state not in (IDLE, STOPPING))
        words = [self._saving.words] if saving else []
        if state != IDLE:
            words.append(self._playing.words)
        elif self.ready and not self.rig and not words:
            words.append("choose a rig to play")
        self.said.setText("; ".join(words))
        self.said.setToolTip(self.said.text())

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        colour = theme.warning
        self.buttons["stop"].setStyleSheet(f"QToolButton:enabled {{ color: {colour}; font-weight: 600; }}")

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
        column.addWidget(self.said)

    def _button(self, name: str, action: QAction) -> QToolButton:
        button = make_button(action)
        button.setAccessibleName(button.accessibleName().rstrip("…"))
        self.buttons[name] = button
        return button

    def _choose(self, kind: str) -> None:
        def chosen(file: Path) -> None:
            self.save_asked(kind, file)

        choose_place(self, f"Save {kind}", self._saving.suggested(kind), _KINDS[kind], ENDINGS[kind], chosen)

    def _play(self) -> None:
        self.play_asked()
