"""The plot of all tabs; colours of fields: maps, units, the colour bar, and the map of a field at one instant."""

import math
from typing import Any

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QSize, Qt
from PyQt5.QtWidgets import QFrame, QSizePolicy

from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.surface_view import SurfaceView, map_colours
from wavefocus.gui.theme import Theme, Themed, theme_axes
from wavefocus.rendering.arrays import Float64Array

Real = NDArray[np.float32] | NDArray[np.float64]

# More columns than a screen has pixels show nothing more.
MAX_COLUMNS = 2000


class Plot(Themed, pyqtgraph.PlotWidget):
    """A plot in the theme's colours without menu or buttons.

    name: Its accessible name.
    bottom, left: Labels of the axes.
    legend_at: Where a legend lies, in pixels from the corner; without one, lines need no name.
    axis_px: Width of the left axis, where plots above one another are to have the same.
    """

    def __init__(
        self, name: str, bottom: str, left: str, legend_at: tuple[int, int] | None = None, axis_px: int | None = None
    ) -> None:
        super().__init__(enableMenu=False)
        self.setAccessibleName(name)
        plot = self.getPlotItem()
        self._legend = None if legend_at is None else plot.addLegend(offset=legend_at)
        plot.setLabel("bottom", bottom)
        plot.setLabel("left", left)
        if axis_px is not None:
            plot.getAxis("left").setWidth(axis_px)
        plot.hideButtons()
        for side in ("left", "bottom"):
            plot.getAxis(side).enableAutoSIPrefix(False)
        self.setToolTip("Wheel: zoom. Drag: pan. Double click: show everything.")
        self.setBackground(self.theme.base)
        theme_axes(plot)
        if self._legend is not None:
            self._legend.setLabelTextColor(self.theme.text)

    def mouseDoubleClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        super().mouseDoubleClickEvent(event)
        self.getPlotItem().getViewBox().autoRange()

    def title(self, words: str, *, faint: bool = False, size: str | None = None) -> None:
        """Set the line above the plot."""
        colour = self.theme.faint if faint else self.theme.text
        self.getPlotItem().setTitle(words, color=colour, **({} if size is None else {"size": size}))

    def line(self, x: Real, y: Real, colour: str, width: float = 1.0, name: str | None = None) -> None:
        """Draw a line, thinned to what can be seen without losing a peak; `name` for the legend."""
        x, y = decimate(x, y)
        self.getPlotItem().plot(x, y, pen=pyqtgraph.mkPen(colour, width=width), name=name)

    def mark_band(self, low_hz: float, high_hz: float) -> None:
        pen = pyqtgraph.mkPen(self.theme.faint, style=Qt.PenStyle.DashLine)
        for edge_hz in (low_hz, high_hz):
            self.getPlotItem().addItem(pyqtgraph.InfiniteLine(edge_hz, pen=pen))


def decimate(x: Real, y: Real) -> tuple[Real, Real]:
    """Return the smallest and the largest value of each column of pixels, in the order of x."""
    step = len(y) // MAX_COLUMNS
    if step < 2:
        return x, y
    used = len(y) // step * step
    blocks = y[:used].reshape(-1, step)
    ends = np.sort(np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1), axis=1)
    kept = np.append((ends + np.arange(0, used, step)[:, None]).ravel(), np.arange(used, len(y)))
    return x[kept], y[kept]


def decimating_curve() -> pyqtgraph.PlotDataItem:
    """Return a curve that is thinned again at each zoom; it must stay in its plot.

    Without antialiasing: noise over the height of a plot takes 0.03 s to paint instead of 3 s.
    """
    return pyqtgraph.PlotDataItem(autoDownsample=True, downsampleMethod="peak", clipToView=True, skipFiniteCheck=True)


