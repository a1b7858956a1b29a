"""The table of figures, and below it what a person should know about the scene."""

from __future__ import annotations

from collections.abc import Sequence

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QBrush, QColor
from PyQt5.QtWidgets import QHeaderView, QLabel, QTableWidget, QTableWidgetItem, QVBoxLayout, QWidget

from gui.scene.results.figures import HELD, Figure
from gui.shell.theme import LIGHT, Theme
from storage.units import quantity

_TITLES = ("figure", "value", "limit", "verdict")


class FiguresView(QWidget):
    """Lists figures; what each means stands in its tooltip."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self.figures: list[Figure] = []
        self.table = QTableWidget(0, len(_TITLES))
        self.table.setHorizontalHeaderLabels(_TITLES)
        self.table.setAccessibleName("Figures of the scene")
        self.table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
        self.table.setSelectionBehavior(QTableWidget.SelectionBehavior.SelectRows)
        self.table.setAlternatingRowColors(True)
        self.table.setWordWrap(False)
        side, top = self.table.verticalHeader(), self.table.horizontalHeader()
        assert side is not None
        assert top is not None
        side.hide()
        side.setDefaultSectionSize(self.table.fontMetrics().height() + 7)
        top.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        top.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self.warnings = QLabel()
        self.warnings.setWordWrap(True)
        self.warnings.setContentsMargins(6, 4, 6, 4)
        self.warnings.setAccessibleName("Warnings of the scene")
        self.warnings.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.table, stretch=1)
        column.addWidget(self.warnings)
        self.warnings.hide()

    def show_figures(self, figures: Sequence[Figure], warnings: Sequence[str]) -> None:
        """Show figures and warnings."""
        self.figures = list(figures)
        self.table.setRowCount(len(figures))
        for row, figure in enumerate(figures):
            value = quantity(figure.value, figure.unit) if figure.value else "—"
            cells = (figure.name, value, figure.limit, figure.verdict)
            for column, text in enumerate(cells):
                item = QTableWidgetItem(text)
                item.setToolTip(figure.definition)
                if column in (1, 2):
                    item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                if figure.verdict and column == len(cells) - 1:
                    held = figure.verdict == HELD
                    item.setForeground(QBrush(QColor(self._theme.warning if held else self._theme.good)))
                self.table.setItem(row, column, item)
        self.warnings.setText("\n".join(f"• {warning}" for warning in warnings))
        self.warnings.setVisible(bool(warnings))

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.show_figures(self.figures, [line[2:] for line in self.warnings.text().split("\n") if line])
