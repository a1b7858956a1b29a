"""The predicted field as a movie over the surface, and the response at the position that was clicked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtWidgets import QComboBox, QDoubleSpinBox, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from gui.field_map import ColourBar, FieldMap, Plot, scaled_unit, thinning_curve
from gui.scene.messages import Driven, PredictedField, between
from gui.theme import Theme
from gui.time_slider import TimeSlider
from gui.widgets import named, stacked
from storage.units import quantity

_SIGNED, _MAGNITUDE = "response", "magnitude"


class FieldView(QWidget):
    """Shows one field."""

    def __init__(self) -> None:
        super().__init__()
        self.driven: Driven | None = None
        self.predicted: PredictedField | None = None
        self._factor = 1.0
        self.map = FieldMap("response")
        self.slider = TimeSlider()
        self.colours = named(QComboBox(), "Signed responses in two colours, or magnitudes in one", "Colours")
        self.colours.addItems([_SIGNED, _MAGNITUDE])
        self.span = named(
            QDoubleSpinBox(), "End of the colour scale, as a part of the largest response at a focus (%)",
            "End of the colour scale",
        )  # fmt: skip
        self.span.setRange(1.0, 1000.0)
        self.span.setValue(100.0)
        self.span.setDecimals(0)
        self.span.setPrefix("to ")
        self.span.setSuffix(" %")
        self.bar = ColourBar(self.map.colour_map)
        self.note = QLabel()
        self.note.setProperty("role", "faint")
        self.note.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.waveform = ResponsePlot()
        choices = QHBoxLayout()
        choices.setContentsMargins(4, 4, 4, 0)
        for part in (self.colours, self.span, self.slider.slower):  # the slider's own row is as wide as the panel
            choices.addWidget(part)
        choices.addWidget(self.note, stretch=1)
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
        self.slider.moved.connect(self._show_instant)
        self.map.picked.connect(self.show_position)
        self.colours.currentIndexChanged.connect(self._rescale)
        self.span.valueChanged.connect(self._rescale)

    @property
    def time_s(self) -> float:
        """The instant shown, on the scene's clock."""
        return self.slider.time_s

    def show_field(self, driven: Driven, predicted: PredictedField) -> None:
        """Show another field, at the same instant, position and part of the surface as far as it has them."""
        former, view, marked = self.predicted, self.map.box.viewRect(), self.map.marked
        at_s = None if former is None else self.time_s
        row = former.rows[marked] if former is not None and 0 <= marked < len(former.rows) else -1
        self.driven, self.predicted = driven, predicted
        same_bank = self.map.surface is not None and self.map.surface.bank == predicted.surface.bank
        self.map.show_surface(replace(predicted.surface, paths_mm=driven.paths_mm))
        if same_bank:
            self.map.box.setRange(view, padding=0)
        finer_hz, samples = predicted.sample_rate_hz * predicted.finer, len(predicted.field)
        marks = [round((time_s - predicted.start_s) * finer_hz) for time_s in predicted.marks_s]
        self.slider.show_samples(predicted.start_s, finer_hz, (samples - 1) * predicted.finer + 1, marks)
        if at_s is not None and predicted.start_s <= at_s:
            self.slider.go_to(round((at_s - predicted.start_s) * finer_hz))
        shown_s = samples / predicted.sample_rate_hz
        part = f"first {shown_s:.0f} s of {predicted.lasts_s:.0f} s" if predicted.lasts_s > shown_s + 1e-9 else ""
        self.note.setText(part)
        self.note.setToolTip(f"Predicted at {len(predicted.rows)} positions; {part or 'the whole response'}")
        self._rescale()
        (place,) = np.flatnonzero(predicted.rows == row)[:1].tolist() or (-1,)
        self.show_position(place)

    def clear(self) -> None:
        """Show nothing."""
        self.predicted = None
        self.slider.show_samples(0.0, 1.0, 0)
        self.map.show_values(np.full(0 if self.map.surface is None else self.map.surface.positions, np.nan))
        self.map.show_sources(np.zeros((0, 2)))
        self.note.setText("")
        self.waveform.clear_response()

    def show_position(self, place: int) -> None:
        """Mark a position, by its place in the field, and show its response; -1 for none."""
        self.map.mark(place)
        predicted = self.predicted
        if predicted is None or not 0 <= place < len(predicted.rows):
            self.waveform.clear_response()
            return
        x_mm, y_mm = predicted.surface.position_mm[place]
        title = f"position {predicted.rows[place]} at ({x_mm:.1f}, {y_mm:.1f}) mm"
        self.waveform.show_response(title, predicted.field[:, place], predicted)
        self.waveform.show_time(self.time_s)

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        for part in (self.map, self.bar, self.slider, self.waveform):
            part.apply_theme(theme)
        self._rescale()
        self.show_position(self.map.marked)

    def sources_mm(self, time_s: float) -> NDArray[np.float64]:
        """Positions of the foci at an instant, (foci, 2)."""
        driven = self.driven
        if driven is None:
            return np.zeros((0, 2))
        return driven.focus_mm[(driven.focus_s <= time_s) & (time_s < driven.focus_stop_s)]

    def _rescale(self) -> None:
        predicted, signed = self.predicted, self.colours.currentText() == _SIGNED
        top = 0.0 if predicted is None else predicted.limit
        if predicted is not None and not top > 0.0:
            top = float(np.abs(predicted.field[:: max(1, len(predicted.field) // 200)]).max(initial=0.0))
        top = (top or 1.0) * self.span.value() / 100.0
        self._factor, unit = scaled_unit("" if predicted is None else predicted.unit, top)
        levels = (-top * self._factor if signed else 0.0, top * self._factor)
        self.map.show_scale(levels, unit, signed=signed)
        self.bar.set_map(self.map.colour_map)
        self.bar.show_range(self.colours.currentText(), unit, levels, (signed, True))
        self._show_instant(self.slider.sample)

    def _show_instant(self, sample: int) -> None:
        predicted = self.predicted
        if predicted is None:
            return
        values = between(predicted.field, sample / predicted.finer) * np.float32(self._factor)
        self.map.show_values(values if self.map.signed else np.abs(values))
        self.map.show_sources(self.sources_mm(self.time_s))
        self.waveform.show_time(self.time_s)


class ResponsePlot(Plot):
    """The response of one position."""

    def __init__(self) -> None:
        super().__init__("Response of the position that was clicked", "time (s)", "")
        plot = self.getPlotItem()
        plot.getAxis("left").setWidth(60)
        self.curve, self._now = thinning_curve(), pyqtgraph.InfiniteLine(0.0)
        plot.addItem(self.curve)
        plot.addItem(self._now)
        self.clear_response()

    def clear_response(self) -> None:
        """Show no response."""
        self.curve.setData([], [])
        self._now.hide()
        self.getPlotItem().setTitle("click a position on the map for its response", color=self.theme.faint, size="9pt")

    def show_response(self, title: str, response: NDArray[np.float32], predicted: PredictedField) -> None:
        """Show a position's response."""
        plot, theme = self.getPlotItem(), self.theme
        time_s = predicted.start_s + np.arange(len(response)) / predicted.sample_rate_hz
        self.curve.setData(time_s, np.ascontiguousarray(response), pen=pyqtgraph.mkPen(theme.traces[0]))
        self._now.setPen(pyqtgraph.mkPen(theme.fault, width=1.2))
        self._now.show()
        plot.setLabel("left", predicted.unit)
        largest = float(np.abs(response).max(initial=0.0))
        plot.setTitle(f"{title}: largest {quantity(f'{largest:.3g}', predicted.unit)}", color=theme.text, size="9pt")
        plot.setXRange(float(time_s[0]), float(time_s[-1]), padding=0.01)
        plot.setYRange(-1.1 * (largest or 1.0), 1.1 * (largest or 1.0), padding=0.0)

    def show_time(self, time_s: float) -> None:
        """Mark the instant that the map shows."""
        self._now.setValue(time_s)
