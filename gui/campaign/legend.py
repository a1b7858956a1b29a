"""What the colours of the map mean: the statuses with their counts, or a colour bar with its unit."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QPointF, QSize, Qt
from PyQt5.QtGui import QBrush, QColor, QIcon, QLinearGradient, QPainter, QPaintEvent, QPixmap
from PyQt5.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QStackedLayout, QWidget

from gui.campaign.status_look import LOOKS, Look, look_index
from gui.theme import LIGHT, Theme

_SWATCH = 14


class ColourBar(QWidget):
    """A gradient with what its ends mean."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._map = colour_map
        self._ends = ("", "")
        self._title = ""
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:  # noqa: N802
        """Two lines of text high."""
        return QSize(300, 2 * self.fontMetrics().height() + 4)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """As high, and narrow."""
        return QSize(160, self.sizeHint().height())

    def show_range(self, title: str, unit: str, low: float, high: float, beyond: tuple[bool, bool]) -> None:
        """Say what it means, and whether there are values beyond its ends."""
        self._title = f"{title} ({unit})" if unit else title
        below, above = beyond
        self._ends = (
            ("≤ " if below else "") + _figure(low, low, high),
            ("≥ " if above else "") + _figure(high, low, high),
        )
        self.setAccessibleName(f"Colour bar: {self._title} from {self._ends[0]} to {self._ends[1]}")
        self.setToolTip(f"{self._title}: dark is {self._ends[0]}, bright is {self._ends[1]}")
        self.update()

    def paintEvent(self, _event: QPaintEvent | None) -> None:  # noqa: N802
        """Draw it."""
        painter = QPainter(self)
        width, line = self.width(), self.fontMetrics().height()
        gradient = QLinearGradient(QPointF(0, 0), QPointF(width, 0))
        for at in np.linspace(0.0, 1.0, 17):
            gradient.setColorAt(float(at), self._map.map(float(at), mode=self._map.QCOLOR))
        painter.fillRect(0, 2, width, line - 2, QBrush(gradient))
        painter.setPen(self.palette().color(self.foregroundRole()))
        left, right = self._ends
        place = self.rect().adjusted(0, line + 2, 0, 0)
        painter.drawText(place, Qt.AlignmentFlag.AlignLeft, left)
        painter.drawText(place, Qt.AlignmentFlag.AlignRight, right)
        title = self.fontMetrics().elidedText(self._title, Qt.TextElideMode.ElideRight, max(40, width - 120))
        painter.drawText(place, Qt.AlignmentFlag.AlignHCenter, title)


class Legend(QWidget):
    """Statuses or colour bar, whichever the map shows."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._theme = LIGHT
        self._bar = ColourBar(colour_map)
        self._statuses = QWidget()
        row = QHBoxLayout(self._statuses)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(4)
        self._swatches: list[tuple[Look, QLabel, QLabel]] = []
        for look in reversed(LOOKS):
            swatch, words = QLabel(), QLabel(look.word)
            row.addWidget(swatch)
            row.addWidget(words)
            row.addSpacing(8)
            self._swatches.append((look, swatch, words))
        row.addStretch(1)
        self._stack = QStackedLayout(self)
        self._stack.addWidget(self._statuses)
        self._stack.addWidget(self._bar)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Maximum)

    def show_status(self, status: NDArray[np.uint8]) -> None:
        """Say what the statuses look like and how many positions have each."""
        counts = np.bincount(look_index(status), minlength=len(LOOKS))
        for number, (look, swatch, words) in enumerate(self._swatches):
            count = int(counts[len(LOOKS) - 1 - number])
            seen = count > 0 or look.word in ("valid", "not measured")
            swatch.setVisible(seen)
            words.setVisible(seen)
            words.setText(f"{look.word} {count}")
        self._stack.setCurrentWidget(self._statuses)

    def show_range(self, title: str, unit: str, low: float, high: float, beyond: tuple[bool, bool]) -> None:
        """Say what the colours of a figure mean."""
        self._bar.show_range(title, unit, low, high, beyond)
        self._stack.setCurrentWidget(self._bar)

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        for look, swatch, _ in self._swatches:
            swatch.setPixmap(_swatch(look, theme).pixmap(_SWATCH, _SWATCH))


def _swatch(look: Look, theme: Theme) -> QIcon:
    sharp = 3
    picture = QPixmap(_SWATCH * sharp, _SWATCH * sharp)
    picture.fill(QColor(look.colour(theme) or theme.cell))
    if look.symbol:
        painter = QPainter(picture)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.translate(_SWATCH * sharp / 2, _SWATCH * sharp / 2)
        painter.scale(24, 24)
        painter.setPen(pyqtgraph.mkPen(theme.text, width=0.1, cosmetic=False))
        painter.setBrush(QColor(theme.base))
        painter.drawPath(pyqtgraph.graphicsItems.ScatterPlotItem.Symbols[look.symbol])
        painter.end()
    return QIcon(picture)


def _figure(value: float, low: float, high: float) -> str:
    span = high - low
    digits = (
        0 if span >= 50 or (low.is_integer() and high.is_integer()) else 1 if span >= 5 else 2 if span >= 0.5 else 4
    )
    return f"{value:.{digits}f}"
