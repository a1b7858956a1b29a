"""Lists below the map: events with a filter, and instruments."""

from __future__ import annotations

import time

from PyQt5.QtCore import QAbstractTableModel, QModelIndex, Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QLineEdit,
    QTableView,
    QWidget,
)

from gui.campaign.follower import Line, Weight, clock
from gui.campaign.model import Campaign
from gui.theme import LIGHT, Theme
from gui.widgets import column, fill_row, make_choice, make_label, make_table, named, row

_TITLES = ("time", "weight", "event")
_NOWHERE = QModelIndex()
_COUNT_EVERY_S = 0.5
_STATE_MARKS = {"in use": "●", "at rest": "○", "faulty": "▲", "away": "✕"}


class EventLines(QAbstractTableModel):
    """Lines that pass the filter."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._shown: list[Line] = []
        self._taken = self._trimmed = 0
        self._least = Weight.NOTE
        self._text = ""
        self.theme = LIGHT

    def rowCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        return 0 if parent.isValid() else len(self._shown)

    def columnCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        return 0 if parent.isValid() else len(_TITLES)

    def line(self, row: int) -> Line:
        return self._shown[row]

    def data(self, index: QModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> object:
        if not index.isValid():
            return None
        line = self._shown[index.row()]
        if role in (Qt.ItemDataRole.DisplayRole, Qt.ItemDataRole.ToolTipRole):
            return (clock(line.at_s), line.weight.name.lower(), line.text)[index.column()]
        if role == Qt.ItemDataRole.ForegroundRole and line.weight >= Weight.WARNING:
            return QColor(self.theme.fault if line.weight is Weight.FAULT else self.theme.warning)
        return None

    def headerData(  # noqa: N802
        self, section: int, orientation: Qt.Orientation, role: int = Qt.ItemDataRole.DisplayRole
    ) -> object:
        wanted = orientation == Qt.Orientation.Horizontal and role == Qt.ItemDataRole.DisplayRole
        return _TITLES[section] if wanted else None

    def restrict(self, least: Weight, text: str) -> None:
        """Show only lines of at least some weight that contain a text."""
        self._least, self._text = least, text.casefold()
        self._rebuild()

    def take_new(self) -> bool:
        """Add new lines; whether any of them is shown."""
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
    """Events; a double click shows the position concerned."""

    position_wanted = pyqtSignal(int)

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = -1
        self._count_due_s = 0.0
        self.lines = EventLines(campaign)
        choices = ["everything", "notes and above", "warnings and faults", "faults"]
        tip = "Events shown here (all are in the log next to the bank)"
        self.weight = make_choice("Least weight", tip, choices, Weight.NOTE)
        self.text = named(QLineEdit(), "Show only events that contain this text (Ctrl+F)", "Filter text")
        self.text.setPlaceholderText("filter…")
        self.text.setClearButtonEnabled(True)
        self.view = QTableView()
        self.view.setModel(self.lines)
        self.view.setAccessibleName("Events")
        self.view.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.view.setShowGrid(False)
        self.view.setWordWrap(False)
        rows, columns = self.view.verticalHeader(), self.view.horizontalHeader()
        assert rows is not None
        assert columns is not None
        rows.hide()
        rows.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        columns.setStretchLastSection(True)
        self._rows = rows
        self._count = make_label(role="faint")
        title = make_label(text="Events", role="strong")
        column(row(title, self.weight, (self.text, 1), self._count), (self.view, 1), owner=self)
        self.weight.currentIndexChanged.connect(self._restrict)
        self.text.textChanged.connect(self._restrict)
        self.view.doubleClicked.connect(self._show_position)

    def draw(self) -> None:
        if self._drawn != self._campaign.revision["lines"]:
            self._drawn = self._campaign.revision["lines"]
            bar = self.view.verticalScrollBar()
            at_end = bar is None or bar.value() >= bar.maximum() - 1
            if self.lines.take_new() and at_end:
                self.view.scrollToBottom()
        if time.monotonic() >= self._count_due_s:
            self._show_count()

    def apply_theme(self, theme: Theme) -> None:
        """Use the theme's colours and the size of the text."""
        self.lines.theme = theme
        metrics = self.fontMetrics()
        self._rows.setDefaultSectionSize(metrics.height() + 5)
        self.view.setColumnWidth(0, metrics.horizontalAdvance("Wed 00:00:00") + 18)
        self.view.setColumnWidth(1, metrics.horizontalAdvance("warning") + 22)
        self._count.setMinimumWidth(metrics.horizontalAdvance("0000 of 00000"))

    def _restrict(self) -> None:
        self.lines.restrict(Weight(self.weight.currentIndex()), self.text.text())
        self._show_count()
        self.view.scrollToBottom()

    def _show_count(self) -> None:
        """Show the number of lines; not at every event, because a label that changes lays out its row again."""
        self._count_due_s = time.monotonic() + _COUNT_EVERY_S
        self._count.setText(f"{self.lines.rowCount()} of {len(self._campaign.lines)}")

    def _show_position(self, index: QModelIndex) -> None:
        position = self.lines.line(index.row()).position
        if position >= 0:
            self.position_wanted.emit(position)


class InstrumentList(QWidget):
    """State and last message of each instrument."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = -1
        self._theme = LIGHT
        self.table = make_table(("instrument", "state", "last message"), "Instruments", stretched=(2,))
        self.table.setWordWrap(False)
        column(make_label(text="Instruments", role="strong"), (self.table, 1), owner=self)

    def draw(self) -> None:
        if self._drawn == self._campaign.revision["instruments"]:
            return
        self._drawn = self._campaign.revision["instruments"]
        instruments, theme = self._campaign.instruments, self._theme
        self.table.setRowCount(len(instruments))
        colours = {"in use": theme.good, "at rest": theme.faint, "faulty": theme.warning, "away": theme.fault}
        for number, instrument in enumerate(instruments):
            message = f"{clock(instrument.at_s)}  {instrument.message}".strip()
            state = f"{_STATE_MARKS[instrument.state]} {instrument.state}"
            fill_row(self.table, number, (instrument.name, state, message or "-"), {1: colours[instrument.state]})
            name = self.table.item(number, 0)
            assert name is not None
            name.setText(instrument.name.partition(",")[0])

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        self._drawn = -1
