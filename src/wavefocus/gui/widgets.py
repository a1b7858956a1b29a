"""Small widgets that all tabs use: actions, number boxes, tables, splitters, state badges."""

import math
import re
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import datetime
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

from PyQt5 import QtWidgets
from PyQt5.QtCore import QLocale, QObject, Qt, QTimer
from PyQt5.QtGui import QColor, QKeySequence, QValidator

from wavefocus.acquisition.wording import hours
from wavefocus.gui.theme import Themed

# Digits with a point or a comma before the decimals; no grouping, no other scripts' digits, no words such as nan.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+[.,]?[0-9]*|[.,][0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


class NumberBox(QtWidgets.QDoubleSpinBox):
    """A number with its unit; what is typed counts when it is finished (Enter, Tab, or another widget is used).

    A text that is not a number, is out of range or, in a box for whole numbers, has a fraction, is refused as a whole:
    the box then shows the former value, and says so.
    """

    def __init__(self, decimals: int, low: float, high: float, *, prefix: str = "", suffix: str = "") -> None:
        super().__init__()
        self.setLocale(QLocale.c())  # a decimal point is shown, as in files
        self.setKeyboardTracking(False)  # "0.2" is not 0 on the way
        self.setDecimals(decimals)
        self.setRange(low, high)
        self.setPrefix(prefix)
        self.setSuffix(suffix)

    def whole(self) -> int:
        """Return the value of a box without decimals."""
        return round(self.value())

    def value(self) -> float:
        """Return the number that was typed last; a text that is not one is refused first."""
        self.interpretText()
        return super().value()

    def validate(self, text: str | None, position: int) -> tuple[QValidator.State, str, int]:
        """Return whether a text is a number; no key is refused, for a number without it would be another one."""
        text = text or ""
        finished = self._number(text) is not None
        return QValidator.State.Acceptable if finished else QValidator.State.Intermediate, text, position

    def fixup(self, text: str | None) -> str:
        """Report a text that is refused; Qt then shows the former value."""
        low, high, value = (self.textFromValue(one) for one in (self.minimum(), self.maximum(), super().value()))
        allowed = f"{'number' if self.decimals() else 'whole number'} from {low} to {high}{self.suffix()}"
        sentence = f"“{self._without_unit(text or '')}” is not a {allowed}; the value stays {value}{self.suffix()}"
        QtWidgets.QToolTip.showText(self.mapToGlobal(self.rect().bottomLeft()), sentence, self)
        return text or ""

    def valueFromText(self, text: str | None) -> float:  # noqa: N802
        number = self._number(text or "")
        return super().value() if number is None else number

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """Return a value as short as its decimals allow."""
        text = f"{value:.{self.decimals()}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text

    def _without_unit(self, text: str) -> str:
        return text.removeprefix(self.prefix().rstrip()).strip().removesuffix(self.suffix().strip()).strip()

    def _number(self, text: str) -> float | None:
        """Return the number of a text, rounded to the decimals of the box; None where the box cannot hold it."""
        typed = self._without_unit(text)
        number = float(typed.replace(",", ".")) if _NUMBER.fullmatch(typed) else math.nan
        # A value that rounding makes vanish, 0.0001 in a box of three decimals, is not in its range.
        if not self.minimum() <= number <= self.maximum():
            return None
        return round(number, self.decimals()) if self.decimals() or number.is_integer() else None


AnyWidget = TypeVar("AnyWidget", bound=QtWidgets.QWidget)
AnyBox = TypeVar("AnyBox", QtWidgets.QHBoxLayout, QtWidgets.QVBoxLayout)
# A widget, and its width or height in pixels.
Part = tuple[QtWidgets.QWidget, int]
# A part of a row or a column.
Item = QtWidgets.QWidget | QtWidgets.QLayout | tuple[QtWidgets.QWidget | QtWidgets.QLayout, int] | int | None
Margins = tuple[int, int, int, int]
_NO_MARGINS = (0, 0, 0, 0)
PAGE_MARGINS = (4, 6, 4, 4)


def action(
    owner: QObject, text: str, act: Callable[[], Any], *keys: QKeySequence.StandardKey | str, tip: str = ""
) -> QtWidgets.QAction:
    """Make an action with shortcuts; the first one stands in the tooltip."""
    action = QtWidgets.QAction(text, owner)
    action.setShortcuts([QKeySequence(key) for key in keys])
    if tip:
        action.setToolTip(f"{tip} ({action.shortcut().toString()})" if keys else tip)
    action.triggered.connect(lambda _checked=False: act())
    return action


def later(owner: QObject, interval_ms: int, act: Callable[[], Any]) -> QTimer:
    """Make a timer that calls `act` once, so long after it was started last."""
    timer = QTimer(owner)
    timer.setSingleShot(True)
    timer.setInterval(interval_ms)
    timer.timeout.connect(act)
    return timer


