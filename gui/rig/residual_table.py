"""By how much a mirror map misses each mark."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import QAbstractItemView, QHeaderView, QTableWidget, QTableWidgetItem

from gui.shell.theme import LIGHT

_HEADINGS = ("mark", "x (mm)", "y (mm)", "Δx (mm)", "Δy (mm)", "off (mm)")

Pair = tuple[float, float]


class ResidualTable(QTableWidget):
    """One row per mark; a row is chosen to meet its mark once more."""

    def __init__(self) -> None:
        super().__init__(0, len(_HEADINGS))
        self.theme = LIGHT
        self.setAccessibleName("Residuals of the mirror map in mm")
        self.setToolTip(
            "Where the map lets the beam fall, less where the mark lies, in mm; choose a row to meet it again"
        )
        self.setHorizontalHeaderLabels(list(_HEADINGS))
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        side, top = self.verticalHeader(), self.horizontalHeader()
        assert side is not None
        assert top is not None
        side.hide()
        top.setSectionResizeMode(QHeaderView.ResizeMode.Stretch)

    def show_residuals(self, place_mm: Sequence[Pair], off_mm: Sequence[Pair], limit_mm: float, suspect: int) -> None:
        """Show them; the suspected mark, from 1, is chosen."""
        self.setRowCount(len(off_mm))
        for row, ((x_mm, y_mm), (x_off, y_off)) in enumerate(zip(place_mm, off_mm, strict=False)):
            off = math.hypot(x_off, y_off)
            beyond = off > limit_mm
            words = (
                f"{row + 1}", f"{x_mm:.1f}", f"{y_mm:.1f}", f"{x_off:+.2f}", f"{y_off:+.2f}",
                f"▲ {off:.2f}" if beyond else f"{off:.2f}",
            )  # fmt: skip
            for column, text in enumerate(words):
                item = QTableWidgetItem(text)
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
                if beyond:
                    item.setForeground(QColor(self.theme.fault))
                self.setItem(row, column, item)
        if 0 < suspect <= self.rowCount():
            self.selectRow(suspect - 1)

    @property
    def chosen(self) -> int:
        """The chosen mark, from 1; 0 for none."""
        model = self.selectionModel()
        rows = model.selectedRows() if model is not None else []
        return rows[0].row() + 1 if rows else 0
