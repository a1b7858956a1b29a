"""How the campaign stands: state, reason, progress bar, rate, remaining time and finish clock."""

from __future__ import annotations

import math
import time
from datetime import datetime

from PyQt5.QtWidgets import QGridLayout, QLabel, QProgressBar, QSizePolicy, QWidget

from acquisition.durations import hours
from acquisition.events import State
from gui.campaign.model import Pace
from gui.campaign.standing import Extra, Standing
from gui.theme import LIGHT, Theme

_TROUBLED = (State.FAILED, Extra.GONE, Extra.SILENT)
_WAITING = (State.SUSPENDED, State.RECOVERING, State.PAUSING, State.PAUSED, State.STOPPING)


class ProgressRow(QWidget):
    """Two lines above the map."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self._styled = ""
        self.state = QLabel()
        self.state.setAccessibleName("State of the campaign")
        self.reason = QLabel()
        self.reason.setAccessibleName("Reason of the state")
        self.reason.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.bar = QProgressBar()
        self.bar.setAccessibleName("Progress of the campaign")
        self.bar.setFormat("%v of %m positions (%p %)")
        self.figures = QLabel()
        self.figures.setAccessibleName("Rate, remaining time and finish clock")
        self.figures.setToolTip("Rate by the rig's clock; time left and finish by the clock on the wall")
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        grid.setHorizontalSpacing(10)
        grid.addWidget(self.state, 0, 0)
        grid.addWidget(self.reason, 0, 1)
        grid.addWidget(self.bar, 0, 2)
        grid.addWidget(self.figures, 0, 3)
        grid.setColumnStretch(1, 3)
        grid.setColumnStretch(2, 3)

    def show_standing(self, standing: Standing, said: str, owner: str) -> None:
        """Show state and reason; `said` is what the capture told last while it has no state yet."""
        self._style(standing)
        _put(self.state, str(standing.word))
        _put(self.reason, said or standing.reason)
        self.reason.setToolTip(f"{said or standing.reason}\n{owner}".strip())

    def show_progress(self, measured: int, total: int, pace: Pace | None, *, measuring: bool) -> None:
        """Show how far it is: the session's own progress while it runs, else what the bank holds."""
        done, of = (pace.done, pace.total) if measuring and pace is not None else (measured, total)
        if (self.bar.value(), self.bar.maximum()) != (done, max(of, 1)):
            self.bar.setMaximum(max(of, 1))
            self.bar.setValue(done)
        _put(self.figures, _figures(pace) if measuring and pace is not None else "")

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self._styled = ""

    def _style(self, standing: Standing) -> None:
        theme = self._theme
        colour = (
            theme.fault if standing.word in _TROUBLED
            else theme.warning if standing.word in _WAITING
            else theme.good if standing.measuring or standing.word is State.FINISHED
            else theme.faint
        )  # fmt: skip
        if colour != self._styled:
            self._styled = colour
            ink = "#ffffff" if theme is LIGHT else "#10151a"
            self.state.setStyleSheet(
                f"background: {colour}; color: {ink}; font-weight: 600; padding: 2px 9px; border-radius: 4px;"
            )


def _put(label: QLabel, text: str) -> None:
    """Change a label only when it changes: setting a text lays the whole row out anew."""
    if label.text() != text:
        label.setText(text)


def _figures(pace: Pace) -> str:
    told = f"{pace.per_hour:.0f} positions an hour" if not math.isnan(pace.per_hour) else ""
    finish_s = pace.told_s + pace.wall_remaining_s
    if math.isnan(finish_s):
        return told
    left_s = max(0.0, finish_s - time.time())
    finish = datetime.fromtimestamp(finish_s).astimezone()
    today = datetime.now().astimezone().date()
    at = finish.strftime("%H:%M" if finish.date() == today else "%a %d %b %H:%M")
    return f"{told}  ·  {hours(left_s)} left  ·  finished at {at}"
