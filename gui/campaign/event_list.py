"""The event list with its filter."""

from __future__ import annotations

import time

from PyQt5.QtCore import QAbstractTableModel, QModelIndex, Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import (
    QAbstractItemView,
    QComboBox,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QLineEdit,
    QTableView,
    QVBoxLayout,
    QWidget,
)

from gui.campaign.event_words import WEIGHT_WORDS, Line, Weight
from gui.campaign.model import Campaign
from gui.campaign.position_panel import clock
from gui.shell.theme import LIGHT, Theme

_TITLES = ("when", "weight", "event")
_NOWHERE = QModelIndex()
_COUNTS_EVERY_S = 0.5


class EventLines(QAbstractTableModel):
    """The lines that pass the filter."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._shown: list[Line] = []
        self._taken = self._trimmed = 0
        self._least = Weight.NOTE
        self._text = ""
        self.theme = LIGHT

    def rowCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        """Lines that pass."""
        return 0 if parent.isValid() else len(self._shown)

    def columnCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        """When, weight, event."""
        return 0 if parent.isValid() else len(_TITLES)

    def line(self, row: int) -> Line:
        """The line in a row."""
        return self._shown[row]

    def data(self, index: QModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> object:
        """What a cell shows."""
        if not index.isValid():
            return None
        line = self._shown[index.row()]
        if role in (Qt.ItemDataRole.DisplayRole, Qt.ItemDataRole.ToolTipRole):
            return (clock(line.at_s), WEIGHT_WORDS[line.weight], line.text)[index.column()]
        if role == Qt.ItemDataRole.ForegroundRole and line.weight >= Weight.WARNING:
            return QColor(self.theme.fault if line.weight is Weight.FAULT else self.theme.warning)
        if role == Qt.ItemDataRole.ForegroundRole and line.weight is Weight.DETAIL:
            return QColor(self.theme.faint)
        return None

    def headerData(  # noqa: N802
        self, section: int, orientation: Qt.Orientation, role: int = Qt.ItemDataRole.DisplayRole
    ) -> object:
        """Titles of the columns."""
        if orientation == Qt.Orientation.Horizontal and role == Qt.ItemDataRole.DisplayRole:
            return _TITLES[section]
        return None

    def restrict(self, least: Weight, text: str) -> None:
        """Show only lines of at least some weight that contain a text."""
        self._least, self._text = least, text.casefold()
        self._rebuild()

    def take_new(self) -> bool:
        """Take up the lines that came in; tells whether any of them is shown."""
        lines = self._campaign.lines
        if self._trimmed != self._campaign.trimmed:
            self._rebuild()
            return True
        new = [line for line in lines[self._taken :] if self._passes(line)]
        self._taken = len(lines)
        if new:
            self.beginInsertRows(QModelIndex(), len(self._shown), len(self._shown) + len(new) - 1)
            self._shown.extend(new)
            self.endInsertRows()
        return bool(new)

    def _rebuild(self) -> None:
        self.beginResetModel()
        self._shown = [line for line in self._campaign.lines if self._passes(line)]
        self._taken, self._trimmed = len(self._campaign.lines), self._campaign.trimmed
        self.endResetModel()

    def _passes(self, line: Line) -> bool:
        return line.weight >= self._least and (not self._text or self._text in line.text.casefold())


class EventList(QWidget):
    """The list; a double click on an event shows its position."""

    position_wanted = pyqtSignal(int)

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._seen = -1
        self._count_due_s = 0.0
        self.lines = EventLines(campaign)
        self.weight = QComboBox()
        self.weight.addItems(["everything", "notes and above", "warnings and faults", "faults"])
        self.weight.setCurrentIndex(Weight.NOTE)
        self.weight.setAccessibleName("Weight of the events that are shown")
        self.weight.setToolTip("Which events are shown (all are in the log beside the bank)")
        self.text = QLineEdit()
        self.text.setPlaceholderText("filter by words…")
        self.text.setClearButtonEnabled(True)
        self.text.setAccessibleName("Words that the events shown contain")
        self.text.setToolTip("Only events that contain these words (Ctrl+F)")
        self.view = QTableView()
        self.view.setModel(self.lines)
        self.view.setAccessibleName("Events")
        self.view.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.view.setShowGrid(False)
        self.view.setWordWrap(False)
        side, top = self.view.verticalHeader(), self.view.horizontalHeader()
        assert side is not None
        assert top is not None
        side.hide()
        side.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        top.setStretchLastSection(True)
        self._count = QLabel()
        self._count.setProperty("role", "faint")
        title = QLabel("Events")
        title.setProperty("role", "strong")
        row = QHBoxLayout()
        row.addWidget(title)
        row.addWidget(self.weight)
        row.addWidget(self.text, stretch=1)
        row.addWidget(self._count)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(row)
        column.addWidget(self.view, stretch=1)
        self.weight.currentIndexChanged.connect(self._restrict)
        self.text.textChanged.connect(self._restrict)
        self.view.doubleClicked.connect(self._wanted)

    def draw(self) -> None:
        """Draw what came in, and follow it where the newest line was in sight."""
        if self._seen != self._campaign.revision["lines"]:
            self._seen = self._campaign.revision["lines"]
            bar = self.view.verticalScrollBar()
            at_end = bar is None or bar.value() >= bar.maximum() - 1
            if self.lines.take_new() and at_end:
                self.view.scrollToBottom()
        if time.monotonic() >= self._count_due_s:
            self._tell_count()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours and the text's size."""
        self.lines.theme = theme
        line = self.fontMetrics().height()
        side = self.view.verticalHeader()
        assert side is not None
        side.setDefaultSectionSize(line + 5)
        self.view.setColumnWidth(0, self.fontMetrics().horizontalAdvance("Wed 00:00:00") + 18)
        self.view.setColumnWidth(1, self.fontMetrics().horizontalAdvance("warning") + 22)
        self._count.setMinimumWidth(self.fontMetrics().horizontalAdvance("0000 of 00000"))

    def _restrict(self) -> None:
        self.lines.restrict(Weight(self.weight.currentIndex()), self.text.text())
        self._tell_count()
        self.view.scrollToBottom()

    def _tell_count(self) -> None:
        """A label that changes lays out its row anew: not at every event."""
        self._count_due_s = time.monotonic() + _COUNTS_EVERY_S
        text = f"{self.lines.rowCount()} of {len(self._campaign.lines)}"
        if text != self._count.text():
            self._count.setText(text)

    def _wanted(self, index: QModelIndex) -> None:
        position = self.lines.line(index.row()).position
        if position >= 0:
            self.position_wanted.emit(position)
