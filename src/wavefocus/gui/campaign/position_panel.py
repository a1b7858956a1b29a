"""Details of one position: plots and quality; and the drift of the sentinel position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import pyqtgraph
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QTabWidget, QWidget

from wavefocus.config.messages.campaign import Drift
from wavefocus.config.run import DriftLimits
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import CampaignModel
from wavefocus.gui.field_map import Plot, Real
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.tab import TabContext
from wavefocus.storage.units import quantity

# Height of the largest response, in steps between actuators.
_STEP = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class _Greens:
    """Green's functions (actuators, taps) of a bank row, and its quality figures per actuator."""

    position: int
    green: Real
    quality: Mapping[str, np.ndarray]


def _draw_greens(plot: Plot, surface: PlotSurface, greens: _Greens) -> None:
    """Draw Green's functions one above the other."""
    time_ms = np.arange(greens.green.shape[1]) / surface.sample_rate_hz * 1e3
    largest = plot.stack(time_ms, greens.green, _STEP)
    peak = quantity(f"{largest:.3g}", surface.unit)
    plot.title(f"position {greens.position}: largest {peak} = {_STEP:g} of a step")
    plot.getPlotItem().setXRange(0.0, float(time_ms[-1]), padding=0.01)


def _draw_spectrum(plot: Plot, surface: PlotSurface, greens: _Greens) -> None:
    """Draw the transfer functions in decibels, and their mean power."""
    item = plot.getPlotItem()
    item.setLabel("left", f"level (dB re 1 {surface.unit})")
    spectrum = np.abs(np.fft.rfft(greens.green, axis=1))
    frequency_hz = np.fft.rfftfreq(greens.green.shape[1], 1 / surface.sample_rate_hz)
    low_hz, high_hz = surface.band_hz or (0.0, float(frequency_hz[-1]))
    shown = frequency_hz <= min(1.3 * high_hz, frequency_hz[-1])
    frequency_hz, spectrum = frequency_hz[shown], np.maximum(spectrum[:, shown], 1e-12 * spectrum.max())
    for level in spectrum:
        plot.line(frequency_hz, 20 * np.log10(level), plot.theme.grid)
    level_db = 20 * np.log10(np.sqrt(np.mean(spectrum**2, axis=0)))
    plot.line(frequency_hz, level_db, plot.theme.traces[0], 2.0)
    plot.mark_band(low_hz, high_hz)
    plot.title(f"position {greens.position}: rms of all actuators; each in grey")
    in_band = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    top_db = float(level_db[in_band].max(initial=level_db.min()))
    item.setXRange(0.0, float(frequency_hz[-1]), padding=0.01)
    item.setYRange(top_db - 60.0, top_db + 12.0, padding=0.0)


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

    def show_drift(self, points: Sequence[tuple[datetime, Drift]], limits: DriftLimits) -> None:
        """Draw the points, and the limits at which a campaign stops once a value comes near; a step is only marked."""
        at_s, theme, last = np.array([at.timestamp() for at, _ in points]), self.plots[0].theme, self.plots[-1]
        known = {"steady": ("o", theme.good), "warn": ("t", theme.warning)}
        looks = [known.get(drift.verdict, ("x", theme.fault)) for _, drift in points]
        rows = (
            ([drift.level_db for _, drift in points], limits.stop_level_db),
            ([drift.delay_samples for _, drift in points], limits.stop_delay_samples),
            ([1 - drift.correlation for _, drift in points], 1 - limits.stop_correlation),
        )
        for plot, (numbers, stop) in zip(self.plots, rows, strict=True):
            item, values = plot.getPlotItem(), np.array(numbers, dtype=float)
            item.clear()
            largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
            span = 1.15 * max(stop if largest > 0.25 * stop else 0.25 * stop, largest)
            for limit in (stop, -stop)[: 1 if plot is last else 2]:
                if stop <= span:
                    item.addLine(y=limit, pen=pyqtgraph.mkPen(theme.fault, style=Qt.PenStyle.DashLine))
            plot.setYRange(-span if plot is not last else -0.04 * span, span, padding=0)
            item.addLine(y=0.0, pen=pyqtgraph.mkPen(theme.grid))
            plot.line(at_s, values, theme.faint)
            marks = [
                {"pos": at, "symbol": symbol, "brush": pyqtgraph.mkBrush(colour)}
                for at, (symbol, colour) in zip(zip(at_s, values, strict=True), looks, strict=True)
                if math.isfinite(at[1])
            ]
            item.addItem(pyqtgraph.ScatterPlotItem(spots=marks, pen=None, size=8))
        none = "the sentinel position has not been measured again yet"
        self.plots[0].title("● steady, ▼ step (warn), ✕ stop; dashed: limits of a stop" if points else none)
        if points:
            room_s = max(60.0, 0.05 * (at_s[-1] - at_s[0]))
            self.plots[0].setXRange(at_s[0] - room_s, at_s[-1] + room_s, padding=0)


