"""The player of films: maps of fields on one surface over one time slider, and the response of a position."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QSignalBlocker, Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QHideEvent, QKeyEvent, QMouseEvent
from PyQt5.QtWidgets import QComboBox, QSlider, QStyle, QToolButton, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import FieldMap, Plot, Real, scaled_unit
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.surface_view import NOWHERE_MM
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.units import quantity

# Waves of some hundred hertz can be followed by eye at about 1/1000 of real time.
SLOWER = (1, 10, 50, 100, 200, 500, 1000, 2000, 5000)
_WAYS = {Qt.Key.Key_PageUp: 1, Qt.Key.Key_PageDown: -1}


class TimeSlider(QWidget):
    """Chooses a sample of a field, and plays it in slow motion until it is hidden.

    clock: Seconds that only grow, for tests.
    """

    #: The sample to be shown, 0 for the first of the field.
    moved = pyqtSignal(int)

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self.setAccessibleName("Time")
        self._clock = clock
        self._start_s, self._rate_hz = 0.0, 1.0
        self._marks: NDArray[np.int64] = np.zeros(0, np.int64)
        self._exact = self._shown_at_s = 0.0
        self.slider = _Slider(Qt.Orientation.Horizontal)
        self.slider.setAccessibleName("Instant of the field")
        self.slider.setMinimumWidth(120)
        self.slider.setToolTip("Arrow keys: one sample; Space: play")
        self.previous = _button("|◀", "Previous focus instant (Page Down)", lambda: self.to_mark(-1))
        self.play = _button("▶", "Play (Space)", self._toggle)
        self.next = _button("▶|", "Next focus instant (Page Up)", lambda: self.to_mark(1))
        self.slower = ui.named(QComboBox(), "How many times slower than real time the field is played", "Playing speed")
        for factor in SLOWER:
            self.slower.addItem("real time" if factor == 1 else f"{factor} × slower", factor)
        self.slower.setCurrentIndex(SLOWER.index(200))
        self.time_label = ui.label("Time shown")
        ui.row(self.previous, self.play, self.next, (self.slider, 1), self.time_label, self.slower, owner=self)
        self._timer = QTimer(self)  # active while it plays
        self._timer.setInterval(50)
        self._timer.timeout.connect(self.advance)
        self.slider.valueChanged.connect(self._moved)
        self.slider.pressed.connect(lambda key: self._toggle() if key == Qt.Key.Key_Space else self.to_mark(_WAYS[key]))
        self.show_samples(0.0, 1.0, 0)

    @property
    def sample(self) -> int:
        return self.slider.value()

    @property
    def time_s(self) -> float:
        """Its time on the scene's clock."""
        return self._start_s + self.sample / self._rate_hz

    @property
    def playing(self) -> bool:
        return self._timer.isActive()

    def show_samples(
        self, start_s: float, sample_rate_hz: float, samples: int, marks: Sequence[int] | NDArray[np.int64] = ()
    ) -> None:
        """Show another field, at its first mark or else its first sample.

        start_s: Time of sample 0.
        sample_rate_hz: Rate, > 0.
        samples: Number of samples; 0 disables everything.
        marks: Samples to go to with the buttons, in any order.
        """
        self.pause()
        self._start_s, self._rate_hz = start_s, sample_rate_hz
        inside = np.unique(np.asarray(marks, np.int64))
        self._marks = inside[(inside >= 0) & (inside < samples)]
        with QSignalBlocker(self.slider):
            self.slider.setRange(0, max(0, samples - 1))
            self.slider.setValue(int(self._marks[0]) if len(self._marks) else 0)
        self.setEnabled(samples > 1)
        for button in (self.previous, self.next):
            button.setEnabled(len(self._marks) > 0)
        # A fixed width: else each new text would lay out the whole window again.
        widest = f"{-1e3 * max(abs(start_s), abs(start_s + samples / sample_rate_hz)):.2f} ms"
        self.time_label.setFixedWidth(self.time_label.fontMetrics().horizontalAdvance(widest) + 8)
        self._moved(self.sample)

    def go_to(self, sample: int) -> None:
        self.slider.setValue(sample)

    def to_mark(self, way: int) -> None:
        """Go to the next mark (1) or the previous one (-1), and from the last one to the first."""
        if len(self._marks):
            place = np.searchsorted(self._marks, self.sample, side="right" if way > 0 else "left")
            self.go_to(int(self._marks[(place if way > 0 else place - 1) % len(self._marks)]))

    def pause(self) -> None:
        self._timer.stop()
        self.play.setText("▶")

    def _toggle(self) -> None:
        """Play, or pause."""
        if self.playing:
            self.pause()
            return
        if self.sample >= self.slider.maximum():
            self.go_to(0)
        self._exact, self._shown_at_s = float(self.sample), self._clock()
        self._timer.start()
        self.play.setText("▮▮")

    def advance(self) -> None:
        """Show the sample that is due by the clock."""
        now_s = self._clock()
        step = (now_s - self._shown_at_s) * self._rate_hz / int(self.slower.currentData())
        self._shown_at_s = now_s
        if round(self._exact) != self.sample:  # moved by hand meanwhile
            self._exact = float(self.sample)
        self._exact += step
        if self._exact > self.slider.maximum():
            self._exact = 0.0
        self.go_to(round(self._exact))

    def hideEvent(self, event: QHideEvent | None) -> None:  # noqa: N802
        super().hideEvent(event)
        self.pause()

    def _moved(self, sample: int) -> None:
        self.time_label.setText(f"{self.time_s * 1e3:.2f} ms")
        self.moved.emit(sample)


