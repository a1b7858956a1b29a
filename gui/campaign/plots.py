"""Plots of one position: Green's functions, spectrum, raw recordings; and the drift of the sentinel position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QRectF
from PyQt5.QtWidgets import QWidget

from gui.shell.theme import Theme
from gui.shell.widgets import column
from gui.surface.plot import MOST_COLUMNS, Plot, Real, whole_ticks
from gui.surface.surface import Surface
from storage.units import quantity

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint
    from storage.raw.reading import Recordings

_FLOOR_DB = -60.0


@dataclass(frozen=True, slots=True, eq=False)
class Greens:
    """Green's functions (actuators, taps) of a bank row."""

    position: int
    green: Real


class GreenPlot(Plot):
    """Green's functions of all actuators, stacked as traces or as a waterfall in decibels."""

    def __init__(self) -> None:
        super().__init__("Green's functions", "time (ms)", "actuator")
        self._image = pyqtgraph.ImageItem(axisOrder="row-major")
        self._image.setColorMap(pyqtgraph.colormap.get("viridis"))

    def show_green(
        self, surface: Surface, greens: Greens, actuator: int, *, waterfall: bool, own_scale: bool = False
    ) -> None:
        """Draw; `actuator` is emphasised, -1 for none; with `own_scale`, each trace fills its step."""
        plot = self.getPlotItem()
        plot.clear()
        green = greens.green
        largest = float(np.abs(green).max(initial=0.0))
        time_ms = np.arange(green.shape[1]) / surface.sample_rate_hz * 1e3
        title = f"position {greens.position}: largest {quantity(f'{largest:.3g}', surface.unit)}"
        if largest == 0:
            plot.setTitle(f"position {greens.position} is not measured", color=self.theme.faint)
            return
        if waterfall:
            level_db = 20 * np.log10(np.maximum(np.abs(_columns(green)) / largest, 10 ** (_FLOOR_DB / 20)))
            self._image.setImage(level_db, levels=(_FLOOR_DB, 0.0))
            self._image.setRect(QRectF(0.0, -0.5, float(time_ms[-1]), float(len(green))))
            plot.addItem(self._image)
            plot.setTitle(f"{title} = 0 dB, dark is {_FLOOR_DB:.0f} dB", color=self.theme.text)
        else:
            peaks = np.abs(green).max(axis=1)
            scales = np.where(peaks > 0, peaks, 1.0) if own_scale else np.full(len(green), largest)
            for number, (trace, scale) in enumerate(zip(green, scales, strict=True)):
                chosen = number == actuator
                colour = self.theme.fault if chosen else self.theme.traces[0]
                self.line(time_ms, number + 0.9 * trace / scale, colour, 1.6 if chosen else 1.0)
            told = f"; each to its own peak, the least {float(peaks.min()):.3g}" if own_scale else " = 0.9 of a step"
            plot.setTitle(f"{title}{told}", color=self.theme.text)
        plot.getAxis("left").setTicks([whole_ticks(len(green)), []])
        plot.setXRange(0.0, float(time_ms[-1]), padding=0.01)
        plot.setYRange(-1.0, len(green), padding=0.0)


class SpectrumPlot(Plot):
    """Transfer functions of all actuators, in decibels, with the measured band."""

    def __init__(self) -> None:
        super().__init__("Spectrum", "frequency (Hz); dashed: the measured band", "level (dB)")

    def show_green(self, surface: Surface, greens: Greens, actuator: int) -> None:
        """Draw all actuators, one of them emphasised, or their mean power where none is chosen."""
        plot = self.getPlotItem()
        plot.clear()
        plot.setLabel("left", f"level (dB re 1 {surface.unit})")
        spectrum = np.abs(np.fft.rfft(greens.green, axis=1))
        if not spectrum.any():
            plot.setTitle(f"position {greens.position} is not measured", color=self.theme.faint)
            return
        frequency_hz = np.fft.rfftfreq(greens.green.shape[1], 1 / surface.sample_rate_hz)
        low_hz, high_hz = surface.band_hz or (0.0, float(frequency_hz[-1]))
        shown = frequency_hz <= min(1.3 * high_hz, frequency_hz[-1])
        frequency_hz, spectrum = frequency_hz[shown], np.maximum(spectrum[:, shown], 1e-12 * spectrum.max())
        for level in spectrum:
            self.line(frequency_hz, 20 * np.log10(level), self.theme.grid)
        if actuator >= 0:
            level, told = spectrum[actuator], f"actuator {actuator}"
        else:
            level, told = np.sqrt(np.mean(spectrum**2, axis=0)), "rms of all actuators; each in grey"
        level_db = 20 * np.log10(level)
        self.line(frequency_hz, level_db, self.theme.traces[0], 2.0)
        self.mark_band(low_hz, high_hz)
        plot.setTitle(f"position {greens.position}: {told}", color=self.theme.text)
        in_band = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        top_db = float(level_db[in_band].max()) if in_band.any() else float(level_db.max())
        plot.setXRange(0.0, float(frequency_hz[-1]), padding=0.01)
        plot.setYRange(top_db - 60.0, top_db + 12.0, padding=0.0)