def whole_ticks(count: int, most: int = 12) -> list[tuple[float, str]]:
    """Return ticks at whole numbers from 0 on, as many as have room."""
    return [(float(one), str(one)) for one in range(0, count, max(1, -(-count // most)))]


# Blue and orange differ for every kind of colour vision, and in brightness from the middle on. In the dark theme the
# middle is dark, so that a surface at rest does not shine.
_ON_LIGHT = ("#08306b", "#3f7fb8", "#a9cbe6", "#f7f7f5", "#f5c08a", "#d0712a", "#7a2f04")
_ON_DARK = ("#c6e6ff", "#5fb0ea", "#2b648f", "#1f2429", "#8d5420", "#e89440", "#ffe3bd")
# Units that take a prefix; those of other banks are shown as they are.
_WITH_PREFIX = ("m/s", "m", "m/s²", "m/s^2", "V", "Pa")
_PREFIXES = (("", 1.0), ("m", 1e3), ("µ", 1e6), ("n", 1e9), ("p", 1e12))


def signed_map(theme: Theme) -> pyqtgraph.ColorMap:
    """Return the map from negative (blue) over zero (the window's base colour) to positive (orange)."""
    colours = _ON_DARK if theme.name == "dark" else _ON_LIGHT
    return pyqtgraph.ColorMap(np.linspace(0.0, 1.0, len(colours)), list(colours))


def scaled_unit(unit: str, largest: float) -> tuple[float, str]:
    """Return the factor and the prefixed unit that make the largest value of a scale at least 0.1."""
    if unit not in _WITH_PREFIX or not (math.isfinite(largest) and largest > 0.0):
        return 1.0, unit
    prefix, factor = next((one for one in _PREFIXES if largest * one[1] >= 0.1), _PREFIXES[-1])
    return factor, prefix + unit


# An AxisItem draws its caption so far below its own edge.
_CAPTION_BELOW_PX = 5


class ColourBar(Themed, pyqtgraph.GraphicsView):
    """A horizontal `pyqtgraph.ColorBarItem` with a title."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        self._bar = pyqtgraph.ColorBarItem(
            values=(0.0, 1.0),
            width=12,
            colorMap=colour_map,
            interactive=False,
            orientation="h",
            colorMapMenu=False,
        )
        self.setCentralItem(self._bar)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self._bar.axis.enableAutoSIPrefix(False)
        self.setBackground(self.theme.window)
        theme_axes(self._bar)

    def sizeHint(self) -> QSize:  # noqa: N802
        needed = self._bar.effectiveSizeHint(Qt.SizeHint.MinimumSize).height()
        return QSize(300, math.ceil(needed) + _CAPTION_BELOW_PX)

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
        self.updateGeometry()
        self.setAccessibleName(f"Colour bar: {title} from {low} to {high}")
        self.setToolTip(f"{title}: {low} at the left end, {high} at the right end")


class FieldMap(SurfaceView):
    """One value per position as a colour, and the colour bar; 1500 new values are drawn in about a millisecond.

    `values` and `levels` are in the unit of the bar, which may have a prefix.
    """

    levels = (-1.0, 1.0)
    _unit = ""
    _factor = 1.0

    def __init__(self, name: str) -> None:
        self.values: Float64Array = np.zeros(0)
        super().__init__(name)
        self._colour_map = signed_map(self.theme)
        self.bar = ColourBar(self._colour_map)

    def show_surface(self, surface: PlotSurface | None) -> None:
        self.values = np.zeros(0)
        super().show_surface(surface)

    def show_scale(self, title: str, largest: float, unit: str) -> None:
        """Set what the colours mean; values are shown anew by the owner.

        title: Of the colour bar.
        largest: Value in `unit` at the ends of the colours; zero is in the middle, also for a field silent everywhere.
        """
        end = largest if np.isfinite(largest) and largest > 0.0 else 1.0
        self._factor, self._unit = scaled_unit(unit, end)
        self.levels = -self._factor * end, self._factor * end
        self.bar.show_range(title, self._unit, self.levels, (True, True))

    def show_values(self, values: NDArray[np.floating[Any]]) -> None:
        """Colour the positions by values in the scale's unit; NaN where there is no value."""
        self.values = self._factor * np.asarray(values, np.float64)
        if self.surface is not None and len(self.values) == self.surface.positions:
            self.paint(map_colours(self._colour_map, self.values, self.levels, self.theme.cell))

    def position_text(self, position: int) -> str:
        assert self.surface is not None
        x_mm, y_mm = self.surface.position_mm[position]
        value = self.values[position] if position < len(self.values) else np.nan
        text = f"{value:.3g} {self._unit}".rstrip() if np.isfinite(value) else "no value"
        return f"{self.name} at ({x_mm:.1f}, {y_mm:.1f}) mm: {text}"
