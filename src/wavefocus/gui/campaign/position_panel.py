"""Details of one position: plots and quality; and the drift of the sentinel position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QTabWidget, QWidget

from wavefocus.config.run import DriftLimits
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import CampaignModel
from wavefocus.gui.field_map import Plot, Real, whole_ticks
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.tab import TabContext
from wavefocus.storage.units import quantity

if TYPE_CHECKING:
    from wavefocus.acquisition.limits import DriftPoint


# Height of the largest response, in steps between actuators.
_STEP = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Greens:
    """Green's functions (actuators, taps) of a bank row."""

    position: int
    green: Real


class GreenPlot(Plot):
    """Green's functions of all actuators, one above the other."""

    def __init__(self) -> None:
        super().__init__("Green's functions", "time (ms)", "actuator")

    def show_green(self, surface: PlotSurface, greens: Greens, actuator: int) -> None:
        """Draw; `actuator` is emphasised, -1 for none."""
        plot = self.getPlotItem()
        plot.clear()
        green = greens.green
        largest = float(np.abs(green).max(initial=0.0))
        if largest == 0:
            self.title(f"position {greens.position} is not measured", faint=True)
            return
        time_ms = np.arange(green.shape[1]) / surface.sample_rate_hz * 1e3
        for number, trace in enumerate(green):
            chosen = number == actuator
            colour = self.theme.fault if chosen else self.theme.traces[0]
            self.line(time_ms, number + _STEP * trace / largest, colour, 1.6 if chosen else 1.0)
        peak = quantity(f"{largest:.3g}", surface.unit)
        self.title(f"position {greens.position}: largest {peak} = {_STEP:g} of a step")
        plot.getAxis("left").setTicks([whole_ticks(len(green)), []])
        plot.setXRange(0.0, float(time_ms[-1]), padding=0.01)
        plot.setYRange(-1.0, len(green), padding=0.0)


class SpectrumPlot(Plot):
    """Transfer functions of all actuators, in decibels, with the measured band."""

    def __init__(self) -> None:
        super().__init__("Spectrum", "frequency (Hz); dashed: the measured band", "level (dB)")

    def show_green(self, surface: PlotSurface, greens: Greens, actuator: int) -> None:
        """Draw all actuators, one of them emphasised, or their mean power where none is chosen."""
        plot = self.getPlotItem()
        plot.clear()
        plot.setLabel("left", f"level (dB re 1 {surface.unit})")
        spectrum = np.abs(np.fft.rfft(greens.green, axis=1))
        if not spectrum.any():
            self.title(f"position {greens.position} is not measured", faint=True)
            return
        frequency_hz = np.fft.rfftfreq(greens.green.shape[1], 1 / surface.sample_rate_hz)
        low_hz, high_hz = surface.band_hz or (0.0, float(frequency_hz[-1]))
        shown = frequency_hz <= min(1.3 * high_hz, frequency_hz[-1])
        frequency_hz, spectrum = frequency_hz[shown], np.maximum(spectrum[:, shown], 1e-12 * spectrum.max())
        for level in spectrum:
            self.line(frequency_hz, 20 * np.log10(level), self.theme.grid)
        if actuator >= 0:
            level, words = spectrum[actuator], f"actuator {actuator}"
        else:
            level, words = np.sqrt(np.mean(spectrum**2, axis=0)), "rms of all actuators; each in grey"
        level_db = 20 * np.log10(level)
        self.line(frequency_hz, level_db, self.theme.traces[0], 2.0)
        self.mark_band(low_hz, high_hz)
        self.title(f"position {greens.position}: {words}")
        in_band = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
        top_db = float(level_db[in_band].max()) if in_band.any() else float(level_db.max())
        plot.setXRange(0.0, float(frequency_hz[-1]), padding=0.01)
        plot.setYRange(top_db - 60.0, top_db + 12.0, padding=0.0)


class DriftPlot(QWidget):
    """Level, delay and correlation of the sentinel position over the clock."""

    def __init__(self) -> None:
        super().__init__()
        self.setAccessibleName("Drift of the sentinel position")
        labels = ("level (dB)", "delay (samples)", "1 − corr.")
        self.plots = [Plot(f"Drift: {one}", "clock", one.replace(" (", "<br>("), axis_px=96) for one in labels]
        for plot in self.plots:
            plot.setAxisItems({"bottom": pyqtgraph.DateAxisItem()})
            plot.setXLink(self.plots[0])
            if plot is not self.plots[-1]:  # they share the clock at the foot
                plot.getPlotItem().hideAxis("bottom")
        ui.column(*self.plots, owner=self, spacing=8)

    def show_drift(self, points: Sequence[DriftPoint], limits: DriftLimits) -> None:
        """Draw the points and the limits for a warning; those for a stop once a value is beyond the former."""
        at_s = np.array([point.at.timestamp() for point in points])
        rows = (
            [point.level_db for point in points],
            [point.delay_samples for point in points],
            [1 - point.correlation for point in points],
        )
        theme = self.plots[0].theme
        known = {"steady": ("o", theme.good), "warn": ("t", theme.warning)}
        looks = [known.get(point.verdict, ("x", theme.fault)) for point in points]
        warn_and_stop = (
            (limits.warn_level_db, limits.stop_level_db),
            (limits.warn_delay_samples, limits.stop_delay_samples),
            (1 - limits.warn_correlation, 1 - limits.stop_correlation),
        )
        for plot, values, ends in zip(self.plots, rows, warn_and_stop, strict=True):
            item = plot.getPlotItem()
            item.clear()
            largest = max((abs(value) for value in values if math.isfinite(value)), default=0.0)
            span = 1.15 * max(ends[0] if largest <= ends[0] else ends[1], largest)
            for end, colour in zip(ends, (theme.warning, theme.fault), strict=True):
                for limit in (end, -end) if plot is not self.plots[-1] else (end,):
                    if end <= span:
                        item.addLine(y=limit, pen=pyqtgraph.mkPen(colour, style=Qt.PenStyle.DashLine))
            plot.setYRange(-span if plot is not self.plots[-1] else -0.04 * span, span, padding=0)
            item.addLine(y=0.0, pen=pyqtgraph.mkPen(theme.grid))
            item.plot(at_s, np.array(values, dtype=float), pen=pyqtgraph.mkPen(theme.faint))
            marks = [
                {"pos": (x, y), "symbol": symbol, "brush": pyqtgraph.mkBrush(colour)}
                for x, y, (symbol, colour) in zip(at_s.tolist(), values, looks, strict=True)
                if math.isfinite(y)
            ]
            item.addItem(pyqtgraph.ScatterPlotItem(spots=marks, pen=None, size=8))
        self.plots[0].title(
            "● steady, ▼ warn, ✕ stop; dashed: limits"
            if points else "the sentinel position has not been measured again yet"
        )  # fmt: skip
        if points:
            room_s = max(60.0, 0.05 * float(at_s[-1] - at_s[0]))
            self.plots[0].setXRange(float(at_s[0]) - room_s, float(at_s[-1]) + room_s, padding=0)


