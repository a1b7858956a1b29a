"""Colour maps and units of fields, and the colour bar that explains them; readable with any colour vision."""

from __future__ import annotations

import math

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QSize
from PyQt5.QtWidgets import QFrame, QSizePolicy

from gui.shell.theme import LIGHT, Theme

# Blue and orange differ for every kind of colour vision, and in brightness from the middle on. In the dark theme the
# middle is dark, so that a surface at rest does not shine.
_ON_LIGHT = ("#08306b", "#3f7fb8", "#a9cbe6", "#f7f7f5", "#f5c08a", "#d0712a", "#7a2f04")
_ON_DARK = ("#c6e6ff", "#5fb0ea", "#2b648f", "#1f2429", "#8d5420", "#e89440", "#ffe3bd")
# Units that take a prefix; those of other banks are shown as they are.
_WITH_PREFIX = ("m/s", "m", "m/s²", "m/s^2", "V", "Pa")
_BAR_PX = 12
_PREFIXES = (("", 1.0), ("m", 1e3), ("µ", 1e6), ("n", 1e9), ("p", 1e12))


def signed_map(theme: Theme) -> pyqtgraph.ColorMap:
    """Return the map from negative (blue) over zero (the window's base colour) to positive (orange)."""
    colours = _ON_DARK if theme.name == "dark" else _ON_LIGHT
    return pyqtgraph.ColorMap(np.linspace(0.0, 1.0, len(colours)), list(colours))


def magnitude_map() -> pyqtgraph.ColorMap:
    """Return the map from small (dark) to large (bright)."""
    return pyqtgraph.colormap.get("cividis")


def symmetric_levels(largest: float) -> tuple[float, float]:
    """Return the ends of a scale with zero in its middle, also for a field that is silent everywhere."""
    limit = largest if np.isfinite(largest) and largest > 0.0 else 1.0
    return -limit, limit


def scaled_unit(unit: str, largest: float) -> tuple[float, str]:
    """Return the factor and the prefixed unit that make the largest value of a scale at least 0.1."""
    if unit not in _WITH_PREFIX or not (math.isfinite(largest) and largest > 0.0):
        return 1.0, unit
    prefix, factor = next((one for one in _PREFIXES if largest * one[1] >= 0.1), _PREFIXES[-1])
    return factor, prefix + unit


class ColourBar(pyqtgraph.GraphicsView):
    """A horizontal `pyqtgraph.ColorBarItem` with a title."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._bar = pyqtgraph.ColorBarItem(
            values=(0.0, 1.0),
            width=_BAR_PX,
            colorMap=colour_map,
            interactive=False,
            orientation="h",
            colorMapMenu=False,
        )
        self.setCentralItem(self._bar)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._bar.axis.enableAutoSIPrefix(False)
        self.apply_theme(LIGHT)

    def sizeHint(self) -> QSize:  # noqa: N802
        return QSize(300, _BAR_PX + int(2.3 * self.fontMetrics().height()))

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        return QSize(160, self.sizeHint().height())

    def show_range(
        self, title: str, unit: str, levels: tuple[float, float], beyond: tuple[bool, bool] = (False, False)
    ) -> None:
        """Set title, unit and ends of the scale; `beyond`: whether values lie below and above the ends."""
        title = f"{title} ({unit})" if unit else title
        low, high = (
            f"{sign if there else ''}{level:.4g}"
            for sign, there, level in zip(("≤ ", "≥ "), beyond, levels, strict=True)
        )
        self._bar.setLevels(levels)
        self._bar.axis.setLabel(title)
        self.setAccessibleName(f"Colour bar: {title} from {low} to {high}")
        self.setToolTip(f"{title}: {low} at the left end, {high} at the right end")

    def set_map(self, colour_map: pyqtgraph.ColorMap) -> None:
        """Show another colour map."""
        self._bar.setColorMap(colour_map)

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self.setBackground(theme.window)
        for side in ("left", "right", "top", "bottom"):
            self._bar.getAxis(side).setPen(theme.grid)
            self._bar.getAxis(side).setTextPen(theme.text)
