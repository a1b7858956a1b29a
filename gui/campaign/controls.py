"""The buttons of a campaign, each with its key; what makes no sense now is greyed and says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PyQt5.QtWidgets import QAction, QHBoxLayout, QToolButton, QWidget

from gui.campaign.standing import Order
from gui.shell.widgets import make_action, make_button


@dataclass(frozen=True, slots=True)
class _Button:
    name: str
    words: str
    keys: str
    tip: str


_BUTTONS = (
    _Button("plan", "Dry run", "Ctrl+D", "Walk the run file's plan without playing: positions, hours, bytes"),
    _Button("start", "Start", "Ctrl+Return", "Start the campaign of the run file in the bank, or go on with it"),
    _Button("resume", "Resume", "Ctrl+R", "Go on with the bank's campaign; the bank alone is enough"),
    _Button("pause", "Pause", "Ctrl+P", "Finish the position under way, then stand still, muted and parked"),
    _Button("stop", "Stop after this position", "Ctrl+T", "Finish the position under way and end; Resume goes on"),
    _Button(
        "selected", "Remeasure selected", "Ctrl+M", "Measure the selected positions again (Ctrl-click, Shift-drag)"
    ),
    _Button("poor", "Remeasure poor", "Ctrl+Shift+M", "Measure again all that is poor, over-range or failed"),
)


class Controls(QWidget):
    """The row of buttons; their actions stand in the menu too.

    Parameters
    ----------
    acts : dict of callable
        What each button does.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self.actions_by_name: dict[str, QAction] = {}
        self.buttons: dict[str, QToolButton] = {}
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        for button in _BUTTONS:
            action = make_action(self, button.words, acts[button.name], button.keys, tip=button.tip)
            action.setEnabled(False)
            shown = make_button(action)
            row.addWidget(shown)
            if button.name in ("plan", "stop"):
                row.addSpacing(10)
            self.actions_by_name[button.name] = action
            self.buttons[button.name] = shown
        row.addStretch(1)

    def show_possible(self, orders: frozenset[Order], *, has_run: bool, selected: int, poor: int) -> None:
        """Enable what makes sense, and say how many positions are meant."""
        goes_on = Order.GO_ON in orders
        pause = self.actions_by_name["pause"]
        words = "Go on" if goes_on else "Pause"
        if pause.text() != words:
            pause.setText(words)
            self.buttons["pause"].setAccessibleName(words)
        for name, enabled in (
            ("plan", has_run),
            ("start", Order.START in orders),
            ("resume", Order.RESUME in orders),
            ("pause", goes_on or Order.PAUSE in orders),
            ("stop", Order.STOP in orders),
            ("selected", Order.REMEASURE in orders and selected > 0),
            ("poor", Order.REMEASURE in orders and poor > 0),
        ):
            self.actions_by_name[name].setEnabled(enabled)
        for name, words, count in (("selected", "Remeasure selected", selected), ("poor", "Remeasure poor", poor)):
            text = f"{words} ({count})" if count else words
            if self.actions_by_name[name].text() != text:
                self.actions_by_name[name].setText(text)
