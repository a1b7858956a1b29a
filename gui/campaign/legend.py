"""What the colours of the map mean: the statuses with their counts, or a colour bar with its unit."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtGui import QColor, QIcon, QPainter, QPixmap
from PyQt5.QtWidgets import QHBoxLayout, QLabel, QSizePolicy, QStackedLayout, QWidget

from gui.campaign.status_look import LOOKS, Look, look_index
from gui.shell.theme import Theme
from gui.surface.colours import ColourBar

_SWATCH = 14


class Legend(QWidget):
    """Statuses or colour bar, whichever the map shows."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
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
        self._bar.show_range(title, unit, (low, high), beyond)
        self._stack.setCurrentWidget(self._bar)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._bar.apply_theme(theme)
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