class RecordingPlot(Plot):
    """The two DAQ channels of one record."""

    def __init__(self) -> None:
        super().__init__("Raw recordings", "time (s)", "input (V)", legend_at=(-10, 10))

    def show_record(self, recordings: Recordings, record: int, sample_rate_hz: float, position: int) -> None:
        plot = self.getPlotItem()
        plot.clear()
        reference, response = recordings.reference_v[record], recordings.response_v[record]
        time_s = np.arange(len(reference)) / sample_rate_hz
        for name, values, colour in (
            ("reference", reference, self.theme.grid),
            ("response", response, self.theme.traces[0]),
        ):
            self.line(time_s, values, colour, 1.2, name)
        plot.setTitle(
            f"position {position}, record {record}: response up to {float(np.abs(response).max()):.3g} V of "
            f"{recordings.range_v[1]:g} V",
            color=self.theme.text,
        )
        plot.getViewBox().autoRange()


class DriftPlot(QWidget):
    """Level, delay and correlation of the sentinel position over the clock."""

    def __init__(self) -> None:
        super().__init__()
        self.setAccessibleName("Drift of the sentinel position")
        self.plots = [
            Plot(f"Drift: {label}", "clock", label) for label in ("level (dB)", "delay (samples)", "1 − corr.")
        ]
        for plot in self.plots:
            plot.setAxisItems({"bottom": pyqtgraph.DateAxisItem()})
            plot.setXLink(self.plots[0])
            if plot is not self.plots[-1]:  # they share the clock at the foot
                plot.getPlotItem().hideAxis("bottom")
            plot.getPlotItem().getAxis("left").setWidth(96)
        column(*self.plots, owner=self).setSpacing(8)

    def apply_theme(self, theme: Theme) -> None:
        for plot in self.plots:
            plot.apply_theme(theme)

    def show_drift(self, points: Sequence[DriftPoint]) -> None:
        at_s = np.array([point.at.timestamp() for point in points])
        rows = (
            [point.level_db for point in points],
            [point.delay_samples for point in points],
            [1 - point.correlation for point in points],
        )
        theme = self.plots[0].theme
        colours = {"steady": theme.good, "warn": theme.warning}
        symbols = {"steady": "o", "warn": "t"}
        for plot, values in zip(self.plots, rows, strict=True):
            item = plot.getPlotItem()
            item.clear()
            item.addLine(y=0.0, pen=pyqtgraph.mkPen(theme.grid))
            item.plot(at_s, np.array(values, dtype=float), pen=pyqtgraph.mkPen(theme.faint))
            marks = [
                {
                    "pos": (x, y),
                    "symbol": symbols.get(point.verdict, "x"),
                    "brush": pyqtgraph.mkBrush(colours.get(point.verdict, theme.fault)),
                }
                for x, y, point in zip(at_s.tolist(), values, points, strict=True)
                if math.isfinite(y)
            ]
            item.addItem(pyqtgraph.ScatterPlotItem(spots=marks, pen=None, size=8))
        told = "" if points else "the sentinel position has not been measured again yet"
        self.plots[0].getPlotItem().setTitle(told or "circle: steady, triangle: warn, cross: stop", color=theme.text)
        if points:
            room_s = max(60.0, 0.05 * float(at_s[-1] - at_s[0]))
            self.plots[0].setXRange(float(at_s[0]) - room_s, float(at_s[-1]) + room_s, padding=0)


def _columns(green: Real) -> Real:
    """The largest magnitude of each column of pixels."""
    step = max(1, green.shape[1] // MOST_COLUMNS)
    used = green.shape[1] // step * step
    largest: Real = np.abs(green[:, :used]).reshape(len(green), -1, step).max(axis=2)
    return largest
