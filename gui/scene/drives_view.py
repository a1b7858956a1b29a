"""The drives: traces of all actuators, their levels with the limits, and n(x) along the paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QSize, Qt
from PyQt5.QtWidgets import QCheckBox, QComboBox, QHBoxLayout, QLabel, QSizePolicy, QVBoxLayout, QWidget

from gui.field_map import Plot, Real, thinning_curve, whole_ticks
from gui.scene.messages import Driven
from gui.theme import Theme
from gui.widgets import named, side_by_side, stacked
from storage.units import quantity

_STEP = 0.45  # the loudest trace fills so much of the distance to its neighbours, up and down
_BAR = 0.36
_ROOM = 1.15
_FAR = 3.0
_AXIS_PX, _NARROW_PX = 58, 44


class DrivesView(QWidget):
    """Shows the drives of all actuators."""

    def __init__(self) -> None:
        super().__init__()
        self.driven: Driven | None = None
        tip = "All drives, or the drive of one actuator with its limit (V)"
        self.actuator = named(QComboBox(), tip, "Actuator shown")
        self.actuator.addItem("all actuators")
        tip = "Draw each actuator's drive to its own peak, so that weak ones are seen, too"
        self.own_scale = named(QCheckBox("own scale"), tip, "Each drive to its own peak")
        self.note = QLabel()
        self.note.setProperty("role", "faint")
        self.note.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.traces = TracePlot()
        self.levels = LevelPlot()
        self.gains = GainPlot()
        lower = side_by_side((self.levels, 280), (self.gains, 200))
        both = stacked((self.traces, 330), (lower, 180), growing=[0])
        row = QHBoxLayout()
        row.setContentsMargins(4, 4, 4, 2)
        row.addWidget(self.actuator)
        row.addWidget(self.own_scale)
        row.addWidget(self.note, stretch=1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(2)
        column.addLayout(row)
        column.addWidget(both, stretch=1)
        self.actuator.currentIndexChanged.connect(self._draw)
        self.own_scale.toggled.connect(self._draw)

    def sizeHint(self) -> QSize:  # noqa: N802
        return QSize(480, 300)

    def show_driven(self, driven: Driven | None) -> None:
        """Show drives, or none."""
        self.driven = driven
        count = 0 if driven is None else len(driven.drive_v)
        if driven is not None and self.actuator.count() != count + 1:
            chosen = min(self.actuator.currentIndex(), count)
            self.actuator.blockSignals(True)
            self.actuator.clear()
            self.actuator.addItems(["all actuators", *(f"actuator {number}" for number in range(count))])
            self.actuator.setCurrentIndex(chosen)
            self.actuator.blockSignals(False)
        self._draw()

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        for plot in (self.traces, self.levels, self.gains):
            plot.apply_theme(theme)
        self._draw()

    def _draw(self) -> None:
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
        super().__init__("Drives of all actuators", "time (s)", "actuator")
        self._ends = 0.0, 0.0
        self._curves: list[pyqtgraph.PlotDataItem] = []
        self._limits = [pyqtgraph.InfiniteLine(angle=0), pyqtgraph.InfiniteLine(angle=0)]
        self._zero = pyqtgraph.InfiniteLine(0.0)
        self._zero.setZValue(-1)
        plot = self.getPlotItem()
        plot.getAxis("left").setWidth(_AXIS_PX)
        for line in (*self._limits, self._zero):
            line.hide()
            plot.addItem(line)

    def show_driven(self, driven: Driven | None, chosen: int, *, own_scale: bool = False) -> None:
        plot, theme = self.getPlotItem(), self.theme
        self._zero.setPen(pyqtgraph.mkPen(theme.faint, style=Qt.PenStyle.DotLine))
        self._zero.setVisible(driven is not None)
        if driven is None:
            self._show_curves(np.zeros(0), [], 1.0)
            self._show_limit(None)
            plot.setTitle("no drives to show", color=theme.faint, size="9pt")
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
        plot.setTitle(title, color=theme.text, size="9pt")
        # A zoomed view stays while the scene is edited.
        ends = float(time_s[0]), float(time_s[-1])
        if ends != self._ends:
            self._ends = ends
            plot.setXRange(*ends, padding=0.01)

    def _show_curves(self, x: Real, curves: Sequence[Real], width: float) -> None:
        """Curves are reused: thinned ones cannot be taken out of a plot."""
        pen = pyqtgraph.mkPen(self.theme.traces[0], width=width)
        while len(self._curves) < len(curves):
            self._curves.append(thinning_curve())
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
        super().__init__("Peak and rms of each actuator", "actuator", "level (V)")
        self.getPlotItem().getAxis("left").setWidth(_AXIS_PX)
        self.setToolTip(
            "Level of each actuator's drive (V): outlined the peak, filled the rms over 1 s;"
            " dashed the limit of the peak, dotted that of the rms"
        )

    def show_driven(self, driven: Driven, chosen: int) -> None:
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
        super().__init__("n(x) along the paths", "time (s)", "n(x) (dB)")
        self.getPlotItem().getAxis("left").setWidth(_NARROW_PX)
        self.setToolTip("n(x) of eq. (15) relative to its largest: low where the surface is focused on easily")

    def show_driven(self, driven: Driven) -> None:
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
