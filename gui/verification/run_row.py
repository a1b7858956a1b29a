"""The buttons of a verification, and how far it is: step, positions, remaining time, finish clock, last message."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime

from PyQt5.QtGui import QKeySequence
from PyQt5.QtWidgets import QAction, QHBoxLayout, QLabel, QProgressBar, QSizePolicy, QToolButton, QWidget

from acquisition.durations import hours
from gui.theme import LIGHT, Theme
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
        self._styled = ""
        self.start = self._action("Verify", "Ctrl+Shift+V", "Play the scene on the rig, scan it and compare", start)
        self.cancel = self._action(
            "Cancel", "Ctrl+Shift+X", "End it: outputs muted, mirror parked, nothing compared", cancel
        )
        self.look_at = self._action(
            "Open earlier…", "Ctrl+Shift+O", "Look at an earlier verification: choose its verify.json", look_at
        )
        self.state = QLabel()
        self.state.setAccessibleName("State of the verification")
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
            button = QToolButton()
            button.setDefaultAction(action)
            button.setAccessibleName(action.text())
            row.addWidget(button)
        row.addSpacing(8)
        row.addWidget(self.state)
        row.addWidget(self.bar, stretch=2)
        row.addWidget(self.figures, stretch=3)
        self.show_progress(None, stopping=False, missing="")

    def show_progress(self, progress: Progress | None, *, stopping: bool, missing: str, reading: str = "") -> None:
        """Show how far it is; `reading` is what is done meanwhile where nothing runs."""
        running = progress is not None
        self.start.setEnabled(not running and not missing)
        self.start.setToolTip(
            f"Play the scene on the rig, scan it and compare ({_KEYS['Verify']})" if not missing else f"First {missing}"
        )
        self.cancel.setEnabled(running and not stopping)
        self.look_at.setEnabled(not running)
        self._style(self._theme.warning if stopping else self._theme.good)
        self.state.setVisible(running)
        self.bar.setVisible(running)
        if progress is None:
            _put(self.figures, reading)
            self.figures.setToolTip("")
            return
        _put(self.state, "stopping" if stopping else _WORDS.get(progress.step, progress.step))
        self.bar.setFormat("%v of %m positions" if progress.step in ("scan", "predict") else "")
        if (self.bar.value(), self.bar.maximum()) != (progress.done, progress.total):
            self.bar.setMaximum(progress.total)  # 0 moves to and fro: nothing is known yet
            self.bar.setValue(progress.done)
        told = _told(progress)
        _put(self.figures, told)
        self.figures.setToolTip(told)

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self._styled = ""

    def _style(self, colour: str) -> None:
        if colour != self._styled:
            self._styled = colour
            ink = "#ffffff" if self._theme is LIGHT else "#10151a"
            self.state.setStyleSheet(
                f"background: {colour}; color: {ink}; font-weight: 600; padding: 2px 9px; border-radius: 4px;"
            )

    def _action(self, words: str, keys: str, tip: str, act: Callable[[], object]) -> QAction:
        action = QAction(words, self)
        action.setShortcut(QKeySequence(keys))
        action.setToolTip(f"{tip} ({keys})")
        action.triggered.connect(lambda _checked=False: _do(act))
        return action


_KEYS = {"Verify": "Ctrl+Shift+V"}


def _do(act: Callable[[], object]) -> None:
    act()


def _told(progress: Progress) -> str:
    parts = []
    if progress.finish_s is not None and progress.done < progress.total and progress.step == "scan":
        left_s = max(0.0, progress.finish_s - time.time())
        finish = datetime.fromtimestamp(progress.finish_s).astimezone()
        today = datetime.now().astimezone().date()
        at = finish.strftime("%H:%M" if finish.date() == today else "%a %d %b %H:%M")
        parts.append(f"{hours(left_s)} left  ·  finished at {at}")
    if progress.message:
        parts.append(progress.message)
    return "  ·  ".join(parts)


def _put(label: QLabel, text: str) -> None:
    """Change a label only when it changes: setting a text lays the whole row out anew."""
    if label.text() != text:
        label.setText(text)
