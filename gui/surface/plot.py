"""A plot that looks and behaves alike in every tab."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray

from gui.theme import LIGHT, Theme, dress_axes

Real = NDArray[np.float32] | NDArray[np.float64]

# More columns than a screen has pixels show nothing more.
MOST_COLUMNS = 2000


class Plot(pyqtgraph.PlotWidget):
    """A plot that takes the theme's colours and has its tools on the mouse alone."""

    def __init__(self, name: str, bottom: str, left: str) -> None:
        super().__init__(enableMenu=False)
        self.setAccessibleName(name)
        self.theme = LIGHT
        plot = self.getPlotItem()
        plot.setLabel("bottom", bottom)
        plot.setLabel("left", left)
        plot.hideButtons()
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.setToolTip("Wheel: zoom. Drag: move. Double click: everything.")

    def mouseDoubleClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Show everything again."""
        super().mouseDoubleClickEvent(event)
        self.getPlotItem().getViewBox().autoRange()

    def dress(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.theme = theme
        self.setBackground(theme.base)
        dress_axes(self.getPlotItem(), theme)

    def line(self, x: Real, y: Real, colour: str, width: float = 1.0) -> None:
        """Draw a line, thinned to what can be seen without losing a peak."""
        x, y = thinned(x, y)
        self.getPlotItem().plot(x, y, pen=pyqtgraph.mkPen(colour, width=width))


def thinned(x: Real, y: Real) -> tuple[Real, Real]:
    """Smallest and largest value of each column of pixels; the line looks the same and draws quickly."""
    step = len(y) // MOST_COLUMNS
    if step < 2:
        return x, y
    used = len(y) // step * step
    blocks = y[:used].reshape(-1, step)
    both = np.asarray(np.stack([blocks.min(axis=1), blocks.max(axis=1)], axis=1).reshape(-1), np.float64)
    twice = np.asarray(np.repeat(x[:used:step], 2), np.float64)
    return twice, both
