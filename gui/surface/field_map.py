"""A field over the surface at one instant: one value per position as a colour."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyqtgraph
from numpy.typing import NDArray

from gui.shell.theme import Theme
from gui.surface.colours import magnitude_map, signed_map
from gui.surface.surface import Float64Array, Surface
from gui.surface.view import SurfaceView, looked_up


class FieldMap(SurfaceView):
    """One value per position as a colour; new values of 1500 positions are drawn in about a millisecond."""

    levels = (-1.0, 1.0)
    signed = True
    _unit = ""

    def __init__(self, name: str) -> None:
        self.values: Float64Array = np.zeros(0)
        super().__init__(name)

    @property
    def colour_map(self) -> pyqtgraph.ColorMap:
        """The map that its colour bar shows."""
        return signed_map(self.theme) if self.signed else magnitude_map()

    def show_surface(self, surface: Surface | None) -> None:
        self.values = np.zeros(0)
        super().show_surface(surface)

    def show_scale(self, levels: tuple[float, float], unit: str, *, signed: bool) -> None:
        """Set the values at the ends of the colours; a signed scale has zero in its middle."""
        self.levels, self._unit, self.signed = levels, unit, signed
        self.show_values(self.values)

    def show_values(self, values: NDArray[np.floating[Any]]) -> None:
        """Colour the positions; NaN where there is no value."""
        self.values = np.asarray(values, np.float64)
        if self.surface is not None and len(values) == self.surface.positions:
            self.paint(looked_up(self.colour_map, self.values, self.levels, self.theme.cell))

    def apply_theme(self, theme: Theme) -> None:
        super().apply_theme(theme)
        self.show_values(self.values)

    def position_text(self, position: int) -> str:
        assert self.surface is not None
        x_mm, y_mm = self.surface.position_mm[position]
        value = self.values[position] if position < len(self.values) else np.nan
        text = f"{value:.3g} {self._unit}".rstrip() if np.isfinite(value) else "no value"
        return f"{self.name} at ({x_mm:.1f}, {y_mm:.1f}) mm: {text}"