def button(action: QtWidgets.QAction) -> QtWidgets.QToolButton:
    """Make a button of an action."""
    button = QtWidgets.QToolButton()
    button.setDefaultAction(action)

    def name() -> None:
        button.setAccessibleName(action.text().replace("&", "").rstrip("…"))

    action.changed.connect(name)
    name()
    return button


def named(widget: AnyWidget, tip: str, name: str = "") -> AnyWidget:
    """Give a widget a tooltip and an accessible name, by default the button's text."""
    if not name and isinstance(widget, QtWidgets.QAbstractButton):
        name = widget.text().replace("&", "")
    widget.setAccessibleName(name)
    widget.setToolTip(tip)
    return widget


def number_box(
    name: str, tip: str, suffix: str, decimals: int, low: float, high: float, *, value: float = 0.0, prefix: str = ""
) -> NumberBox:
    """Make a box for a number with a unit."""
    box = named(NumberBox(decimals, low, high, prefix=prefix, suffix=suffix), tip, name)
    box.setValue(value)
    return box


def table(titles: Sequence[str], name: str, stretched: Sequence[int]) -> QtWidgets.QTableWidget:
    """Make a table that is only read; `stretched` columns share the width that the others leave."""
    table = QtWidgets.QTableWidget(0, len(titles))
    table.setHorizontalHeaderLabels(list(titles))
    table.setAccessibleName(name)
    table.setEditTriggers(QtWidgets.QAbstractItemView.EditTrigger.NoEditTriggers)
    table.setSelectionBehavior(QtWidgets.QAbstractItemView.SelectionBehavior.SelectRows)
    table.setAlternatingRowColors(True)
    table.setTabKeyNavigation(False)  # whoever has no mouse gets out again
    rows, columns = table.verticalHeader(), table.horizontalHeader()
    assert rows is not None
    assert columns is not None
    rows.hide()
    rows.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.ResizeToContents)
    columns.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.ResizeToContents)
    for column in stretched:
        columns.setSectionResizeMode(column, QtWidgets.QHeaderView.ResizeMode.Stretch)
    return table


def fill_row(
    table: QtWidgets.QTableWidget,
    row: int,
    texts: Sequence[str],
    colours: Mapping[int, str] = MappingProxyType({}),
    *,
    right: Collection[int] = (),
    tip: str = "",
) -> None:
    """Set the texts of a row; `colours` by column, columns in `right` are aligned right; a text is its own tooltip."""
    for column, text in enumerate(texts):
        item = QtWidgets.QTableWidgetItem(text)
        item.setToolTip(tip or text)
        side = Qt.AlignmentFlag.AlignRight if column in right else Qt.AlignmentFlag.AlignLeft
        item.setTextAlignment(side | Qt.AlignmentFlag.AlignVCenter)
        if column in colours:
            item.setForeground(QColor(colours[column]))
        table.setItem(row, column, item)


def label(
    name: str = "",
    text: str = "",
    *,
    role: str = "",
    wraps: bool = False,
    any_width: bool = False,
    selectable: bool = False,
) -> QtWidgets.QLabel:
    """Make a label; `role` is one of the theme's sheet, as ``"faint"``; one of `any_width` never widens its parent."""
    label = QtWidgets.QLabel(text)
    label.setAccessibleName(name)
    label.setProperty("role", role)
    label.setWordWrap(wraps)
    if any_width:
        label.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Preferred)
    if selectable:
        label.setTextInteractionFlags(Qt.TextInteractionFlags() | Qt.TextInteractionFlag.TextSelectableByMouse)
    return label


def labelled(text: str, widget: QtWidgets.QWidget) -> tuple[QtWidgets.QLabel, QtWidgets.QWidget]:
    """Make a label whose key, after an ampersand, leads to a widget; return both."""
    made = QtWidgets.QLabel(text)
    made.setBuddy(widget)
    return made, widget


def choice(name: str, tip: str, choices: Sequence[str], chosen: int = 0) -> QtWidgets.QComboBox:
    """Make a box to choose one of several texts."""
    choice = named(QtWidgets.QComboBox(), tip, name)
    choice.addItems(choices)
    choice.setCurrentIndex(chosen)
    return choice


def check(text: str, tip: str, name: str = "", *, on: bool = False) -> QtWidgets.QCheckBox:
    """Make a check box."""
    box = named(QtWidgets.QCheckBox(text), tip, name)
    box.setChecked(on)
    return box


def push_button(text: str, tip: str, act: Callable[[], Any], name: str = "") -> QtWidgets.QPushButton:
    """Make a button that calls `act`."""
    button = named(QtWidgets.QPushButton(text), tip, name)
    button.clicked.connect(lambda _checked=False: act())
    return button


