"""Details of one position: Green's functions, spectrum, quality, recordings; and the drift of the sentinel."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PyQt5.QtWidgets import (
    QSizePolicy,
    QSpinBox,
    QTabWidget,
    QWidget,
)

from gui.campaign.events import clock
from gui.campaign.model import Campaign
from gui.campaign.plots import DriftPlot, GreenPlot, Greens, RecordingPlot, SpectrumPlot
from gui.campaign.quality import status_text
from gui.shell.tab import TabContext
from gui.shell.theme import Theme
from gui.shell.widgets import column, fill_row, make_choice, make_label, make_table, named, row, stacked

if TYPE_CHECKING:
    from storage.raw.reading import Recordings

_ATTEMPTS = ("time", "attempt", "outcome", "SNR (dB)", "residual (dB)")
_ACTUATORS = ("actuator", "SNR (dB)", "residual (dB)", "coherence", "peak (V)")
# Figures of an actuator, and their decimals.
_FIGURES = {"snr_db": 1, "residual_db": 1, "coherence": 3, "peak_v": 3}
_ALL = "all actuators"
_WATERFALL, _OWN_SCALE = 1, 2

Details = tuple[Greens, dict[str, np.ndarray]]
Raw = tuple["Recordings | None", float]


class PositionPanel(QTabWidget):
    """Shows one position; files are read in the background."""

    def __init__(self, context: TabContext, campaign: Campaign) -> None:
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
        self.view = make_choice(
            "View of the Green's functions",
            "View of the Green's functions",
            ["stacked", "waterfall", "stacked, own scale"],
        )
        self.actuator = make_choice("Emphasised actuator", "Emphasised actuator", [_ALL])
        self._spectrum_actuator = make_choice("Actuator of the spectrum", "Actuator of the spectrum", [_ALL])
        self._record = named(QSpinBox(), "Record of this position, from 0", "Record")
        self._record.setPrefix("record ")
        self._raw_text = make_label(role="faint", wraps=True)
        self._raw_text.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self.attempts = make_table(_ATTEMPTS, "Quality history of the position", stretched=(2,))
        self.attempts.setWordWrap(False)
        self.actuators = make_table(_ACTUATORS, "Quality per actuator", stretched=range(len(_ACTUATORS)))
        self.addTab(_page(self.green_plot, self.view, self.actuator), "Green's functions")
        self.addTab(_page(self.spectrum_plot, self._spectrum_actuator), "Spectrum")
        self.addTab(stacked((self.attempts, 200), (self.actuators, 300)), "Quality")
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
            self._clear()
            return
        path, failed = surface.bank, self._context.report_failure
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
                choice.blockSignals(True)
                choice.clear()
                choice.addItems([_ALL, *names])
                choice.blockSignals(False)
        attempts = self._campaign.history.get(self.position, [])
        if self.position >= 0 and len(attempts) != self.attempts.rowCount():
            self.show_position(self.position)
        if before.get("drift") != revision["drift"]:
            self.drift_plot.show_drift(self._campaign.drift)

    def apply_theme(self, theme: Theme) -> None:
        for plot in (self.green_plot, self.spectrum_plot, self.recording_plot, self.drift_plot):
            plot.apply_theme(theme)
        self.drift_plot.show_drift(self._campaign.drift)
        self._draw_plots()
        self._draw_recording()

    def _show(self, details: Details) -> None:
        self.greens, quality = details
        self._draw_plots()
        count = self.greens.green.shape[0]
        self.actuators.setRowCount(count)
        for actuator in range(count):
            numbers = [
                _text(float(quality[key][actuator]) if key in quality else math.nan, digits)
                for key, digits in _FIGURES.items()
            ]
            fill_row(self.actuators, actuator, (str(actuator), *numbers))

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
        path, position = self._context.front.raw_path(surface.bank), self.position
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
            self.recording_plot.show_record(self.recordings, self._record.value(), self._raw_rate_hz, self.position)

    def _fill_attempts(self) -> None:
        history = self._campaign.history.get(self.position, [])
        self.attempts.setRowCount(len(history))
        for line, attempt in enumerate(history):
            status = f": {status_text(attempt.status)}" if attempt.status else ""
            numbers = _text(attempt.snr_db, 1), _text(attempt.residual_db, 1)
            outcome = f"{attempt.outcome}{status}"
            fill_row(self.attempts, line, (clock(attempt.at_s), str(attempt.number), outcome, *numbers))

    def _clear(self) -> None:
        for plot in (self.green_plot, self.spectrum_plot, self.recording_plot):
            plot.getPlotItem().clear()
            plot.getPlotItem().setTitle("click a position on the map", color=plot.theme.faint)
        self.attempts.setRowCount(0)
        self.actuators.setRowCount(0)


def _read(path: Path, position: int) -> Details:
    from storage.bank.reading import open_bank  # h5py is slow to import

    with open_bank(path) as bank:
        quality = {key: bank.quality[key][position] for key in _FIGURES if key in bank.quality}
        return Greens(position, bank.green(position)), quality


def _read_raw(path: Path, position: int) -> Raw:
    from storage.raw.reading import open_raw

    with open_raw(path) as raw:
        return raw.read(position), raw.header.sample_rate_hz


def _page(plot: QWidget, *controls: QWidget) -> QWidget:
    page = QWidget()
    column(row(*controls, None, margins=(4, 4, 4, 2)), (plot, 1), owner=page)
    return page


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
