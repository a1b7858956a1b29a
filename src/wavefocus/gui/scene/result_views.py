"""Drives and predicted field of a scene: traces, levels, n(x), and the field as a movie with a position's response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QSize, Qt
from PyQt5.QtWidgets import QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import FieldMap, Plot, Real, decimating_curve, whole_ticks
from wavefocus.gui.scene.calculation import DriveResult, PredictedField, interpolate_frame
from wavefocus.gui.theme import Themed
from wavefocus.gui.time_slider import TimeSlider
from wavefocus.storage.units import quantity

_ALL = "all actuators"
_STEP = 0.45  # the loudest trace fills so much of the distance to its neighbours, up and down
_BAR = 0.36
_ROOM = 1.15
_FAR = 3.0
_AXIS_PX, _NARROW_PX = 58, 44


class DrivesView(Themed, QWidget):
    """Shows the drives of all actuators."""

    def __init__(self) -> None:
        super().__init__()
        self.driven: DriveResult | None = None
        tip = "All drives, or the drive of one actuator with its limit (V)"
        self.actuator = ui.choice("Actuator shown", tip, [_ALL])
        tip = "Draw each actuator's drive to its own peak, so that weak ones are seen, too"
        self.own_scale = ui.check("own scale", tip, "Each drive to its own peak")
        self.note = ui.label(role="faint", any_width=True)
        self.traces = TracePlot()
        self.levels = LevelPlot()
        self.gains = GainPlot()
        lower = ui.side_by_side((self.levels, 280), (self.gains, 200))
        both = ui.stacked((self.traces, 330), (lower, 180), growing=[0])
        choices = ui.row(self.actuator, self.own_scale, (self.note, 1), margins=(4, 4, 4, 2))
        ui.column(choices, (both, 1), owner=self, spacing=2)
        for changed in (self.actuator.currentIndexChanged, self.own_scale.toggled):
            changed.connect(lambda _choice: self.redraw())

    def sizeHint(self) -> QSize:  # noqa: N802
        return QSize(480, 300)

    def show_driven(self, driven: DriveResult | None) -> None:
        """Show drives, or none."""
        self.driven = driven
        if driven is not None and self.actuator.count() != len(driven.drive_v) + 1:
            ui.fill_choice(self.actuator, [_ALL, *(f"actuator {number}" for number in range(len(driven.drive_v)))])
        self.redraw()

    def redraw(self) -> None:
        chosen = self.actuator.currentIndex() - 1
        for plot in (self.traces, self.levels, self.gains):
            for side in ("left", "bottom"):
                plot.getPlotItem().showAxis(side, self.driven is not None)
        self.own_scale.setEnabled(chosen < 0)
        self.traces.show_driven(self.driven, chosen, own_scale=self.own_scale.isChecked())
        for plot in (self.levels, self.gains):
            plot.getPlotItem().clear()
        if self.driven is None:
            self.note.setText("")
            self.note.setToolTip("")
            return
        limiting = self.driven.limiting
        scaled = f"scaled by {limiting.scale:.3g} for {limiting.decided_by}"
        self.note.setText("within all limits" if limiting.decided_by is None else scaled)
        self.note.setToolTip(str(limiting))
        self.levels.show_driven(self.driven, chosen)
        self.gains.show_driven(self.driven)


class TracePlot(Plot):
    """Drives over time."""

    def __init__(self) -> None:
        super().__init__("Drives of all actuators", "time (s)", "actuator", axis_px=_AXIS_PX)
        self._ends = 0.0, 0.0
        self._curves: list[pyqtgraph.PlotDataItem] = []
        self._limits = [pyqtgraph.InfiniteLine(angle=0), pyqtgraph.InfiniteLine(angle=0)]
        self._zero = pyqtgraph.InfiniteLine(0.0)
        self._zero.setZValue(-1)
        for line in (*self._limits, self._zero):
            line.hide()
            self.getPlotItem().addItem(line)

    def show_driven(self, driven: DriveResult | None, chosen: int, *, own_scale: bool = False) -> None:
        plot, theme = self.getPlotItem(), self.theme
        self._zero.setPen(pyqtgraph.mkPen(theme.faint, style=Qt.PenStyle.DotLine))
        self._zero.setVisible(driven is not None)
        if driven is None:
            self._show_curves(np.zeros(0), [], 1.0)
            self._show_limit(None)
            self.title("no drives to show", faint=True, size="9pt")
            return
        volts = driven.drive_v if chosen < 0 else driven.drive_v[chosen : chosen + 1]
        time_s = driven.start_s + np.arange(volts.shape[1]) / driven.sample_rate_hz
        largest, limit_v = float(np.abs(volts).max(initial=0.0)), driven.limits.peak_v
        if chosen >= 0:
            self._show_curves(time_s, [volts[0]], 1.4)
            self._show_limit(limit_v)
            plot.setLabel("left", f"actuator {chosen} ({driven.unit})")
            plot.getAxis("left").setTicks(None)
            reach = _ROOM * max(largest, limit_v or 0.0, 1e-12)
            plot.setYRange(-reach, reach, padding=0.0)
            title = f"largest {quantity(f'{largest:.3g}', driven.unit)}"
            if limit_v is not None:
                title += f" of {quantity(f'{limit_v:.3g}', driven.unit)} (dashed)"
        else:
            peaks = np.abs(volts).max(axis=1, initial=0.0) if own_scale else np.full(len(volts), largest)
            scales = np.float32(_STEP) / np.where(peaks > 0, peaks, 1.0).astype(np.float32)
            self._show_curves(time_s, [one + scales[one] * trace for one, trace in enumerate(volts)], 1.0)
            self._show_limit(None)
            plot.setLabel("left", "actuator")
            plot.getAxis("left").setTicks([whole_ticks(len(volts)), []])
            plot.setYRange(-1.0, len(volts), padding=0.0)
            title = (
                "each to its own peak" if own_scale else f"a step is {quantity(f'{largest / _STEP:.3g}', driven.unit)}"
            )
        self.title(title, size="9pt")
        # A zoomed view stays while the scene is edited.
        ends = float(time_s[0]), float(time_s[-1])
        if ends != self._ends:
            self._ends = ends
            plot.setXRange(*ends, padding=0.01)

    def _show_curves(self, x: Real, curves: Sequence[Real], width: float) -> None:
        """Curves are reused: thinned ones cannot be taken out of a plot."""
        pen = pyqtgraph.mkPen(self.theme.traces[0], width=width)
        while len(self._curves) < len(curves):
            self._curves.append(decimating_curve())
            self.getPlotItem().addItem(self._curves[-1])
        for number, curve in enumerate(self._curves):
            shown = number < len(curves)
            curve.setVisible(shown)
            if shown:
                curve.setData(x, curves[number], pen=pen)
            else:
                curve.setData([], [])

    def _show_limit(self, limit_v: float | None) -> None:
        for side, line in zip((-1.0, 1.0), self._limits, strict=True):
            line.setVisible(limit_v is not None)
            line.setPen(pyqtgraph.mkPen(self.theme.fault, width=1.5, style=Qt.PenStyle.DashLine))
            line.setValue(side * (limit_v or 0.0))


class LevelPlot(Plot):
    """Peak and rms of each actuator."""

    def __init__(self) -> None:
        super().__init__("Peak and rms of each actuator", "actuator", "level (V)", axis_px=_AXIS_PX)
        self.setToolTip(
            "Level of each actuator's drive (V): outlined the peak, filled the rms over 1 s;"
            " dashed the limit of the peak, dotted that of the rms"
        )

    def show_driven(self, driven: DriveResult, chosen: int) -> None:
        plot, theme = self.getPlotItem(), self.theme
        count = len(driven.peak_v)
        plot.setLabel("left", f"level ({driven.unit})")
        colours = [theme.traces[1] if one == chosen else theme.traces[0] for one in range(count)]
        for values, filled in ((driven.peak_v, False), (driven.rms_v, True)):
            bars = pyqtgraph.BarGraphItem(
                x=np.arange(count), y0=0.0, height=values, width=2 * _BAR * (0.6 if filled else 1.0),
                pens=[pyqtgraph.mkPen(colour) for colour in colours],
                brushes=[pyqtgraph.mkBrush(colour if filled else theme.base) for colour in colours],
            )  # fmt: skip
            plot.addItem(bars)
        top = largest = max(float(driven.peak_v.max(initial=0.0)), 1e-12)
        for limit_v, style in (
            (driven.limits.peak_v, Qt.PenStyle.DashLine), (driven.limits.rms_v, Qt.PenStyle.DotLine)
        ):  # fmt: skip
            # A limit that is far away would make all bars small.
            if limit_v is not None and limit_v <= _FAR * largest:
                pen = pyqtgraph.mkPen(theme.fault, width=1.5, style=style)
                plot.addItem(pyqtgraph.InfiniteLine(limit_v, angle=0, pen=pen))
                top = max(top, limit_v)
        plot.getAxis("bottom").setTicks([whole_ticks(count, 7), []])
        plot.setXRange(-0.7, count - 0.3, padding=0.0)
        plot.setYRange(0.0, _ROOM * top, padding=0.0)


class GainPlot(Plot):
    """n(x) along the paths."""

    def __init__(self) -> None:
        super().__init__("n(x) along the paths", "time (s)", "n(x) (dB)", axis_px=_NARROW_PX)
        self.setToolTip("n(x) of eq. (15) relative to its largest: low where the surface is focused on easily")

    def show_driven(self, driven: DriveResult) -> None:
        plot, theme = self.getPlotItem(), self.theme
        known = np.isfinite(driven.gain) & (driven.gain > 0)
        if not known.any():
            return
        level_db = 20 * np.log10(driven.gain[known] / driven.gain[known].max())
        plot.plot(
            driven.gain_s[known], level_db, pen=None, symbol="o", symbolSize=4, symbolPen=None,
            symbolBrush=pyqtgraph.mkBrush(theme.traces[2]),
        )  # fmt: skip
        first, last = float(driven.gain_s[known][0]), float(driven.gain_s[known][-1])
        plot.setXRange(first, max(last, first + 1e-3), padding=0.03)
        plot.setYRange(min(-3.0, float(level_db.min()) - 1.0), 1.0, padding=0.0)


_SIGNED, _MAGNITUDE = "response", "magnitude"


class FieldView(Themed, QWidget):
    """Shows one field."""

    def __init__(self) -> None:
        super().__init__()
        self.driven: DriveResult | None = None
        self.predicted: PredictedField | None = None
        self.map = FieldMap("response")
        self.slider = TimeSlider()
        tip = "Signed responses in two colours, or magnitudes in one"
        self.colours = ui.choice("Colours", tip, [_SIGNED, _MAGNITUDE])
        tip = "End of the colour scale, as a part of the largest response at a focus (%)"
        self.span = ui.number_box("End of the colour scale", tip, " %", 0, 1.0, 1000.0, value=100.0, prefix="to ")
        self.note = ui.label(role="faint", any_width=True)
        self.waveform = ResponsePlot()
        # The slider's own row is as wide as the panel without the speed.
        choices = ui.row(self.colours, self.span, self.slider.slower, (self.note, 1), margins=(4, 4, 4, 0))
        upper = QWidget()
        ui.column(choices, (self.map, 1), self.map.bar, self.slider, owner=upper, spacing=3)
        ui.column(ui.stacked((upper, 420), (self.waveform, 130), growing=[0]), owner=self)
        self.slider.moved.connect(self._show_instant)
        self.map.picked.connect(self.show_position)
        self.colours.currentIndexChanged.connect(self._rescale)
        self.span.valueChanged.connect(self._rescale)

    def show_field(self, driven: DriveResult, predicted: PredictedField) -> None:
        """Show another field, at the same instant, position and part of the surface as far as it has them."""
        former, view, marked = self.predicted, self.map.box.viewRect(), self.map.marked
        at_s = None if former is None else self.slider.time_s
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
        self.waveform.show_time(self.slider.time_s)

    def redraw(self) -> None:
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
        unit = "" if predicted is None else predicted.unit
        levels = (-top if signed else 0.0, top)
        self.map.show_scale(self.colours.currentText(), levels, unit, (signed, True), signed=signed)
        self._show_instant(self.slider.sample)

    def _show_instant(self, sample: int) -> None:
        predicted = self.predicted
        if predicted is None:
            return
        values = interpolate_frame(predicted.field, sample / predicted.finer)
        self.map.show_values(values if self.map.signed else np.abs(values))
        self.map.show_sources(self.sources_mm(self.slider.time_s))
        self.waveform.show_time(self.slider.time_s)


class ResponsePlot(Plot):
    """The response of one position."""

    def __init__(self) -> None:
        super().__init__("Response of the position that was clicked", "time (s)", "", axis_px=60)
        self.curve, self._now = decimating_curve(), pyqtgraph.InfiniteLine(0.0)
        for item in (self.curve, self._now):
            self.getPlotItem().addItem(item)
        self.clear_response()

    def clear_response(self) -> None:
        self.curve.setData([], [])
        self._now.hide()
        self.title("click a position on the map for its response", faint=True, size="9pt")

    def show_response(self, title: str, response: NDArray[np.float32], predicted: PredictedField) -> None:
        plot, theme = self.getPlotItem(), self.theme
        time_s = predicted.start_s + np.arange(len(response)) / predicted.sample_rate_hz
        self.curve.setData(time_s, np.ascontiguousarray(response), pen=pyqtgraph.mkPen(theme.traces[0]))
        self._now.setPen(pyqtgraph.mkPen(theme.fault, width=1.2))
        self._now.show()
        plot.setLabel("left", predicted.unit)
        largest = float(np.abs(response).max(initial=0.0))
        self.title(f"{title}: largest {quantity(f'{largest:.3g}', predicted.unit)}", size="9pt")
        plot.setXRange(float(time_s[0]), float(time_s[-1]), padding=0.01)
        plot.setYRange(-1.1 * (largest or 1.0), 1.1 * (largest or 1.0), padding=0.0)

    def show_time(self, time_s: float) -> None:
        """Mark the instant that the map shows."""
        self._now.setValue(time_s)