def tool_button(
    text: str, tip: str, act: Callable[[], Any] = lambda: None, name: str = "", *, checkable: bool = False
) -> QtWidgets.QToolButton:
    """Make a flat button that calls `act`."""
    button = QtWidgets.QToolButton()
    button.setText(text)
    button.setCheckable(checkable)
    button.clicked.connect(lambda _checked=False: act())
    return named(button, tip, name)


def exclusive_buttons(
    choices: Sequence[tuple[str, str, str]], act: Callable[[str], object]
) -> dict[str, QtWidgets.QToolButton]:
    """Make buttons of which one is down, the first one at first; `act` receives the choice that was pressed.

    choices: Each choice, with its button's text and tooltip.
    act: Receives a choice.
    """
    buttons = {}
    for choice, text, tip in choices:
        button = buttons[choice] = tool_button(text, tip, partial(act, choice), checkable=True)
        button.setAutoExclusive(True)
        button.setChecked(len(buttons) == 1)
    return buttons


def progress_bar(name: str, text: str = "") -> QtWidgets.QProgressBar:
    """Make a progress bar; `text` as of `QProgressBar.setFormat`."""
    bar = QtWidgets.QProgressBar()
    bar.setAccessibleName(name)
    bar.setFormat(text)
    bar.setTextVisible(bool(text))
    return bar


def row(
    *items: Item, owner: QtWidgets.QWidget | None = None, margins: Margins = _NO_MARGINS, spacing: int | None = None
) -> QtWidgets.QHBoxLayout:
    """Lay items out from left to right: widgets, layouts, (item, stretch), pixels of space, None for a stretch."""
    return _fill(QtWidgets.QHBoxLayout(), items, owner, margins, spacing)


def column(
    *items: Item, owner: QtWidgets.QWidget | None = None, margins: Margins = _NO_MARGINS, spacing: int | None = None
) -> QtWidgets.QVBoxLayout:
    """Lay items out from top to bottom, as `row`."""
    return _fill(QtWidgets.QVBoxLayout(), items, owner, margins, spacing)


def _fill(
    box: AnyBox, items: Sequence[Item], owner: QtWidgets.QWidget | None, margins: Margins, spacing: int | None
) -> AnyBox:
    box.setContentsMargins(*margins)
    if spacing is not None:
        box.setSpacing(spacing)
    for item in items:
        part, stretch = item if isinstance(item, tuple) else (item, 0)
        if part is None:
            box.addStretch(1)
        elif isinstance(part, int):
            box.addSpacing(part)
        elif isinstance(part, QtWidgets.QLayout):
            box.addLayout(part, stretch)
        else:
            box.addWidget(part, stretch)
    if owner is not None:
        owner.setLayout(box)
    return box


def tab_pages(name: str, pages: Mapping[str, QtWidgets.QWidget]) -> QtWidgets.QTabWidget:
    """Make pages with tabs above them, by title."""
    made = QtWidgets.QTabWidget()
    made.setDocumentMode(True)
    made.setAccessibleName(name)
    for title, page in pages.items():
        made.addTab(page, title)
    return made


def scrolling(part: QtWidgets.QWidget) -> QtWidgets.QScrollArea:
    """Put a widget into an area that scrolls where it is larger than its room."""
    area = QtWidgets.QScrollArea()
    area.setWidgetResizable(True)
    area.setFrameShape(QtWidgets.QFrame.Shape.NoFrame)
    area.setWidget(part)
    return area


def side_by_side(*parts: Part, growing: Sequence[int] = (), above: bool = False) -> QtWidgets.QSplitter:
    """Widgets from left to right, or one above the other; those numbered in `growing` take the additional room."""
    splitter = QtWidgets.QSplitter(Qt.Orientation.Vertical if above else Qt.Orientation.Horizontal)
    splitter.setChildrenCollapsible(False)
    for part, _ in parts:
        splitter.addWidget(part)
    splitter.setSizes([size for _, size in parts])
    for number in growing:
        splitter.setStretchFactor(number, 1)
    return splitter


class Badge(Themed, QtWidgets.QLabel):
    """A word on a coloured ground."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.setAccessibleName(name)
        self.setSizePolicy(QtWidgets.QSizePolicy.Policy.Preferred, QtWidgets.QSizePolicy.Policy.Fixed)
        self._colour = ""

    def show_word(self, word: str, colour: str) -> None:
        """Show a word on a colour of the theme."""
        if colour != self._colour:
            self._colour = colour
            ground = f"background: {colour}; color: {self.theme.ink}; border-radius: 4px;"
            self.setStyleSheet(f"{ground} font-weight: 600; padding: 2px 9px;")
        self.setText(word)


def finish_text(finish_s: float) -> str:
    """Remaining time until an instant (seconds since 1970), and its time of day."""
    finish = datetime.fromtimestamp(finish_s).astimezone()
    today = datetime.now().astimezone().date()
    at = finish.strftime("%H:%M" if finish.date() == today else "%a %d %b %H:%M")
    return f"{hours(max(0.0, finish_s - time.time()))} left  ·  finished at {at}"
