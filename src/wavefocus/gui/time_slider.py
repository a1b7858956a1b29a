"""A slider over the samples of a field: chosen instants, play in a loop, pause, and the time."""

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QHideEvent, QKeyEvent, QMouseEvent
from PyQt5.QtWidgets import QComboBox, QSlider, QStyle, QToolButton, QWidget

from wavefocus.gui import widgets as ui

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
        self.previous = _button("|◀", "Previous focus instant (Page Down)", lambda: self.to_mark(-1))
        self.play = _button("▶", "Play (Space)", self.toggle)
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
        self.slider.pressed.connect(lambda key: self.toggle() if key == Qt.Key.Key_Space else self.to_mark(_WAYS[key]))
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
        self.slider.blockSignals(True)
        self.slider.setRange(0, max(0, samples - 1))
        self.slider.setValue(int(self._marks[0]) if len(self._marks) else 0)
        self.slider.blockSignals(False)
        self.setEnabled(samples > 1)
        for button in (self.previous, self.next):
            button.setEnabled(len(self._marks) > 0)
        ends_ms = (1e3 * start_s, 1e3 * (start_s + max(0, samples - 1) / sample_rate_hz))
        self.slider.setToolTip("{:.1f} ms to {:.1f} ms; arrow keys: one sample; Space: play".format(*ends_ms))
        # A fixed width: else each new text would lay out the whole window again.
        widest = max((f"{end_ms:.2f} ms" for end_ms in ends_ms), key=len)
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

    def toggle(self) -> None:
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
