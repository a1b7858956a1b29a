"""Small widgets that all tabs use: actions, splitters, status badges, text dialogs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime

from PyQt5.QtCore import QObject, Qt
from PyQt5.QtGui import QFontDatabase, QKeySequence
from PyQt5.QtWidgets import (
    QAction,
    QApplication,
    QDialog,
    QLabel,
    QPlainTextEdit,
    QSplitter,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from acquisition.durations import hours
from gui.shell.theme import LIGHT, Theme


def make_action(
    owner: QObject,
    words: str,
    act: Callable[[], object],
    *keys: QKeySequence.StandardKey | str,
    tip: str = "",
) -> QAction:
    """Make an action.

    Parameters
    ----------
    owner : QObject
        It lives no longer than this.
    words : str
        For menus and buttons, with an ampersand before its letter.
    act : callable
        What it does.
    keys : StandardKey or str
        That do the same; none where there is no key. The tooltip tells the first one.
    tip : str
        The tooltip; empty for the words.
    """
    action = QAction(words, owner)
    action.setShortcuts([QKeySequence(key) for key in keys])
    if tip:
        action.setToolTip(f"{tip} ({action.shortcut().toString()})" if keys else tip)

    def triggered(_checked: bool = False) -> None:
        act()

    action.triggered.connect(triggered)
    return action


def make_button(action: QAction) -> QToolButton:
    """Make a button of an action, with its words as the accessible name."""
    button = QToolButton()
    button.setDefaultAction(action)
    button.setAccessibleName(action.text().replace("&", ""))
    return button


def copy_text(text: str) -> None:
    """Put a text on the clipboard."""
    clipboard = QApplication.clipboard()
    if clipboard is not None:
        clipboard.setText(text)


# A part, and its width or height in pixels.
Part = tuple[QWidget, int]


def side_by_side(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Parts from left to right; `growing` are the numbers of those that take more room when there is more."""
    return _divided(Qt.Orientation.Horizontal, parts, growing)


def stacked(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Parts from top to bottom; `growing` as of `side_by_side`."""
    return _divided(Qt.Orientation.Vertical, parts, growing)


def _divided(orientation: Qt.Orientation, parts: Sequence[Part], growing: Sequence[int]) -> QSplitter:
    splitter = QSplitter(orientation)
    splitter.setChildrenCollapsible(False)
    for part, _ in parts:
        splitter.addWidget(part)
    splitter.setSizes([size for _, size in parts])
    for number in growing:
        splitter.setStretchFactor(number, 1)
    return splitter


_COLUMNS, _LINES = 110, 24


def show_text(title: str, text: str, owner: QWidget) -> QDialog:
    """Show a text with letters of one width, to be read and copied."""
    dialog = QDialog(owner)
    dialog.setWindowTitle(title)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    shown = QPlainTextEdit(text)
    shown.setReadOnly(True)
    shown.setAccessibleName(title)
    shown.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
    shown.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
    column = QVBoxLayout(dialog)
    column.addWidget(shown)
    metrics = shown.fontMetrics()
    dialog.resize(_COLUMNS * metrics.horizontalAdvance("0"), _LINES * metrics.lineSpacing())
    dialog.show()
    return dialog


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

    def apply_theme(self, theme: Theme) -> None:
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
