"""How something stands and how far it is, in the same looks and words wherever it is told."""

from __future__ import annotations

import time
from datetime import datetime

from PyQt5.QtWidgets import QLabel

from acquisition.durations import hours
from gui.shell.theme import LIGHT, Theme


class Badge(QLabel):
    """A word on a ground whose colour says how things stand.

    Parameters
    ----------
    name : str
        Its accessible name.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.setAccessibleName(name)
        self._theme = LIGHT
        self._colour = ""

    def show_word(self, word: str, colour: str) -> None:
        """Show a word on a colour of the theme."""
        if colour != self._colour:
            self._colour = colour
            ground = f"background: {colour}; color: {self._theme.ink}; border-radius: 4px;"
            self.setStyleSheet(f"{ground} font-weight: 600; padding: 2px 9px;")
        put(self, word)

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours with the next word."""
        self._theme, self._colour = theme, ""


def put(label: QLabel, text: str) -> None:
    """Change a label only when it changes: setting a text lays the whole row out anew."""
    if label.text() != text:
        label.setText(text)


def finish_words(finish_s: float) -> str:
    """How long it is until an instant (seconds since 1970), and when that is by the clock."""
    finish = datetime.fromtimestamp(finish_s).astimezone()
    today = datetime.now().astimezone().date()
    at = finish.strftime("%H:%M" if finish.date() == today else "%a %d %b %H:%M")
    return f"{hours(max(0.0, finish_s - time.time()))} left  ·  finished at {at}"
