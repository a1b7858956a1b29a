"""Buttons of a campaign, and its state, progress, rate and finish time."""

from __future__ import annotations

import math
from collections.abc import Callable

from PyQt5.QtWidgets import QAction, QProgressBar, QToolButton, QWidget

from config.messages.campaign import State
from gui.campaign.model import GOING, CampaignState, Extra, Order, Pace
from gui.shell.theme import LIGHT, Theme
from gui.shell.widgets import Badge, finish_text, make_action, make_button, make_label, put, row

# Name, text, key and tooltip.
_BUTTONS = (
    ("plan", "Dry run", "Ctrl+D", "Walk the run file's plan without playing: positions, hours, bytes"),
    ("start", "Start", "Ctrl+Return", "Start the campaign of the run file in the bank, or continue it"),
    ("resume", "Resume", "Ctrl+R", "Continue the bank's campaign; the bank alone is enough"),
    ("pause", "Pause", "Ctrl+P", "Finish the current position, then wait, muted and parked"),
    ("stop", "Stop after this position", "Ctrl+T", "Finish the current position and end; Resume continues"),
    ("selected", "Remeasure selected", "Ctrl+M", "Measure the selected positions again (Ctrl-click, Shift-drag)"),
    ("poor", "Remeasure poor", "Ctrl+Shift+M", "Measure again all that is poor, over-range or failed"),
)


class Controls(QWidget):
    """Row of buttons; `actions_by_name` are in the menu, too.

    Parameters
    ----------
    acts : dict of callable
        Action of each button.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self.actions_by_name: dict[str, QAction] = {}
        self.buttons: dict[str, QToolButton] = {}
        parts: list[QWidget | int | None] = []
        for name, text, key, tip in _BUTTONS:
            action = self.actions_by_name[name] = make_action(self, text, acts[name], key, tip=tip)
            action.setEnabled(False)
            self.buttons[name] = make_button(action)
            parts += [self.buttons[name], 10 if name in ("plan", "stop") else 0]
        row(*parts, None, owner=self)

    def show_possible(self, orders: frozenset[Order], *, has_run: bool, selected: int, poor: int) -> None:
        """Enable what makes sense, and show how many positions would be measured again."""
        paused = Order.CONTINUE in orders
        for name, enabled in (
            ("plan", has_run),
            ("start", Order.START in orders),
            ("resume", Order.RESUME in orders),
            ("pause", paused or Order.PAUSE in orders),
            ("stop", Order.STOP in orders),
            ("selected", Order.REMEASURE in orders and selected > 0),
            ("poor", Order.REMEASURE in orders and poor > 0),
        ):
            self.actions_by_name[name].setEnabled(enabled)
        for name, text in (
            ("pause", "Continue" if paused else "Pause"),
            ("selected", f"Remeasure selected ({selected})" if selected else "Remeasure selected"),
            ("poor", f"Remeasure poor ({poor})" if poor else "Remeasure poor"),
        ):
            if self.actions_by_name[name].text() != text:
                self.actions_by_name[name].setText(text)
                self.buttons[name].setAccessibleName(text)


class ProgressRow(QWidget):
    """State, reason, progress bar and figures above the map."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self.state = Badge("State of the campaign")
        self.reason = make_label("Reason of the state", any_width=True)
        self.bar = QProgressBar()
        self.bar.setAccessibleName("Progress of the campaign")
        self.bar.setFormat("%v of %m positions (%p %)")
        self.figures = make_label("Rate, remaining time and finish time")
        row(self.state, (self.reason, 3), (self.bar, 3), self.figures, owner=self).setSpacing(10)

    def show_state(self, state: CampaignState, report: str, owner: str) -> None:
        """Show a state and its reason; `report` of the capture replaces the reason while it has none."""
        theme, word = self._theme, state.word
        colour = (
            theme.fault if word in (State.FAILED, Extra.GONE, Extra.SILENT)
            else theme.warning if word in GOING and word is not State.RUNNING
            else theme.good if state.measuring or word is State.FINISHED
            else theme.faint
        )  # fmt: skip
        self.state.show_word(str(word), colour)
        put(self.reason, report or state.reason)
        self.reason.setToolTip(f"{report or state.reason}\n{owner}".strip())

    def show_progress(self, measured: int, total: int, pace: Pace | None, *, measuring: bool) -> None:
        """Show the progress of the session while it runs, else of the bank."""
        done, of = (pace.done, pace.total) if measuring and pace is not None else (measured, total)
        if (self.bar.value(), self.bar.maximum()) != (done, max(of, 1)):
            self.bar.setMaximum(max(of, 1))
            self.bar.setValue(done)
        put(self.figures, _pace_text(pace) if measuring and pace is not None else "")

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        self.state.apply_theme(theme)


def _pace_text(pace: Pace) -> str:
    text = f"{pace.per_hour:.0f} positions an hour" if not math.isnan(pace.per_hour) else ""
    return text if math.isnan(pace.finish_s) else f"{text}  ·  {finish_text(pace.finish_s)}"
