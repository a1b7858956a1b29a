"""Colour maps of fields: signed values by a map with a quiet middle, magnitudes by cividis; safe for any eyes."""

from __future__ import annotations

import numpy as np
import pyqtgraph

from gui.shell.theme import Theme

# Blue and orange differ for every kind of colour vision, and in brightness from the middle on. On a dark window the
# middle is dark: what is at rest must not be what shines.
_ON_LIGHT = ("#08306b", "#3f7fb8", "#a9cbe6", "#f7f7f5", "#f5c08a", "#d0712a", "#7a2f04")
_ON_DARK = ("#c6e6ff", "#5fb0ea", "#2b648f", "#1f2429", "#8d5420", "#e89440", "#ffe3bd")


def signed_map(theme: Theme) -> pyqtgraph.ColorMap:
    """From negative (blue) over zero (as quiet as the window) to positive (orange)."""
    colours = _ON_DARK if theme.name == "dark" else _ON_LIGHT
    return pyqtgraph.ColorMap(np.linspace(0.0, 1.0, len(colours)), list(colours))


def magnitude_map() -> pyqtgraph.ColorMap:
    """From small (dark) to large (bright)."""
    return pyqtgraph.colormap.get("cividis")


def symmetric_levels(largest: float) -> tuple[float, float]:
    """Ends of a scale with zero in its middle; a field that is silent everywhere gets one, too."""
    limit = largest if np.isfinite(largest) and largest > 0.0 else 1.0
    return -limit, limit
