"""Everything about one position: Green's functions, spectrum, quality history, recordings; and the drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QSizePolicy,
    QSpinBox,
    QSplitter,
    QTableWidget,
    QTableWidgetItem,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from gui.campaign.model import Attempt, Campaign
from gui.campaign.plots import DriftPlot, GreenPlot, Greens, RecordingPlot, SpectrumPlot
from gui.campaign.statuses import status_text
from gui.shell.tab import TabContext
from gui.shell.theme import Theme

if TYPE_CHECKING:
    from storage.raw.reading import Recordings

_ATTEMPTS = ("when", "attempt", "outcome", "SNR (dB)", "residual (dB)")
_ACTUATORS = ("actuator", "SNR (dB)", "residual (dB)", "coherence", "peak (V)")
_KEYS = ("snr_db", "residual_db", "coherence", "peak_v")

Details = tuple[Greens, dict[str, np.ndarray]]
Raw = tuple["Recordings | None", float]


class PositionPanel(QTabWidget):
    """Shows one position; what it needs from the disk is read in the background."""

    def __init__(self, context: TabContext, campaign: Campaign) -> None:
        super().__init__()
        self.setDocumentMode(True)
        self.setAccessibleName("Details of the position")
        self._context = context
        self._campaign = campaign
        self.position = -1
        self.greens: Greens | None = None
        self.recordings: Recordings | None = None
        self._raw_rate_hz = 0.0
        self._seen: dict[str, int] = {}
        self.green_plot, self.spectrum_plot = GreenPlot(), SpectrumPlot()
        self.recording_plot, self.drift_plot = RecordingPlot(), DriftPlot()
        self._view = _combo("How to show the Green's functions", ["stacked", "waterfall", "stacked, own scale"])
        self._actuator = _combo("Actuator that is emphasised", ["all actuators"])
        self._record = QSpinBox()
        self._record.setAccessibleName("Record")
        self._record.setPrefix("record ")
        self._record.setToolTip("Record of this position, from 0")
        self._raw_said = QLabel()
        self._raw_said.setWordWrap(True)
        self._raw_said.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self._raw_said.setProperty("role", "faint")
        self.attempts, self.actuators = _table(_ATTEMPTS, 2), _table(_ACTUATORS, -1)
        self.attempts.setAccessibleName("Quality history of the position")
        self.actuators.setAccessibleName("Quality per actuator")
        tables = QSplitter(Qt.Orientation.Vertical)
        tables.addWidget(self.attempts)
        tables.addWidget(self.actuators)
        tables.setSizes([200, 300])
        self._spectrum_actuator = _combo("Actuator whose spectrum is drawn", ["all actuators"])
        self.addTab(_with_top(_row(self._view, self._actuator), self.green_plot), "Green's functions")
        self.addTab(_with_top(_row(self._spectrum_actuator), self.spectrum_plot), "Spectrum")
        self.addTab(tables, "Quality")
        self.addTab(_with_top(_row(self._record, self._raw_said), self.recording_plot), "Recordings")
        self.addTab(self.drift_plot, "Drift")
        self._view.currentIndexChanged.connect(self._draw_plots)
        self._actuator.currentIndexChanged.connect(self._spectrum_actuator.setCurrentIndex)
        self._spectrum_actuator.currentIndexChanged.connect(self._actuator.setCurrentIndex)
        self._actuator.currentIndexChanged.connect(self._draw_plots)
        self._record.valueChanged.connect(self._draw_recording)
        self.currentChanged.connect(self._page_changed)

    def show_position(self, position: int) -> None:
        """Show a position; -1 for none."""
        self.position = position
        self.recordings = None
        surface = self._campaign.surface
        if surface is None or not 0 <= position < surface.positions:
            self.greens = None
            self._clear()
            return
        path = surface.bank
        self._context.background.ask(
            "position", lambda: _read(path, position), self._show, self._context.report_failure
        )
        self._read_recordings()
        self._fill_attempts()

    def show_green_as(self, view: int) -> None:
        """Show Green's functions stacked (0), as a waterfall (1), or stacked and each to its own peak (2)."""
        self._view.setCurrentIndex(view)

    def draw(self) -> None:
        """Draw what changed."""
        # Noted first: what cannot be drawn is told once, not twenty times a second.
        before, seen = self._seen, dict(self._campaign.revision)
        self._seen = seen
        if before.get("surface") != seen["surface"]:
            surface = self._campaign.surface
            names = [f"actuator {number}" for number in range(surface.actuators if surface else 0)]
            for combo in (self._actuator, self._spectrum_actuator):
                combo.blockSignals(True)
                combo.clear()
                combo.addItems(["all actuators", *names])
                combo.blockSignals(False)
        if before.get("history") != seen["history"] and self.position >= 0:
            history = self._campaign.history.get(self.position, [])
            if len(history) != self.attempts.rowCount():
                self.show_position(self.position)
        if before.get("drift") != seen["drift"]:
            self.drift_plot.show_drift(self._campaign.drift)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
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
            _put(self.actuators, actuator, 0, str(actuator))
            for column, key in enumerate(_KEYS, start=1):
                values = quality.get(key)
                value = float(values[actuator]) if values is not None else float("nan")
                _put(self.actuators, actuator, column, _figure(value, 3 if key in ("coherence", "peak_v") else 1))

    def _draw_plots(self) -> None:
        surface = self._campaign.surface
        if surface is None or self.greens is None:
            return
        actuator = self._actuator.currentIndex() - 1
        waterfall = self._view.currentIndex() == 1
        own_scale = self._view.currentIndex() == 2
        self.green_plot.show_green(surface, self.greens, actuator, waterfall=waterfall, own_scale=own_scale)
        self.spectrum_plot.show_green(surface, self.greens, actuator)

    def _page_changed(self) -> None:
        self._read_recordings()

    def _read_recordings(self) -> None:
        """Recordings are large: they are read when somebody looks at them."""
        surface = self._campaign.surface
        if surface is None or self.position < 0 or self.currentWidget() is not self.recording_plot.parentWidget():
            return
        path, position = self._context.front.raw_path(surface.bank), self.position
        if not path.exists():
            self._say_raw(f"no recordings were kept: there is no {path.name} (run.toml: capture.keep_raw = true)")
            return
        self._context.background.ask(
            "recordings", lambda: _read_raw(path, position), self._show_raw, lambda failure: self._say_raw(str(failure))
        )

    def _show_raw(self, raw: Raw) -> None:
        self.recordings, self._raw_rate_hz = raw
        if self.recordings is None:
            self._say_raw(f"position {self.position} has no recordings yet")
            return
        self._record.setMaximum(len(self.recordings.response_v) - 1)
        self._raw_said.setText(f"of {len(self.recordings.response_v)}; both DAQ inputs as they were recorded")
        self._draw_recording()

    def _say_raw(self, sentence: str) -> None:
        self.recordings = None
        self._raw_said.setText(sentence)
        self.recording_plot.getPlotItem().clear()

    def _draw_recording(self) -> None:
        if self.recordings is not None:
            self.recording_plot.show_record(self.recordings, self._record.value(), self._raw_rate_hz, self.position)

    def _fill_attempts(self) -> None:
        history: Sequence[Attempt] = self._campaign.history.get(self.position, [])
        self.attempts.setRowCount(len(history))
        for row, attempt in enumerate(history):
            outcome = attempt.outcome
            if attempt.status:
                outcome = f"{outcome}: {status_text(attempt.status)}"
            _put(self.attempts, row, 0, clock(attempt.at_s))
            _put(self.attempts, row, 1, "" if attempt.number < 0 else str(attempt.number))
            _put(self.attempts, row, 2, outcome)
            _put(self.attempts, row, 3, _figure(attempt.snr_db, 1))
            _put(self.attempts, row, 4, _figure(attempt.residual_db, 1))

    def _clear(self) -> None:
        for plot in (self.green_plot, self.spectrum_plot, self.recording_plot):
            plot.getPlotItem().clear()
            plot.getPlotItem().setTitle("click a position on the map", color=plot.theme.faint)
        self.attempts.setRowCount(0)
        self.actuators.setRowCount(0)


