"""The vertices of a polyline as a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QHeaderView, QLabel, QSizePolicy, QTableWidget, QTableWidgetItem, QVBoxLayout, QWidget

from gui.scene.draft import PointMm

# Nobody edits more of them by hand; what is beyond is counted.
_MOST_ROWS = 200
_LINES = 4


class Vertices(QWidget):
    """A row for each vertex; what is no number goes back to what it was."""

    edited = pyqtSignal(object)

    def __init__(self) -> None:
        super().__init__()
        self._points: tuple[PointMm, ...] = ()
        self.table = QTableWidget(0, 2)
        self.table.setAccessibleName("Vertices in mm")
        self.table.setToolTip("The polyline's vertices in mm, in order; double click on a line of it adds one")
        self.table.setHorizontalHeaderLabels(["x (mm)", "y (mm)"])
        header, numbers = self.table.horizontalHeader(), self.table.verticalHeader()
        assert header is not None
        assert numbers is not None
        header.setSectionResizeMode(QHeaderView.ResizeMode.Stretch)
        row_px = self.table.fontMetrics().height() + 6
        numbers.setDefaultSectionSize(row_px)
        self.table.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.table.setFixedHeight(row_px * (_LINES + 1) + 6)
        self.table.cellChanged.connect(self._changed)
        self._more = QLabel()
        self._more.setProperty("role", "faint")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.table)
        column.addWidget(self._more)

    def show_points(self, points: Sequence[PointMm]) -> None:
        """Show some vertices."""
        if tuple(points) == self._points:
            return
        former, self._points = self._points, tuple(points)
        rows = min(len(points), _MOST_ROWS)
        self.table.blockSignals(True)
        self.table.setRowCount(rows)
        self.table.setVerticalHeaderLabels([str(row) for row in range(rows)])
        for row in range(rows):
            if row >= len(former) or former[row] != points[row] or self.table.item(row, 0) is None:
                for column in (0, 1):
                    self.table.setItem(row, column, QTableWidgetItem(f"{points[row][column]:.10g}"))
        self.table.blockSignals(False)
        self._more.setText(f"and {len(points) - rows} more" if len(points) > rows else "")
        self._more.setVisible(len(points) > rows)

    def _changed(self, row: int, column: int) -> None:
        item = self.table.item(row, column)
        assert item is not None
        at = list(self._points[row])
        try:
            at[column] = float(item.text().replace(",", "."))
        except ValueError:
            at[column] = math.nan
        if not math.isfinite(at[column]):
            self.table.blockSignals(True)
            item.setText(f"{self._points[row][column]:.10g}")
            self.table.blockSignals(False)
            return
        self.edited.emit((*self._points[:row], (at[0], at[1]), *self._points[row + 1 :]))