class _Slider(QSlider):
    """Reports keys that mean something else than on other sliders; a click moves the handle there at once."""

    pressed = pyqtSignal(int)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        style = self.style()
        if event is not None and style is not None and event.button() == Qt.MouseButton.LeftButton:
            handle_px = style.pixelMetric(QStyle.PixelMetric.PM_SliderLength, None, self)
            at_px, span_px = event.pos().x() - handle_px // 2, max(1, self.width() - handle_px)
            self.setValue(QStyle.sliderValueFromPosition(self.minimum(), self.maximum(), at_px, span_px))
        super().mousePressEvent(event)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        if event is not None and event.key() in (Qt.Key.Key_Space, *_WAYS):
            self.pressed.emit(event.key())
        else:
            super().keyPressEvent(event)


def _button(text: str, tip: str, act: Callable[[], object]) -> QToolButton:
    button = ui.tool_button(text, tip, act, tip.partition(" (")[0])
    button.setAutoRaise(True)
    return button


Frame = NDArray[np.floating[Any]]
NO_VALUES = np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Fields of one surface over time.

    start_s, sample_rate_hz, samples: Time of the first sample, rate and number of samples of all of them.
    frames: Returns the values of each map at a sample, (positions,).
    sources_mm: Returns the places of the sources at a time, (sources, 2).
    marks, int64 (foci,): Samples of the focus instants.
    response: Returns a title and the responses (samples,) of a position, by its place on the surface.
    unit: Of the responses.
    scales: Title of the colours of each map, and the value at their ends.
    """

    surface: PlotSurface
    start_s: float
    sample_rate_hz: float
    samples: int
    frames: Callable[[int], Sequence[Frame]]
    sources_mm: Callable[[float], Float64Array]
    marks: NDArray[np.int64]
    response: Callable[[int], tuple[str, Sequence[Real]]]
    unit: str
    scales: Sequence[tuple[str, float]]


class _ResponsePlot(Plot):
    """The responses of one position.

    looks: Number of the colour and width of each line.
    """

    def __init__(self, looks: Sequence[tuple[int, float]]) -> None:
        super().__init__("Response of the position that was clicked", "time (s)", "", axis_px=64)
        self.setMinimumHeight(90)
        self.getPlotItem().setClipToView(True)
        self.curves = [self.line(NO_VALUES, NO_VALUES, self.theme.trace(colour), width) for colour, width in looks]
        self.now = self.getPlotItem().addLine(x=0.0, pen=pyqtgraph.mkPen(self.theme.fault, width=1.2))
        self.clear_response()

    def clear_response(self) -> None:
        for curve in self.curves:
            curve.setData(NO_VALUES, NO_VALUES)
        self.now.hide()
        self.title("click a position on the map for its response", faint=True, size="9pt")

    def show_response(self, title: str, unit: str, time_s: Float64Array, lines: Sequence[Real]) -> None:
        """Draw the lines; one that is not known, NaN, is left out."""
        known = [bool(np.isfinite(line).all()) for line in lines]
        largest = max((float(np.abs(line).max()) for line, one in zip(lines, known, strict=True) if one), default=0.0)
        factor, unit = scaled_unit(unit, largest)
        for curve, line, one in zip(self.curves, lines, known, strict=True):
            curve.setData(*((time_s, factor * line) if one else (NO_VALUES, NO_VALUES)))
        self.now.show()
        self.getPlotItem().setLabel("left", unit)
        self.title(title, size="9pt")
        self.setToolTip(f"{title}: largest {quantity(f'{factor * largest:.3g}', unit)}")
        self.getPlotItem().setXRange(float(time_s[0]), float(time_s[-1]), padding=0.01)
        end = 1.1 * factor * (largest or 1.0)
        self.getPlotItem().setYRange(-end, end, padding=0.0)


class FilmPlayer(Themed, QWidget):
    """Shows a film; the owner lays out `maps`, `time` and `response`.

    names: Of the maps.
    looks: Of the lines of a position, as of `_ResponsePlot`.
    """

    def __init__(self, names: Sequence[str], looks: Sequence[tuple[int, float]]) -> None:
        super().__init__()
        self.film: Film | None = None
        self.maps = [FieldMap(name) for name in names]
        self.time = TimeSlider()
        self.response = _ResponsePlot(looks)
        for one in self.maps:
            one.picked.connect(self.show_position)
            if one is not self.maps[0]:
                one.link(self.maps[0])
        self.time.moved.connect(self._moved)

    def show_film(self, film: Film | None) -> None:
        """Show a film at its first focus instant, or none; of the same bank, the part and the position shown stay."""
        former, marked = self.maps[0].surface, self.marked
        self.film = film
        if film is None:
            self.time.show_samples(0.0, 1.0, 0)
            for one in self.maps:
                one.show_values(np.full(0 if one.surface is None else one.surface.positions, np.nan))
                one.show_sources(NOWHERE_MM)
            self.response.clear_response()
            return
        for one, (title, end) in zip(self.maps, film.scales, strict=True):
            one.show_surface(film.surface)
            one.show_scale(title, end, film.unit)
        same = former is not None and marked >= 0 and former.bank == film.surface.bank
        place = film.surface.raster.nearest(*former.position_mm[marked]) if former is not None and same else -1
        self.time.show_samples(film.start_s, film.sample_rate_hz, film.samples, film.marks)
        self.show_position(place)

    @property
    def marked(self) -> int:
        """Place on the surface of the position that is shown; -1 for none."""
        return self.maps[0].marked

    def show_position(self, place: int) -> None:
        """Mark a position on all maps, and show its response; -1 for none."""
        for one in self.maps:
            one.mark(place)
        film = self.film
        if film is None or not 0 <= place < film.surface.positions:
            self.response.clear_response()
            return
        title, lines = film.response(place)
        time_s = film.start_s + np.arange(film.samples) / film.sample_rate_hz
        self.response.show_response(title, film.unit, time_s, lines)

    def _moved(self, sample: int) -> None:
        if self.film is None:
            return
        sources_mm = self.film.sources_mm(self.time.time_s)
        for one, values in zip(self.maps, self.film.frames(sample), strict=True):
            one.show_values(values)
            one.show_sources(sources_mm)
        self.response.now.setValue(self.time.time_s)
