"""How the campaign stands: state, reason, progress bar, rate, remaining time and finish clock."""

from __future__ import annotations

import math

from PyQt5.QtWidgets import QGridLayout, QLabel, QProgressBar, QSizePolicy, QWidget

from acquisition.engine.events import State
from gui.campaign.model import Pace
from gui.campaign.standing import Extra, Standing
from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import Badge, finish_text, put

_TROUBLED = (State.FAILED, Extra.GONE, Extra.SILENT)
_WAITING = (State.SUSPENDED, State.RECOVERING, State.PAUSING, State.PAUSED, State.STOPPING)


class ProgressRow(QWidget):
    """Two lines above the map."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self.state = Badge("State of the campaign")
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
        self.state.show_word(str(standing.word), self._colour(standing))
        put(self.reason, said or standing.reason)
        self.reason.setToolTip(f"{said or standing.reason}\n{owner}".strip())

    def show_progress(self, measured: int, total: int, pace: Pace | None, *, measuring: bool) -> None:
        """Show how far it is: the session's own progress while it runs, else what the bank holds."""
        done, of = (pace.done, pace.total) if measuring and pace is not None else (measured, total)
        if (self.bar.value(), self.bar.maximum()) != (done, max(of, 1)):
            self.bar.setMaximum(max(of, 1))
            self.bar.setValue(done)
        put(self.figures, _figures(pace) if measuring and pace is not None else "")

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.state.apply_theme(theme)

    def _colour(self, standing: Standing) -> str:
        theme = self._theme
        return (
            theme.fault if standing.word in _TROUBLED
            else theme.warning if standing.word in _WAITING
            else theme.good if standing.measuring or standing.word is State.FINISHED
            else theme.faint
        )  # fmt: skip


def _figures(pace: Pace) -> str:
    told = f"{pace.per_hour:.0f} positions an hour" if not math.isnan(pace.per_hour) else ""
    finish_s = pace.told_s + pace.wall_remaining_s
    return told if math.isnan(finish_s) else f"{told}  ·  {finish_text(finish_s)}"
