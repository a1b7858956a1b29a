"""What is done from a menu, by a key or with a button."""

from __future__ import annotations

from collections.abc import Callable

from PyQt5.QtCore import QObject
from PyQt5.QtGui import QKeySequence
from PyQt5.QtWidgets import QAction, QApplication, QToolButton


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
