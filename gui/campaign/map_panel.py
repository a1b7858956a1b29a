"""The map with its colouring, selection tools and legend."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtGui import QColor, QPainter, QPixmap
from PyQt5.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QLabel,
    QSizePolicy,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from gui.campaign.model import Campaign
from gui.campaign.quality import FIGURES, LOOKS, Look, look_index
from gui.campaign.surface_map import SurfaceMap
from gui.shell.theme import Theme
from gui.shell.widgets import named
from gui.surface.colours import ColourBar

_DRAG_MODES = (
    ("pan", "A drag pans the map, the wheel zooms, a double click shows everything"),
    ("rectangle", "A drag selects positions in a rectangle; with Ctrl adds them"),
    ("lasso", "A drag selects positions inside a freely drawn line; with Ctrl adds them"),
)
_SWATCH = 14


class MapPanel(QWidget):
    """Draws the campaign's map."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = {"surface": -1, "map": -1}
        self.map = SurfaceMap()
        self.legend = Legend(self.map.colour_map)
        tip = "Colour of the map; residual and coherence are the worst actuator's"
        self.colour_by = named(QComboBox(), tip, "Colour of the map")
        self.colour_by.addItems(["status", *(figure.label for figure in FIGURES)])
        self.colour_by.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.ways: dict[str, QToolButton] = {}
        row = QHBoxLayout()
        row.addWidget(QLabel("Colour by"))
        row.addWidget(self.colour_by, stretch=1)
        for mode, tip in _DRAG_MODES:
            button = self.ways[mode] = named(QToolButton(), tip, f"Drag: {mode}")
            button.setText(mode.capitalize())
            button.setCheckable(True)
            button.setAutoExclusive(True)
            button.setChecked(mode == "pan")
            button.clicked.connect(lambda _checked=False, mode=mode: setattr(self.map, "drag_mode", mode))
            row.addWidget(button)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(row)
        column.addWidget(self.map, stretch=1)
        column.addWidget(self.legend)
        self.colour_by.currentIndexChanged.connect(self._redraw)

    def draw(self) -> None:
        campaign, revision = self._campaign, self._campaign.revision
        if campaign.surface is None:
            return
        if self._drawn["surface"] != revision["surface"]:
            self._drawn = {"surface": revision["surface"], "map": -1}
            self.map.show_surface(campaign.surface)
        if self._drawn["map"] != revision["map"]:
            self._drawn["map"] = revision["map"]
            self._redraw()

    def apply_theme(self, theme: Theme) -> None:
        self.map.apply_theme(theme)
        self.legend.apply_theme(theme)
        self._redraw()

    def _redraw(self) -> None:
        campaign, index = self._campaign, self.colour_by.currentIndex() - 1
        if campaign.surface is None:
            return
        values = campaign.figures.get(FIGURES[index].key) if index >= 0 else None
        if values is None or len(values) != len(campaign.status):
            self.map.show_status(campaign.status)
            self.legend.show_status(campaign.status)
        else:
            figure = FIGURES[index]
            self.map.show_figure(figure, values, campaign.status)
            self.legend.show_range(figure.title, figure.unit, self.map.levels or (0.0, 1.0), self.map.beyond)
        self.map.show_current(campaign.current)


class Legend(QWidget):
    """Statuses with their counts, or a colour bar."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._bar = ColourBar(colour_map)
        self._statuses = QWidget()
        row = QHBoxLayout(self._statuses)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(4)
        self._swatches: list[tuple[Look, QLabel, QLabel]] = [(look, QLabel(), QLabel()) for look in LOOKS]
        for _, swatch, text in reversed(self._swatches):
            row.addWidget(swatch)
            row.addWidget(text)
            row.addSpacing(8)
        row.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self._statuses)
        column.addWidget(self._bar)
        self._bar.hide()
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Maximum)

    def show_status(self, status: NDArray[np.uint8]) -> None:
        """Show the looks of the statuses, and how many positions have each."""
        counts = np.bincount(look_index(status), minlength=len(LOOKS))
        for (look, swatch, text), count in zip(self._swatches, counts.tolist(), strict=True):
            visible = count > 0 or look.word in ("valid", "not measured")
            swatch.setVisible(visible)
            text.setVisible(visible)
            text.setText(f"{look.word} {count}")
        self._show(self._statuses)

    def show_range(self, title: str, unit: str, levels: tuple[float, float], beyond: tuple[bool, bool]) -> None:
        self._bar.show_range(title, unit, levels, beyond)
        self._show(self._bar)

    def apply_theme(self, theme: Theme) -> None:
        self._bar.apply_theme(theme)
        for look, swatch, _ in self._swatches:
            swatch.setPixmap(_swatch(look, theme))

    def _show(self, shown: QWidget) -> None:
        for widget in (self._statuses, self._bar):
            widget.setVisible(widget is shown)


def _swatch(look: Look, theme: Theme) -> QPixmap:
    sharp = 3
    picture = QPixmap(_SWATCH * sharp, _SWATCH * sharp)
    picture.fill(QColor(look.colour(theme)))
    if look.symbol:
        painter = QPainter(picture)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.translate(_SWATCH * sharp / 2, _SWATCH * sharp / 2)
        painter.scale(24, 24)
        painter.setPen(pyqtgraph.mkPen(theme.text, width=0.1, cosmetic=False))
        painter.setBrush(QColor(theme.base))
        painter.drawPath(pyqtgraph.graphicsItems.ScatterPlotItem.Symbols[look.symbol])
        painter.end()
    picture.setDevicePixelRatio(sharp)
    return picture
