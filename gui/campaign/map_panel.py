"""The map with what belongs to it: what it is coloured by, how positions are selected, and the legend."""

from __future__ import annotations

from PyQt5.QtWidgets import QComboBox, QHBoxLayout, QLabel, QSizePolicy, QToolButton, QVBoxLayout, QWidget

from gui.campaign.figures import FIGURES
from gui.campaign.legend import Legend
from gui.campaign.model import Campaign
from gui.campaign.surface_map import SurfaceMap
from gui.shell.theme import Theme

_WAYS = (("pan", "Pan"), ("rectangle", "Rectangle"), ("lasso", "Lasso"))


class MapPanel(QWidget):
    """Draws the campaign's map."""

    def __init__(self, campaign: Campaign) -> None:
        super().__init__()
        self._campaign = campaign
        self._seen = {"surface": -1, "map": -1}
        self.map = SurfaceMap()
        self.legend = Legend(self.map.colour_map)
        self.colour_by = QComboBox()
        self.colour_by.addItem("status")
        self.colour_by.addItems([figure.label for figure in FIGURES])
        self.colour_by.setAccessibleName("What the map is coloured by")
        self.colour_by.setToolTip("What the map is coloured by; residual and coherence are the worst actuator's")
        self.ways: dict[str, QToolButton] = {}
        row = QHBoxLayout()
        row.addWidget(QLabel("Colour by"))
        row.addWidget(self.colour_by, stretch=1)
        for way, words in _WAYS:
            button = QToolButton()
            button.setText(words)
            button.setCheckable(True)
            button.setAutoExclusive(True)
            button.setChecked(way == "pan")
            button.setAccessibleName(f"Drag: {words}")
            button.clicked.connect(lambda _checked=False, way=way: self._drag(way))
            self.ways[way] = button
            row.addWidget(button)
        self.ways["pan"].setToolTip("A drag moves the map, the wheel zooms, a double click shows everything")
        self.ways["rectangle"].setToolTip("A drag selects positions in a rectangle; with Ctrl adds them")
        self.ways["lasso"].setToolTip("A drag selects positions inside a line drawn freely; with Ctrl adds them")
        self.colour_by.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addLayout(row)
        column.addWidget(self.map, stretch=1)
        column.addWidget(self.legend)
        self.colour_by.currentIndexChanged.connect(self._redraw)

    def draw(self) -> None:
        """Draw what changed."""
        campaign, seen = self._campaign, self._campaign.revision
        if campaign.surface is None:
            return
        if self._seen["surface"] != seen["surface"]:
            self._seen["surface"] = seen["surface"]
            self.map.show_surface(campaign.surface)
            self._seen["map"] = -1
        if self._seen["map"] != seen["map"]:
            self._seen["map"] = seen["map"]
            self._redraw()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.map.apply_theme(theme)
        self.legend.apply_theme(theme)
        self._redraw()

    def _redraw(self) -> None:
        campaign, index = self._campaign, self.colour_by.currentIndex() - 1
        if campaign.surface is None:
            return
        values = campaign.figures.get(FIGURES[index].key) if index >= 0 else None
        if index < 0 or values is None or len(values) != len(campaign.status):
            self.map.show_status(campaign.status)
            self.legend.show_status(campaign.status)
        else:
            self.map.show_figure(FIGURES[index], values, campaign.status)
            low, high = self.map.levels or (0.0, 1.0)
            self.legend.show_range(FIGURES[index].title, FIGURES[index].unit, low, high, self.map.beyond)
        self.map.show_current(campaign.current)

    def _drag(self, way: str) -> None:
        self.map.drag_mode = way
