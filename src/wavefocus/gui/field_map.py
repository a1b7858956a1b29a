"""The plot of all tabs; colours of fields: maps, units, the colour bar, and the map of a field at one instant."""

import math
from typing import Any

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QFrame, QSizePolicy

from wavefocus.gui.surface_view import SurfaceView, map_colours
from wavefocus.gui.theme import Theme, Themed, theme_axes
from wavefocus.rendering.arrays import Float64Array

Real = NDArray[np.float32] | NDArray[np.float64]


_MOST_TICKS = 12


class Plot(Themed, pyqtgraph.PlotWidget):
    """A plot in the theme's colours without menu or buttons.

    name: Its accessible name.
    bottom, left: Labels of the axes.
    legend_at: Where a legend lies, in pixels from the corner; without one, lines need no name.
    axis_px: Width of the left axis, where plots above one another are to have the same.
    """

    _empty = False

    def __init__(
        self, name: str, bottom: str, left: str, legend_at: tuple[int, int] | None = None, axis_px: int | None = None
    ) -> None:
        super().__init__(enableMenu=False)
        self.setAccessibleName(name)
        plot = self.getPlotItem()
        if legend_at is not None:
            plot.addLegend(offset=legend_at, brush=self.theme.base)
        plot.setLabel("bottom", bottom)
        plot.setLabel("left", left)
        if axis_px is not None:
            plot.getAxis("left").setWidth(axis_px)
        plot.hideButtons()
        # Lines are thinned to what can be seen, with their peaks: noise is painted a hundred times faster.
        plot.setDownsampling(auto=True, mode="peak")
        self.setToolTip("Wheel: zoom. Drag: pan. Double click: show everything.")
        theme_axes(plot)

    def mouseDoubleClickEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        super().mouseDoubleClickEvent(event)
        plot = self.getPlotItem()
        clips = plot.clipToViewMode()
        plot.setClipToView(False)  # else what is in view counts as everything
        plot.getViewBox().autoRange()
        plot.setClipToView(clips)

    def title(self, words: str, *, faint: bool = False, size: str | None = None) -> None:
        """Set the line above the plot; a faint one says why it is empty, and then there are no axes."""
        colour = self.theme.faint if faint else self.theme.text
        for side in ("left", "bottom") if faint != self._empty else ():  # an axis may be hidden for good
            self.getPlotItem().showAxis(side, not faint)
        self._empty = faint
        self.getPlotItem().setTitle(words or None, color=colour, **({} if size is None else {"size": size}))

    def line(
        self, x: Real, y: Real, colour: str, width: float = 1.0, name: str | None = None
    ) -> pyqtgraph.PlotDataItem:
        """Draw a line and return it; `name` for the legend."""
        return self.getPlotItem().plot(x, y, pen=pyqtgraph.mkPen(colour, width=width), name=name)

    def stack(self, x: Real, rows: Real, room: float) -> float:
        """Draw rows one above the other, the largest value `room` of a step high; return that value."""
        largest, lines = float(np.abs(rows).max(initial=0.0)), self.getPlotItem().listDataItems()
        if len(lines) != len(rows):
            self.getPlotItem().clear()
            lines = [self.line(x[:0], x[:0], self.theme.traces[0]) for _ in rows]
        for number, (line, row) in enumerate(zip(lines, rows, strict=True)):
            line.setData(x, number + room / (largest or 1.0) * row)  # a new line takes five times as long
        every = max(1, -(-len(rows) // _MOST_TICKS))
        ticks = [(float(number), str(number)) for number in range(0, len(rows), every)]
        self.getPlotItem().getAxis("left").setTicks([ticks, []])
        self.getPlotItem().setYRange(-1.0, len(rows), padding=0.0)
        return largest

    def mark_band(self, low_hz: float, high_hz: float) -> None:
        pen = pyqtgraph.mkPen(self.theme.faint, style=Qt.PenStyle.DashLine)
        for edge_hz in (low_hz, high_hz):
            self.getPlotItem().addItem(pyqtgraph.InfiniteLine(edge_hz, pen=pen))


# Blue and orange differ for every kind of colour vision, and in brightness from the middle on. In the dark theme the
# middle is dark, so that a surface at rest does not shine.
_ON_LIGHT = ("#08306b", "#3f7fb8", "#a9cbe6", "#f7f7f5", "#f5c08a", "#d0712a", "#7a2f04")
_ON_DARK = ("#c6e6ff", "#5fb0ea", "#2b648f", "#1f2429", "#8d5420", "#e89440", "#ffe3bd")
# Units that take a prefix; those of other banks are shown as they are.
_WITH_PREFIX = ("m/s", "m", "m/s²", "m/s^2", "V", "Pa")


def _signed_map(theme: Theme) -> pyqtgraph.ColorMap:
    """Return the map from negative (blue) over zero (the window's base colour) to positive (orange)."""
    colours = _ON_DARK if theme.name == "dark" else _ON_LIGHT
    return pyqtgraph.ColorMap(np.linspace(0.0, 1.0, len(colours)), list(colours))


def scaled_unit(unit: str, largest: float) -> tuple[float, str]:
    """Return the factor and the prefixed unit that make the largest value of a scale at least 0.1."""
    if unit not in _WITH_PREFIX or not (math.isfinite(largest) and largest > 0.0):
        return 1.0, unit
    factor, prefix = pyqtgraph.siScale(10.0 * largest)
    return factor, prefix + unit


# An AxisItem draws its caption so far below its own edge.
_CAPTION_BELOW_PX = 5


class ColourBar(Themed, pyqtgraph.GraphicsView):
    """A horizontal `pyqtgraph.ColorBarItem` with a title."""

    def __init__(self, colour_map: pyqtgraph.ColorMap) -> None:
        super().__init__()
        fixed = {"interactive": False, "colorMapMenu": False}
        self._bar = pyqtgraph.ColorBarItem((0.0, 1.0), 12, colour_map, orientation="h", **fixed)
        self.setCentralItem(self._bar)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMinimumWidth(160)
        self.setBackground(self.theme.window)
        theme_axes(self._bar)
        self._fit()

    def show_range(self, title: str, unit: str, levels: tuple[float, float]) -> None:
        """Set title, unit and ends of the scale."""
        title = f"{title} ({unit})" if unit else title
        self._bar.setLevels(levels)
        self._bar.axis.setLabel(title)
        self._fit()
        self.setAccessibleName("Colour bar: {} from {:.4g} to {:.4g}".format(title, *levels))

    def _fit(self) -> None:
        self.setFixedHeight(
            math.ceil(self._bar.effectiveSizeHint(Qt.SizeHint.MinimumSize).height()) + _CAPTION_BELOW_PX
        )


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
        self._colour_map = _signed_map(self.theme)
        self.bar = ColourBar(self._colour_map)

    def show_scale(self, title: str, largest: float, unit: str) -> None:
        """Set what the colours mean; values are shown anew by the owner.

        title: Of the colour bar.
        largest: Value in `unit` at the ends of the colours; zero is in the middle, also for a field silent everywhere.
        """
        end = largest if np.isfinite(largest) and largest > 0.0 else 1.0
        self._factor, self._unit = scaled_unit(unit, end)
        self.levels = -self._factor * end, self._factor * end
        self.bar.show_range(title, self._unit, self.levels)

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
