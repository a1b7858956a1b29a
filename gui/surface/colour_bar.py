"""A colour bar: a gradient with what its ends mean."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QPointF, QSize, Qt
from PyQt5.QtGui import QBrush, QColor, QLinearGradient, QPainter, QPaintEvent
from PyQt5.QtWidgets import QSizePolicy, QWidget


class ColourBar(QWidget):
    """A gradient with what its ends mean."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._stops = _stops(colour_map)
        self._ends = ("", "")
        self._title = ""
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Two lines of text high."""
        return QSize(300, 2 * self.fontMetrics().height() + 4)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """As high, and narrow."""
        return QSize(160, self.sizeHint().height())

    def take_map(self, colour_map: pyqtgraph.ColorMap) -> None:
        """Show another gradient."""
        self._stops = _stops(colour_map)
        self.update()

    def show_range(self, title: str, unit: str, low: float, high: float, beyond: tuple[bool, bool]) -> None:
        """Say what it means, and whether there are values beyond its ends."""
        self._title = f"{title} ({unit})" if unit else title
        below, above = beyond
        self._ends = (
            ("≤ " if below else "") + _figure(low, low, high),
            ("≥ " if above else "") + _figure(high, low, high),
        )
        self.setAccessibleName(f"Colour bar: {self._title} from {self._ends[0]} to {self._ends[1]}")
        self.setToolTip(f"{self._title}: from {self._ends[0]} at the left end to {self._ends[1]} at the right end")
        self.update()

    def paintEvent(self, _event: QPaintEvent | None) -> None:  # noqa: N802
        """Draw it."""
        painter = QPainter(self)
        width, line = self.width(), self.fontMetrics().height()
        gradient = QLinearGradient(QPointF(0, 0), QPointF(width, 0))
        gradient.setStops(self._stops)
        painter.fillRect(0, 2, width, line - 2, QBrush(gradient))
        painter.setPen(self.palette().color(self.foregroundRole()))
        left, right = self._ends
        place = self.rect().adjusted(0, line + 2, 0, 0)
        painter.drawText(place, Qt.AlignmentFlag.AlignLeft, left)
        painter.drawText(place, Qt.AlignmentFlag.AlignRight, right)
        title = self.fontMetrics().elidedText(self._title, Qt.TextElideMode.ElideRight, max(40, width - 120))
        painter.drawText(place, Qt.AlignmentFlag.AlignHCenter, title)


def _stops(colour_map: pyqtgraph.ColorMap) -> list[tuple[float, QColor]]:
    places = np.linspace(0.0, 1.0, 17).tolist()
    return [(place, colour_map.map(place, mode=colour_map.QCOLOR)) for place in places]


def _figure(value: float, low: float, high: float) -> str:
    span = high - low
    digits = (
        0 if span >= 50 or (low.is_integer() and high.is_integer()) else 1 if span >= 5 else 2 if span >= 0.5 else 4
    )
    return f"{value:.{digits}f}"
