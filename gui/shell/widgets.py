"""Small widgets that all tabs use: actions, number boxes, tables, splitters, state badges."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime
from typing import TypeVar

from PyQt5.QtCore import QObject, Qt
from PyQt5.QtGui import QFontDatabase, QKeySequence
from PyQt5.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QAction,
    QApplication,
    QDialog,
    QDoubleSpinBox,
    QHeaderView,
    QLabel,
    QPlainTextEdit,
    QSplitter,
    QTableWidget,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from acquisition.durations import hours
from gui.shell.theme import LIGHT, Theme

AnyWidget = TypeVar("AnyWidget", bound=QWidget)
# A widget, and its width or height in pixels.
Part = tuple[QWidget, int]

_DIALOG_COLUMNS, _DIALOG_LINES = 110, 24


def make_action(
    owner: QObject, text: str, act: Callable[[], object], *keys: QKeySequence.StandardKey | str, tip: str = ""
) -> QAction:
    """Make an action with shortcuts; the first one stands in the tooltip."""
    action = QAction(text, owner)
    action.setShortcuts([QKeySequence(key) for key in keys])
    if tip:
        action.setToolTip(f"{tip} ({action.shortcut().toString()})" if keys else tip)

    def triggered(_checked: bool = False) -> None:
        act()

    action.triggered.connect(triggered)
    return action


def make_button(action: QAction) -> QToolButton:
    """Make a button of an action."""
    button = QToolButton()
    button.setDefaultAction(action)
    button.setAccessibleName(action.text().replace("&", ""))
    return button


def named(widget: AnyWidget, tip: str, name: str = "") -> AnyWidget:
    """Give a widget a tooltip and an accessible name, by default the button's text."""
    if not name and isinstance(widget, QAbstractButton):
        name = widget.text().replace("&", "")
    widget.setAccessibleName(name)
    widget.setToolTip(tip)
    return widget


def number_box(name: str, tip: str, suffix: str, decimals: int, low: float, high: float) -> QDoubleSpinBox:
    """Make a box for a number with a unit."""
    box = named(QDoubleSpinBox(), tip, name)
    box.setDecimals(decimals)
    box.setRange(low, high)
    box.setSuffix(suffix)
    return box


def make_table(titles: Sequence[str], name: str, stretched: Sequence[int]) -> QTableWidget:
    """Make a table that is only read; `stretched` columns share the width that the others leave."""
    table = QTableWidget(0, len(titles))
    table.setHorizontalHeaderLabels(list(titles))
    table.setAccessibleName(name)
    table.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
    table.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
    table.setAlternatingRowColors(True)
    rows, columns = table.verticalHeader(), table.horizontalHeader()
    assert rows is not None
    assert columns is not None
    rows.hide()
    rows.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    columns.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    for column in stretched:
        columns.setSectionResizeMode(column, QHeaderView.ResizeMode.Stretch)
    return table


def side_by_side(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Widgets from left to right; those numbered in `growing` take the additional room."""
    return _splitter(Qt.Orientation.Horizontal, parts, growing)


def stacked(*parts: Part, growing: Sequence[int] = ()) -> QSplitter:
    """Widgets from top to bottom; `growing` as in `side_by_side`."""
    return _splitter(Qt.Orientation.Vertical, parts, growing)


def _splitter(orientation: Qt.Orientation, parts: Sequence[Part], growing: Sequence[int]) -> QSplitter:
    splitter = QSplitter(orientation)
    splitter.setChildrenCollapsible(False)
    for part, _ in parts:
        splitter.addWidget(part)
    splitter.setSizes([size for _, size in parts])
    for number in growing:
        splitter.setStretchFactor(number, 1)
    return splitter


class Badge(QLabel):
    """A word on a coloured ground."""

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
        self._theme, self._colour = theme, ""


def put(label: QLabel, text: str) -> None:
    """Set a label's text only when it changes: setting it lays out the whole row."""
    if label.text() != text:
        label.setText(text)


def finish_text(finish_s: float) -> str:
    """Remaining time until an instant (seconds since 1970), and its time of day."""
    finish = datetime.fromtimestamp(finish_s).astimezone()
    today = datetime.now().astimezone().date()
    at = finish.strftime("%H:%M" if finish.date() == today else "%a %d %b %H:%M")
    return f"{hours(max(0.0, finish_s - time.time()))} left  ·  finished at {at}"


def copy_text(text: str) -> None:
    """Put a text on the clipboard."""
    clipboard = QApplication.clipboard()
    if clipboard is not None:
        clipboard.setText(text)


def show_text(title: str, text: str, owner: QWidget) -> QDialog:
    """Show a long text in a window of its own that does not block."""
    dialog = QDialog(owner)
    dialog.setWindowTitle(title)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    shown = QPlainTextEdit(text)
    shown.setReadOnly(True)
    shown.setAccessibleName(title)
    shown.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
    shown.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
    QVBoxLayout(dialog).addWidget(shown)
    metrics = shown.fontMetrics()
    dialog.resize(_DIALOG_COLUMNS * metrics.horizontalAdvance("0"), _DIALOG_LINES * metrics.lineSpacing())
    dialog.show()
    return dialog