# Figures of an actuator, with the title of their column and their decimals; the last one stands in no dataset.
_FIGURES = {
    "snr_db": ("SNR (dB)", 1), "residual_db": ("residual (dB)", 1), "coherence": ("coherence", 3),
    "peak_v": ("peak (V)", 3), "noise_error_db": ("noise error (dB)", 1),
}  # fmt: skip


class PositionPanel(QTabWidget):
    """Shows one position; files are read in the background."""

    def __init__(self, context: TabContext, campaign: CampaignModel) -> None:
        super().__init__()
        self.setDocumentMode(True)
        self.setAccessibleName("Details of the position")
        self._context, self._campaign = context, campaign
        self.greens: _Greens | None = None
        self._drawn: tuple[PlotSurface | None, Sequence[tuple[datetime, Drift]]] | None = None
        self.green_plot = Plot("Green's functions", "time (ms)", "actuator")
        self.spectrum_plot = Plot("Spectrum", "frequency (Hz); dashed: the measured band", "level (dB)")
        self.drift_plot = DriftPlot()
        titles = ["actuator", *(title for title, _ in _FIGURES.values())]
        self.actuators = ui.table(titles, "Quality per actuator", stretched=(0,))
        self.addTab(self.green_plot, "Green's functions")
        self.addTab(self.spectrum_plot, "Spectrum")
        self.addTab(self.actuators, "Quality")
        self.addTab(self.drift_plot, "Drift")
        self.show_position(-1)

    def show_position(self, position: int) -> None:
        """Show a position; -1 for none."""
        self._position, self._commits = position, self._campaign.commits.get(position, 0)
        surface = self._campaign.surface
        if surface is None or not 0 <= position < surface.positions:
            self._context.settle("position")
            self._clear("no bank is open" if surface is None else "click a position on the map")
            return
        if self.greens is None:
            self._clear(f"reading position {position}…")
        self._context.background.ask("position", partial(_read, surface.bank, position), self._show, self._failed)

    def draw(self) -> None:
        campaign, surface = self._campaign, self._campaign.surface
        # Noted first: a failure to draw is reported once, not twenty times a second.
        before, self._drawn = self._drawn, (surface, campaign.drift)
        if self._position >= 0 and self._commits != campaign.commits.get(self._position, 0):
            self.show_position(self._position)
        if before is None or before[0] is not surface or before[1] is not campaign.drift:
            self.drift_plot.show_drift(campaign.drift, surface.drift_limits if surface else DriftLimits())

    def _show(self, greens: _Greens) -> None:
        surface = self._campaign.surface
        if surface is None:
            return
        self._context.settle("position")
        self.greens = greens
        for plot, draw in ((self.green_plot, _draw_greens), (self.spectrum_plot, _draw_spectrum)):
            plot.getPlotItem().clear()
            if greens.green.any():
                draw(plot, surface, greens)
            else:
                plot.title(f"position {greens.position} is not measured", faint=True)
        self.actuators.setRowCount(len(greens.green))
        for actuator in range(len(greens.green)):
            numbers = [
                "" if math.isnan(value := float(greens.quality[key][actuator])) else f"{value:.{digits}f}"
                for key, (_, digits) in _FIGURES.items()
            ]
            ui.fill_row(self.actuators, actuator, (str(actuator), *numbers))

    def _failed(self, failure: Exception) -> None:
        self._clear(f"position {self._position} cannot be read")
        self._context.report_failure(failure, topic="position")

    def _clear(self, words: str) -> None:
        self.greens = None
        for plot in (self.green_plot, self.spectrum_plot):
            plot.getPlotItem().clear()
            plot.title(words, faint=True)
        self.actuators.setRowCount(0)


def _read(path: Path, position: int) -> _Greens:
    from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
    from wavefocus.storage.bank.reading import open_bank  # h5py is slow to import

    with open_bank(path) as bank:
        missing = np.full(bank.actuators, np.nan)
        quality = {key: bank.quality[key][position] if key in bank.quality else missing for key in _FIGURES}
        if (error_db := bank_noise_error_db(bank)) is not None:
            quality["noise_error_db"] = error_db[position]
        return _Greens(position, bank.green(position), quality)
