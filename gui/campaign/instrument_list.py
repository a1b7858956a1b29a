"""The instruments of the session: their state, and what was last heard of each."""

from __future__ import annotations

from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import QHeaderView, QLabel, QTableWidget, QTableWidgetItem, QVBoxLayout, QWidget

from gui.campaign.model import Campaign
from gui.campaign.position_panel import clock
from gui.shell.theme import LIGHT, Theme

_MARKS = {"in use": "●", "at rest": "○", "faulty": "▲", "away": "✕"}


class InstrumentList(QWidget):
    """One row per instrument."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._seen = -1
        self._theme = LIGHT
        self.table = QTableWidget(0, 3)
        self.table.setHorizontalHeaderLabels(["instrument", "state", "last message"])
        self.table.setAccessibleName("Instruments")
        self.table.setWordWrap(False)
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        side, top = self.table.verticalHeader(), self.table.horizontalHeader()
        assert side is not None
        assert top is not None
        side.hide()
        top.setSectionResizeMode(0, QHeaderView.ResizeMode.ResizeToContents)
        top.setSectionResizeMode(1, QHeaderView.ResizeMode.ResizeToContents)
        top.setSectionResizeMode(2, QHeaderView.ResizeMode.Stretch)
        title = QLabel("Instruments")
        title.setProperty("role", "strong")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(title)
        column.addWidget(self.table, stretch=1)

    def draw(self) -> None:
        """Draw what changed."""
        if self._seen == self._campaign.revision["instruments"]:
            return
        self._seen = self._campaign.revision["instruments"]
        instruments = self._campaign.instruments.all
        self.table.setRowCount(len(instruments))
        theme = self._theme
        colours = {"in use": theme.good, "at rest": theme.faint, "faulty": theme.warning, "away": theme.fault}
        for row, instrument in enumerate(instruments):
            told = f"{clock(instrument.at_s)}  {instrument.message}".strip()
            words = (
                instrument.name.partition(",")[0],
                f"{_MARKS[instrument.state]} {instrument.state}",
                told or "nothing to tell",
            )
            for column, text in enumerate(words):
                item = QTableWidgetItem(text)
                item.setToolTip(instrument.name if column == 0 else text)
                if column == 1:
                    item.setForeground(QColor(colours[instrument.state]))
                self.table.setItem(row, column, item)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours and the text's size."""
        self._theme = theme
        self._seen = -1
        side = self.table.verticalHeader()
        assert side is not None
        side.setDefaultSectionSize(self.fontMetrics().height() + 6)