def clock(at_s: float) -> str:
    """An instant for people, with the day; empty where it is unknown."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def _read(path: Path, position: int) -> Details:
    from storage.bank.reading import open_bank  # h5py is loaded in the background

    with open_bank(path) as bank:
        quality = {key: bank.quality[key][position] for key in _KEYS if key in bank.quality}
        return Greens(position, bank.green(position)), quality


def _read_raw(path: Path, position: int) -> Raw:
    from storage.raw.reading import open_raw

    with open_raw(path) as raw:
        return raw.read(position), raw.header.sample_rate_hz


def _combo(name: str, choices: Sequence[str]) -> QComboBox:
    combo = QComboBox()
    combo.addItems(choices)
    combo.setAccessibleName(name)
    combo.setToolTip(name)
    return combo


def _row(*widgets: QWidget) -> QHBoxLayout:
    row = QHBoxLayout()
    row.setContentsMargins(4, 4, 4, 2)
    for widget in widgets:
        row.addWidget(widget)
    if not isinstance(widgets[-1], QLabel):
        row.addStretch(1)
    return row


def _with_top(top: QHBoxLayout, plot: QWidget) -> QWidget:
    page = QWidget()
    column = QVBoxLayout(page)
    column.setContentsMargins(0, 0, 0, 0)
    column.addLayout(top)
    column.addWidget(plot, stretch=1)
    return page


def _table(titles: Sequence[str], wide: int) -> QTableWidget:
    table = QTableWidget(0, len(titles))
    table.setHorizontalHeaderLabels(titles)
    table.setEditTriggers(QTableWidget.EditTrigger.NoEditTriggers)
    table.setAlternatingRowColors(True)
    side, top = table.verticalHeader(), table.horizontalHeader()
    assert side is not None
    assert top is not None
    side.hide()
    top.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents if wide >= 0 else QHeaderView.ResizeMode.Stretch)
    if wide >= 0:
        top.setSectionResizeMode(wide, QHeaderView.ResizeMode.Stretch)
    side.setDefaultSectionSize(table.fontMetrics().height() + 5)
    return table


def _put(table: QTableWidget, row: int, column: int, text: str) -> None:
    item = QTableWidgetItem(text)
    item.setToolTip(text)
    table.setItem(row, column, item)


def _figure(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