_ACTUATORS = ("actuator", "SNR (dB)", "residual (dB)", "coherence", "peak (V)", "noise error (dB)")
# Follows from the bank and stands in none of its datasets.
_NOISE_ERROR = "noise_error_db"
# Figures of an actuator, and their decimals.
_FIGURES = {"snr_db": 1, "residual_db": 1, "coherence": 3, "peak_v": 3, _NOISE_ERROR: 1}
_ALL = "all actuators"

Details = tuple[Greens, dict[str, np.ndarray]]


class PositionPanel(QTabWidget):
    """Shows one position; files are read in the background."""

    def __init__(self, context: TabContext, campaign: CampaignModel) -> None:
        super().__init__()
        self.setDocumentMode(True)
        self.setAccessibleName("Details of the position")
        self._context, self._campaign = context, campaign
        self.position = -1
        self.greens: Greens | None = None
        self._drawn: dict[str, int] = {}
        self.green_plot, self.spectrum_plot, self.drift_plot = GreenPlot(), SpectrumPlot(), DriftPlot()
        self.actuator = ui.choice("Emphasised actuator", "Emphasised actuator of both plots", [_ALL])
        self.actuators = ui.table(_ACTUATORS, "Quality per actuator", stretched=range(len(_ACTUATORS)))
        for page, title in (
            (self.green_plot, "Green's functions"),
            (self.spectrum_plot, "Spectrum"),
            (self.actuators, "Quality"),
            (self.drift_plot, "Drift"),
        ):
            self.addTab(page, title)
        self.setCornerWidget(self.actuator)
        self.actuator.currentIndexChanged.connect(self._draw_plots)
        self.show_position(-1)

    def show_position(self, position: int) -> None:
        """Show a position; -1 for none."""
        self.position, self._commits = position, self._campaign.commits.get(position, 0)
        surface = self._campaign.surface
        if surface is None or not 0 <= position < surface.positions:
            self.greens = None
            self._context.settle("position")
            self._clear("click a position on the map")
            return
        if self.greens is None:
            self._clear(f"reading position {position}…")
        self._context.background.ask("position", partial(_read, surface.bank, position), self._show, self._failed)

    def draw(self) -> None:
        # Noted first: a failure to draw is reported once, not twenty times a second.
        before, revision = self._drawn, dict(self._campaign.revision)
        self._drawn = revision
        surface = self._campaign.surface
        if before.get("surface") != revision["surface"]:
            names = [f"actuator {number}" for number in range(surface.actuators if surface else 0)]
            ui.fill_choice(self.actuator, [_ALL, *names])
        if self.position >= 0 and self._commits != self._campaign.commits.get(self.position, 0):
            self.show_position(self.position)
        if before.get("drift") != revision["drift"] or before.get("surface") != revision["surface"]:
            self.drift_plot.show_drift(self._campaign.drift, surface.drift_limits if surface else DriftLimits())

    def _show(self, details: Details) -> None:
        self._context.settle("position")
        self.greens, quality = details
        self._draw_plots()
        count = self.greens.green.shape[0]
        self.actuators.setRowCount(count)
        for actuator in range(count):
            numbers = [
                _text(float(quality[key][actuator]) if key in quality else math.nan, digits)
                for key, digits in _FIGURES.items()
            ]
            ui.fill_row(self.actuators, actuator, (str(actuator), *numbers))

    def _failed(self, failure: Exception) -> None:
        self.greens = None
        self._clear(f"position {self.position} cannot be read")
        self._context.report_failure(failure, topic="position")

    def _draw_plots(self) -> None:
        surface = self._campaign.surface
        if surface is not None and self.greens is not None:
            for plot in (self.green_plot, self.spectrum_plot):
                plot.show_green(surface, self.greens, self.actuator.currentIndex() - 1)

    def _clear(self, words: str) -> None:
        for plot in (self.green_plot, self.spectrum_plot):
            plot.getPlotItem().clear()
            plot.title(words, faint=True)
        self.actuators.setRowCount(0)


def _read(path: Path, position: int) -> Details:
    from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
    from wavefocus.storage.bank.reading import open_bank  # h5py is slow to import

    with open_bank(path) as bank:
        quality = {key: bank.quality[key][position] for key in _FIGURES if key in bank.quality}
        if (error_db := bank_noise_error_db(bank)) is not None:
            quality[_NOISE_ERROR] = error_db[position]
        return Greens(position, bank.green(position)), quality


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
