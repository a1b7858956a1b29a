"""The plot that all tabs use."""

from __future__ import annotations

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt

from gui.shell.theme import LIGHT, Theme, theme_axes

Real = NDArray[np.float32] | NDArray[np.float64]

# More columns than a screen has pixels show nothing more.
MOST_COLUMNS = 2000


class Plot(pyqtgraph.PlotWidget):
    """A plot in the theme's colours without menu or buttons.

    Parameters
    ----------
    name : str
        Its accessible name.
    bottom, left : str
        Labels of the axes.
    legend_at : tuple of int, optional
        Where a legend lies, in pixels from the corner; without one, lines need no name.
    """

    def __init__(self, name: str, bottom: str, left: str, legend_at: tuple[int, int] | None = None) -> None:
        super().__init__(enableMenu=False)
        self.setAccessibleName(name)
        self.theme = LIGHT
        plot = self.getPlotItem()
        self._legend = None if legend_at is None else plot.addLegend(offset=legend_at)
        plot.setLabel("bottom", bottom)
        plot.setLabel("left", left)
        plot.hideButtons()
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.setToolTip("Wheel: zoom. Drag: pan. Double click: show everything.")

    def mouseDoubleClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Show everything again."""
        super().mouseDoubleClickEvent(event)
        self.getPlotItem().getViewBox().autoRange()

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self.theme = theme
        self.setBackground(theme.base)
        theme_axes(self.getPlotItem(), theme)
        if self._legend is not None:
            self._legend.setLabelTextColor(theme.text)

    def line(self, x: Real, y: Real, colour: str, width: float = 1.0, name: str | None = None) -> None:
        """Draw a line, thinned to what can be seen without losing a peak; `name` for the legend."""
        x, y = thinned(x, y)
        self.getPlotItem().plot(x, y, pen=pyqtgraph.mkPen(colour, width=width), name=name, antialias=True)

    def mark_band(self, low_hz: float, high_hz: float) -> None:
        """Draw the ends of a band, dashed."""
        pen = pyqtgraph.mkPen(self.theme.faint, style=Qt.PenStyle.DashLine)
        for edge_hz in (low_hz, high_hz):
            self.getPlotItem().addItem(pyqtgraph.InfiniteLine(edge_hz, pen=pen))


def thinned(x: Real, y: Real) -> tuple[Real, Real]:
    """Return the smallest and the largest value of each column of pixels, in the order of x."""
    step = len(y) // MOST_COLUMNS
    if step < 2:
        return x, y
    used = len(y) // step * step
    blocks = y[:used].reshape(-1, step)
    ends = np.sort(np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1), axis=1)
    kept = np.append((ends + np.arange(0, used, step)[:, None]).ravel(), np.arange(used, len(y)))
    return x[kept], y[kept]


def thinning_curve() -> pyqtgraph.PlotDataItem:
    """Return a curve that is thinned again at each zoom; it must stay in its plot."""
    return pyqtgraph.PlotDataItem(
        autoDownsample=True, downsampleMethod="peak", clipToView=True, skipFiniteCheck=True, antialias=True
    )


def whole_ticks(count: int, most: int = 12) -> list[tuple[float, str]]:
    """Return ticks at whole numbers from 0 on, as many as have room."""
    return [(float(one), str(one)) for one in range(0, count, max(1, -(-count // most)))]
