"""The buttons of a verification, and how far it is: step, positions, remaining time, finish clock, last message."""

from __future__ import annotations

from collections.abc import Callable

from PyQt5.QtWidgets import QHBoxLayout, QLabel, QProgressBar, QSizePolicy, QWidget

from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import Badge, finish_text, make_action, make_button, put
from gui.verification.run import Progress

# The steps' names in the log, and what people read.
_WORDS = {"render": "rendering", "predict": "predicting", "scan": "scanning", "compare and report": "comparing"}


class RunRow(QWidget):
    """One line: positions to scan, buttons, progress.

    Parameters
    ----------
    choice : QWidget
        Where the positions are chosen.
    start, cancel, look_at : callable
        What the buttons do.
    """

    def __init__(
        self,
        choice: QWidget,
        start: Callable[[], object],
        cancel: Callable[[], object],
        look_at: Callable[[], object],
    ) -> None:
        super().__init__()
        self._theme = LIGHT
        self.start = make_action(
            self, "Verify", start, "Ctrl+Shift+V", tip="Play the scene on the rig, scan it and compare"
        )
        self.cancel = make_action(
            self, "Cancel", cancel, "Ctrl+Shift+X", tip="End it: outputs muted, mirror parked, nothing compared"
        )
        self.look_at = make_action(
            self, "Open earlier…", look_at, "Ctrl+Shift+O",
            tip="Look at an earlier verification: choose its verify.json",
        )  # fmt: skip
        self._verify_tip = self.start.toolTip()
        self.state = Badge("State of the verification")
        self.bar = QProgressBar()
        self.bar.setAccessibleName("Progress of the verification")
        self.bar.setMinimumWidth(120)
        self.figures = QLabel()
        self.figures.setAccessibleName("Remaining time, finish clock and last message")
        self.figures.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(choice)
        row.addSpacing(8)
        for action in (self.start, self.cancel, self.look_at):
            row.addWidget(make_button(action))
        row.addSpacing(8)
        row.addWidget(self.state)
        row.addWidget(self.bar, stretch=2)
        row.addWidget(self.figures, stretch=3)
        self.show_progress(None, stopping=False, missing="")

    def show_progress(self, progress: Progress | None, *, stopping: bool, missing: str, reading: str = "") -> None:
        """Show how far it is; `reading` is what is done meanwhile where nothing runs."""
        running = progress is not None
        self.start.setEnabled(not running and not missing)
        self.start.setToolTip(f"First {missing}" if missing else self._verify_tip)
        self.cancel.setEnabled(running and not stopping)
        self.look_at.setEnabled(not running)
        self.state.setVisible(running)
        self.bar.setVisible(running)
        if progress is None:
            put(self.figures, reading)
            self.figures.setToolTip("")
            return
        word = "stopping" if stopping else _WORDS.get(progress.step, progress.step)
        self.state.show_word(word, self._theme.warning if stopping else self._theme.good)
        self.bar.setFormat("%v of %m positions" if progress.step in ("scan", "predict") else "")
        if (self.bar.value(), self.bar.maximum()) != (progress.done, progress.total):
            self.bar.setMaximum(progress.total)  # 0 moves to and fro: nothing is known yet
            self.bar.setValue(progress.done)
        told = _told(progress)
        put(self.figures, told)
        self.figures.setToolTip(told)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.state.apply_theme(theme)


def _told(progress: Progress) -> str:
    parts = []
    if progress.finish_s is not None and progress.done < progress.total and progress.step == "scan":
        parts.append(finish_text(progress.finish_s))
    if progress.message:
        parts.append(progress.message)
    return "  ·  ".join(parts)
