"""The predicted field as a movie over the surface, and the response at a position that was clicked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtWidgets import QComboBox, QDoubleSpinBox, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from gui.scene.results.instants import between
from gui.scene.results.messages import Driven, FieldBegun, Plate
from gui.shell.theme import Theme
from gui.shell.widgets import stacked
from gui.surface.colours import ColourBar, scaled_unit
from gui.surface.field_map import FieldMap
from gui.surface.plot import Plot, thinning_curve
from gui.surface.time_slider import TimeSlider
from storage.units import quantity

Float32Array = NDArray[np.float32]

_SIGNED, _MAGNITUDE = "response", "magnitude"


class FieldView(QWidget):
    """Shows one field; `field` is (samples, positions), and stays where the window gathers it."""

    def __init__(self) -> None:
        super().__init__()
        self.plate: Plate | None = None
        self.driven: Driven | None = None
        self.begun: FieldBegun | None = None
        self.field: Float32Array = np.zeros((0, 0), np.float32)
        self._bank_seen: Plate | None = None
        self._factor = 1.0
        self.map = FieldMap("response")
        self.slider = TimeSlider()
        self.colours = QComboBox()
        self.colours.addItems([_SIGNED, _MAGNITUDE])
        self.colours.setAccessibleName("What the colours show")
        self.colours.setToolTip("Positive and negative responses in two colours, or their magnitude in one")
        self.span = QDoubleSpinBox()
        self.span.setRange(1.0, 1000.0)
        self.span.setValue(100.0)
        self.span.setDecimals(0)
        self.span.setPrefix("to ")
        self.span.setSuffix(" %")
        self.span.setAccessibleName("End of the colour scale")
        self.span.setToolTip("Where the colour scale ends, as a part of the largest response at a focus (%)")
        self.bar = ColourBar(self.map.colour_map)
        self.said = QLabel()
        self.said.setProperty("role", "faint")
        self.said.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.waveform = _Waveform()
        self._lay_out()
        self.slider.moved.connect(self._show_instant)
        self.map.picked.connect(self.show_position)
        self.colours.currentIndexChanged.connect(self._scale)
        self.span.valueChanged.connect(self._scale)

    @property
    def time_s(self) -> float:
        """The instant shown, on the scene's clock."""
        return self.slider.time_s

    def show_field(self, plate: Plate, driven: Driven, begun: FieldBegun, field: Float32Array) -> None:
        """Show a field that is complete."""
        marked_row = self._marked_row()
        at_s = self.time_s if self.begun is not None else None
        self.plate, self.driven, self.begun, self.field = plate, driven, begun, field
        self._show_ground(plate, driven)
        finer_hz = begun.sample_rate_hz * begun.finer
        marks = [round((time_s - begun.start_s) * finer_hz) for time_s in begun.marks_s]
        self.slider.show_samples(begun.start_s, finer_hz, (begun.samples - 1) * begun.finer + 1, marks)
        if at_s is not None and begun.start_s <= at_s:
            self.slider.go_to(round((at_s - begun.start_s) * finer_hz))
        shown_s = begun.samples / begun.sample_rate_hz
        part = f"first {shown_s:.0f} s of {begun.lasts_s:.0f} s" if begun.lasts_s > shown_s + 1e-9 else ""
        self.said.setText(part)
        self.said.setToolTip(f"Predicted at {len(plate.rows)} positions; {part or 'all of it'}")
        self._scale()
        place = np.searchsorted(plate.rows, marked_row) if marked_row >= 0 else len(plate.rows)
        known = place < len(plate.rows) and plate.rows[place] == marked_row
        self.show_position(int(place) if known else -1)

    def clear(self) -> None:
        """Show nothing."""
        self.begun, self.field = None, np.zeros((0, 0), np.float32)
        self.slider.show_samples(0.0, 1.0, 0)
        self.map.show_values(np.full(0 if self.plate is None else len(self.plate.rows), np.nan))
        self.map.show_sources(np.zeros((0, 2)))
        self.said.setText("")
        self.waveform.clear_response()

    def show_position(self, place: int) -> None:
        """Mark a position, by its place in the field, and show its response; -1 for none."""
        self.map.mark(place)
        if self.plate is None or self.begun is None or not 0 <= place < self.field.shape[1]:
            self.waveform.clear_response()
            return
        at_mm = self.plate.surface.position_mm[place]
        words = f"position {self.plate.rows[place]} at ({at_mm[0]:.1f}, {at_mm[1]:.1f}) mm"
        self.waveform.show_response(words, self.field[:, place], self.begun)
        self.waveform.show_time(self.time_s)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.map.apply_theme(theme)
        self.slider.apply_theme(theme)
        self.bar.apply_theme(theme)
        self.waveform.apply_theme(theme)
        self._scale()
        self.show_position(self.map.marked)

    def _lay_out(self) -> None:
        choices = QHBoxLayout()
        choices.setContentsMargins(4, 4, 4, 0)
        # The slider's own row is as wide as the panel must be: how fast it plays is chosen here.
        for part in (self.colours, self.span, self.slider.slower):
            choices.addWidget(part)
        choices.addWidget(self.said, stretch=1)
        upper = QWidget()
        column = QVBoxLayout(upper)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(3)
        column.addLayout(choices)
        column.addWidget(self.map, stretch=1)
        column.addWidget(self.bar)
        column.addWidget(self.slider)
        outer = QVBoxLayout(self)
        outer.setContentsMargins(0, 0, 0, 0)
        outer.addWidget(stacked((upper, 420), (self.waveform, 130), growing=[0]))

    def _show_ground(self, plate: Plate, driven: Driven) -> None:
        kept = self.map.box.viewRect() if self._bank_seen is plate else None
        self._bank_seen = plate
        self.map.show_surface(replace(plate.surface, paths_mm=driven.paths_mm))
        if kept is not None:
            self.map.box.setRange(kept, padding=0)

    def _scale(self) -> None:
        begun = self.begun
        signed = self.colours.currentText() == _SIGNED
        top = begun.limit if begun is not None and begun.limit > 0 else 0.0
        if begun is not None and not top:
            top = float(np.abs(self.field[:: max(1, len(self.field) // 200)]).max(initial=0.0)) or 1.0
        top = (top or 1.0) * self.span.value() / 100.0
        self._factor, unit = scaled_unit("" if begun is None else begun.unit, top)
        high = top * self._factor
        levels = (-high if signed else 0.0, high)
        self.map.show_scale(levels, unit, signed=signed)
        self.bar.set_map(self.map.colour_map)
        self.bar.show_range(self.colours.currentText(), unit, levels, (signed, True))
        self._show_instant(self.slider.sample)

    def _show_instant(self, sample: int) -> None:
        begun = self.begun
        if begun is None or self.driven is None or not self.field.size:
            return
        values = between(self.field, sample / begun.finer) * np.float32(self._factor)
        self.map.show_values(values if self.colours.currentText() == _SIGNED else np.abs(values))
        self.map.show_sources(self.sources_mm(self.time_s))
        self.waveform.show_time(self.time_s)

    def sources_mm(self, time_s: float) -> NDArray[np.float64]:
        """Where foci are at an instant, (foci, 2)."""
        if self.driven is None:
            return np.zeros((0, 2))
        return self.driven.focus_mm[(self.driven.focus_s <= time_s) & (time_s < self.driven.focus_stop_s)]

    def _marked_row(self) -> int:
        marked = self.map.marked
        return int(self.plate.rows[marked]) if self.plate is not None and 0 <= marked < len(self.plate.rows) else -1


class _Waveform(Plot):
    def __init__(self) -> None:
        super().__init__("Response of the position that was clicked", "time (s)", "")
        plot = self.getPlotItem()
        plot.getAxis("left").setWidth(60)
        self._curve, self._now = thinning_curve(), pyqtgraph.InfiniteLine(0.0)
        plot.addItem(self._curve)
        plot.addItem(self._now)
        self.clear_response()

    def clear_response(self) -> None:
        self._curve.setData([], [])
        self._now.hide()
        self.getPlotItem().setTitle("click a position on the map for its response", color=self.theme.faint, size="9pt")

    def show_response(self, words: str, response: Float32Array, begun: FieldBegun) -> None:
        plot, theme = self.getPlotItem(), self.theme
        time_s = begun.start_s + np.arange(len(response)) / begun.sample_rate_hz
        self._curve.setData(time_s, np.ascontiguousarray(response), pen=pyqtgraph.mkPen(theme.traces[0]))
        self._now.setPen(pyqtgraph.mkPen(theme.fault, width=1.2))
        self._now.show()
        plot.setLabel("left", begun.unit)
        largest = float(np.abs(response).max(initial=0.0))
        plot.setTitle(f"{words}: largest {quantity(f'{largest:.3g}', begun.unit)}", color=theme.text, size="9pt")
        plot.setXRange(float(time_s[0]), float(time_s[-1]), padding=0.01)
        plot.setYRange(-1.1 * (largest or 1.0), 1.1 * (largest or 1.0), padding=0.0)

    def show_time(self, time_s: float) -> None:
        self._now.setValue(time_s)
