"""Details of one position: plots, quality, recordings; and the drift of the sentinel position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QRectF, Qt
from PyQt5.QtWidgets import QSizePolicy, QTabWidget, QWidget

from wavefocus.campaign.sidecar_files import raw_path
from wavefocus.config.limits import DriftLimits
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import CampaignModel, clock
from wavefocus.gui.campaign.quality import status_text
from wavefocus.gui.field_map import MAX_COLUMNS, Plot, Real, whole_ticks
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed
from wavefocus.storage.units import quantity

if TYPE_CHECKING:
    from wavefocus.acquisition.limits import DriftPoint
    from wavefocus.storage.raw.writer import Recordings


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
        self, surface: PlotSurface, greens: Greens, actuator: int, *, waterfall: bool, own_scale: bool = False
    ) -> None:
        """Draw; `actuator` is emphasised, -1 for none; with `own_scale`, each trace fills its step."""
        plot = self.getPlotItem()
        plot.clear()
        green = greens.green
        largest = float(np.abs(green).max(initial=0.0))
        time_ms = np.arange(green.shape[1]) / surface.sample_rate_hz * 1e3
        title = f"position {greens.position}: largest {quantity(f'{largest:.3g}', surface.unit)}"
        if largest == 0:
            self.title(f"position {greens.position} is not measured", faint=True)
            return
        if waterfall:
            level_db = 20 * np.log10(np.maximum(np.abs(_columns(green)) / largest, 10 ** (_FLOOR_DB / 20)))
            self._image.setImage(level_db, levels=(_FLOOR_DB, 0.0))
            self._image.setRect(QRectF(0.0, -0.5, float(time_ms[-1]), float(len(green))))
            plot.addItem(self._image)
            self.title(f"{title} = 0 dB, dark is {_FLOOR_DB:.0f} dB")
        else:
            peaks = np.abs(green).max(axis=1)
            scales = np.where(peaks > 0, peaks, 1.0) if own_scale else np.full(len(green), largest)
            for number, (trace, scale) in enumerate(zip(green, scales, strict=True)):
                chosen = number == actuator
                colour = self.theme.fault if chosen else self.theme.traces[0]
                self.line(time_ms, number + 0.9 * trace / scale, colour, 1.6 if chosen else 1.0)
            words = f"; each to its own peak, the least {float(peaks.min()):.3g}" if own_scale else " = 0.9 of a step"
            self.title(f"{title}{words}")
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


class RecordingPlot(Plot):
    """The two DAQ channels of one record."""

    def __init__(self) -> None:
        super().__init__("Raw recordings", "time (s)", "input (V)", legend_at=(-10, 10))

    def show_record(self, recordings: Recordings, record: int, sample_rate_hz: float, position: int) -> None:
        plot = self.getPlotItem()
        plot.clear()
        reference, response = recordings.reference_v[record], recordings.response_v[record]
        time_s = np.arange(len(reference)) / sample_rate_hz
        self.line(time_s, reference, self.theme.grid, 1.2, "reference")
        self.line(time_s, response, self.theme.traces[0], 1.2, "response")
        self.title(
            f"position {position}, record {record}: response up to {float(np.abs(response).max()):.3g} V of "
            f"{recordings.range_v[1]:g} V"
        )
        plot.getViewBox().autoRange()


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
            "circle: steady, triangle: warn, cross: stop; dashed: the limits"
            if points else "the sentinel position has not been measured again yet"
        )  # fmt: skip
        if points:
            room_s = max(60.0, 0.05 * float(at_s[-1] - at_s[0]))
            self.plots[0].setXRange(float(at_s[0]) - room_s, float(at_s[-1]) + room_s, padding=0)


def _columns(green: Real) -> Real:
    """The largest magnitude of each column of pixels."""
    step = max(1, green.shape[1] // MAX_COLUMNS)
    used = green.shape[1] // step * step
    largest: Real = np.abs(green[:, :used]).reshape(len(green), -1, step).max(axis=2)
    return largest


_ATTEMPTS = ("time", "attempt", "outcome", "SNR (dB)", "residual (dB)")
_ACTUATORS = ("actuator", "SNR (dB)", "residual (dB)", "coherence", "peak (V)", "noise error (dB)")
# Follows from the bank and stands in none of its datasets.
_NOISE_ERROR = "noise_error_db"
# Figures of an actuator, and their decimals.
_FIGURES = {"snr_db": 1, "residual_db": 1, "coherence": 3, "peak_v": 3, _NOISE_ERROR: 1}
_ALL = "all actuators"
_WATERFALL, _OWN_SCALE = 1, 2

Details = tuple[Greens, dict[str, np.ndarray]]
Raw = tuple["Recordings | None", float]


class PositionPanel(Themed, QTabWidget):
    """Shows one position; files are read in the background."""

    def __init__(self, context: TabContext, campaign: CampaignModel) -> None:
        super().__init__()
        self.setDocumentMode(True)
        self.setAccessibleName("Details of the position")
        self._context, self._campaign = context, campaign
        self.position = -1
        self.greens: Greens | None = None
        self.recordings: Recordings | None = None
        self._raw_rate_hz = 0.0
        self._drawn: dict[str, int] = {}
        self.green_plot, self.spectrum_plot = GreenPlot(), SpectrumPlot()
        self.recording_plot, self.drift_plot = RecordingPlot(), DriftPlot()
        word = "View of the Green's functions"
        self.view = ui.choice(word, word, ["stacked", "waterfall", "stacked, own scale"])
        self.actuator = ui.choice("Emphasised actuator", "Emphasised actuator", [_ALL])
        self._spectrum_actuator = ui.choice("Actuator of the spectrum", "Actuator of the spectrum", [_ALL])
        self._record = ui.whole_box("Record", "Record of this position, from 0", 0, 99, "record ")
        self._raw_text = ui.label(role="faint", wraps=True)
        self._raw_text.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self.attempts = ui.table(_ATTEMPTS, "Quality history of the position", stretched=(2,))
        self.attempts.setWordWrap(False)
        self.actuators = ui.table(_ACTUATORS, "Quality per actuator", stretched=range(len(_ACTUATORS)))
        self.addTab(_page(self.green_plot, self.view, self.actuator), "Green's functions")
        self.addTab(_page(self.spectrum_plot, self._spectrum_actuator), "Spectrum")
        self.addTab(ui.stacked((self.attempts, 200), (self.actuators, 300)), "Quality")
        self.addTab(_page(self.recording_plot, self._record, self._raw_text), "Recordings")
        self.addTab(self.drift_plot, "Drift")
        self.view.currentIndexChanged.connect(self._draw_plots)
        self.actuator.currentIndexChanged.connect(self._spectrum_actuator.setCurrentIndex)
        self._spectrum_actuator.currentIndexChanged.connect(self.actuator.setCurrentIndex)
        self.actuator.currentIndexChanged.connect(self._draw_plots)
        self._record.valueChanged.connect(self._draw_recording)
        self.currentChanged.connect(self._read_recordings)

    def show_position(self, position: int) -> None:
        """Show a position; -1 for none."""
        self.position, self.recordings = position, None
        surface = self._campaign.surface
        if surface is None or not 0 <= position < surface.positions:
            self.greens = None
            self._context.settle("position")
            self._clear()
            return
        path, failed = surface.bank, partial(self._context.report_failure, topic="position")
        self._context.background.ask("position", lambda: _read(path, position), self._show, failed)
        self._read_recordings()
        self._fill_attempts()

    def draw(self) -> None:
        # Noted first: a failure to draw is reported once, not twenty times a second.
        before, revision = self._drawn, dict(self._campaign.revision)
        self._drawn = revision
        if before.get("surface") != revision["surface"]:
            surface = self._campaign.surface
            names = [f"actuator {number}" for number in range(surface.actuators if surface else 0)]
            for choice in (self.actuator, self._spectrum_actuator):
                ui.fill_choice(choice, [_ALL, *names])
        attempts = self._campaign.history.get(self.position, [])
        if self.position >= 0 and len(attempts) != self.attempts.rowCount():
            self.show_position(self.position)
        if before.get("drift") != revision["drift"] or before.get("surface") != revision["surface"]:
            self._draw_drift()

    def _draw_drift(self) -> None:
        surface = self._campaign.surface
        self.drift_plot.show_drift(self._campaign.drift, surface.drift_limits if surface else DriftLimits())

    def redraw(self) -> None:
        self._draw_drift()
        self._draw_plots()
        self._draw_recording()

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

    def _draw_plots(self) -> None:
        surface = self._campaign.surface
        if surface is not None and self.greens is not None:
            actuator, view = self.actuator.currentIndex() - 1, self.view.currentIndex()
            self.green_plot.show_green(
                surface, self.greens, actuator, waterfall=view == _WATERFALL, own_scale=view == _OWN_SCALE
            )
            self.spectrum_plot.show_green(surface, self.greens, actuator)

    def _read_recordings(self) -> None:
        """Read the recordings, which are large, while their page is visible."""
        surface = self._campaign.surface
        if surface is None or self.position < 0 or self.currentWidget() is not self.recording_plot.parentWidget():
            return
        path, position = raw_path(surface.bank), self.position
        if not path.exists():
            self._show_no_recordings(f"no recordings: there is no {path.name} (run.toml: capture.keep_raw = true)")
            return
        self._context.background.ask(
            "recordings", lambda: _read_raw(path, position), self._show_raw,
            lambda failure: self._show_no_recordings(str(failure)),
        )  # fmt: skip

    def _show_raw(self, raw: Raw) -> None:
        self.recordings, self._raw_rate_hz = raw
        if self.recordings is None:
            self._show_no_recordings(f"position {self.position} has no recordings yet")
            return
        self._record.setMaximum(len(self.recordings.response_v) - 1)
        self._raw_text.setText(f"of {len(self.recordings.response_v)}; both DAQ inputs as recorded")
        self._draw_recording()

    def _show_no_recordings(self, reason: str) -> None:
        self.recordings = None
        self._raw_text.setText(reason)
        self.recording_plot.getPlotItem().clear()

    def _draw_recording(self) -> None:
        if self.recordings is not None:
            self.recording_plot.show_record(self.recordings, self._record.whole(), self._raw_rate_hz, self.position)

    def _fill_attempts(self) -> None:
        history = self._campaign.history.get(self.position, [])
        self.attempts.setRowCount(len(history))
        for line, attempt in enumerate(history):
            status = f": {status_text(attempt.status)}" if attempt.status else ""
            numbers = _text(attempt.snr_db, 1), _text(attempt.residual_db, 1)
            outcome = f"{attempt.outcome}{status}" + (f": {attempt.reason}" if attempt.reason else "")
            ui.fill_row(self.attempts, line, (clock(attempt.at_s), str(attempt.number), outcome, *numbers))

    def _clear(self) -> None:
        for plot in (self.green_plot, self.spectrum_plot, self.recording_plot):
            plot.getPlotItem().clear()
            plot.title("click a position on the map", faint=True)
        self.attempts.setRowCount(0)
        self.actuators.setRowCount(0)


def _read(path: Path, position: int) -> Details:
    from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
    from wavefocus.storage.bank.reading import open_bank  # h5py is slow to import

    with open_bank(path) as bank:
        quality = {key: bank.quality[key][position] for key in _FIGURES if key in bank.quality}
        if (error_db := bank_noise_error_db(bank)) is not None:
            quality[_NOISE_ERROR] = error_db[position]
        return Greens(position, bank.green(position)), quality


def _read_raw(path: Path, position: int) -> Raw:
    from wavefocus.storage.raw.writer import open_raw

    with open_raw(path) as raw:
        return raw.read(position), raw.header.sample_rate_hz


def _page(plot: QWidget, *controls: QWidget) -> QWidget:
    page = QWidget()
    ui.column(ui.row(*controls, None, margins=(4, 4, 4, 2)), (plot, 1), owner=page)
    return page


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
