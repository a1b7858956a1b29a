"""A slider over the samples of a field: marks at chosen instants, play, pause, loop, and the time in milliseconds."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import QEvent, QLine, Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QColor, QHideEvent, QMouseEvent, QPainter, QPaintEvent
from PyQt5.QtWidgets import (
    QComboBox,
    QHBoxLayout,
    QLabel,
    QSizePolicy,
    QSlider,
    QStyle,
    QStyleOptionSlider,
    QToolButton,
    QWidget,
)

from gui.shell.theme import LIGHT, Theme
from gui.surface.player_icons import player_icon

FRAME_EVERY_MS = 50
# How many times slower than life; waves of some hundred hertz can be followed with the eyes from about 1000 on.
SLOWER = (1, 10, 50, 100, 200, 500, 1000, 2000, 5000)
_USUALLY_SLOWER = 200


class TimeSlider(QWidget):
    """Chooses a sample of a field; plays it slower than life.

    Set the samples with ``show_samples``; ``moved`` tells each new sample, whoever moved it.
    While it plays it goes on twenty times a second, and stops when it is hidden.

    Parameters
    ----------
    mark_word : str
        What a mark is, for tooltips: "focus instant".
    """

    #: The sample that is to be shown, 0 for the first of the field.
    moved = pyqtSignal(int)

    def __init__(self, mark_word: str = "focus instant") -> None:
        super().__init__()
        self.setAccessibleName("Time")
        self._start_s = 0.0
        self._rate_hz = 1.0
        self._marks: NDArray[np.int64] = np.zeros(0, np.int64)
        self._exact = 0.0
        self._looked_s = 0.0
        self._widest = ""
        self.slider = _MarkedSlider()
        self.slider.setAccessibleName("Instant of the field")
        self.back = _button("back", f"The {mark_word} before (Page Down)")
        self.play = _button("play", "Play (Space)")
        self.play.setCheckable(True)
        self.on = _button("on", f"The next {mark_word} (Page Up)")
        self.loop = _button("loop", "Start anew at the end")
        self.loop.setCheckable(True)
        self.loop.setChecked(True)
        self.slower = QComboBox()
        self.slower.setAccessibleName("How many times slower than life it plays")
        self.slower.setToolTip("How many times slower than life it plays")
        for factor in SLOWER:
            self.slower.addItem("as in life" if factor == 1 else f"{factor} × slower", factor)
        self.slower.setCurrentIndex(SLOWER.index(_USUALLY_SLOWER))
        self.read_out = QLabel()
        self.read_out.setAccessibleName("Time shown")
        self.read_out.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        for part in (self.back, self.play, self.on, self.loop):
            row.addWidget(part)
        row.addWidget(self.slider, stretch=1)
        row.addWidget(self.read_out)
        row.addWidget(self.slower)
        self._timer = QTimer(self)
        self._timer.setInterval(FRAME_EVERY_MS)
        self._timer.timeout.connect(self._go_on)
        self.slider.valueChanged.connect(self._moved)
        self.play.toggled.connect(self._toggled)
        self.back.clicked.connect(lambda: self.to_mark(-1))
        self.on.clicked.connect(lambda: self.to_mark(1))
        self.slider.wants_mark.connect(self.to_mark)
        self.slider.wants_play.connect(self.play.toggle)
        self.show_samples(0.0, 1.0, 0)

    @property
    def sample(self) -> int:
        """The sample shown."""
        return self.slider.value()

    @property
    def time_s(self) -> float:
        """Its time on the scene's clock."""
        return self._start_s + self.sample / self._rate_hz

    @property
    def playing(self) -> bool:
        """Whether it plays."""
        return self.play.isChecked()

    def show_samples(
        self, start_s: float, sample_rate_hz: float, samples: int, marks: Sequence[int] | NDArray[np.int64] = ()
    ) -> None:
        """Take up another field and go to its first mark, or its first sample.

        Parameters
        ----------
        start_s : float
            Time of sample 0.
        sample_rate_hz : float
            Rate, > 0.
        samples : int
            How many; 0 disables everything.
        marks : sequence of int
            Samples to be marked, in any order.
        """
        self.pause()
        self._start_s, self._rate_hz = start_s, sample_rate_hz
        inside = np.unique(np.asarray(marks, np.int64))
        self._marks = inside[(inside >= 0) & (inside < samples)]
        self.slider.marks = self._marks.tolist()
        self.slider.blockSignals(True)
        self.slider.setRange(0, max(0, samples - 1))
        self.slider.setSingleStep(1)
        self.slider.setValue(int(self._marks[0]) if len(self._marks) else 0)
        self.slider.blockSignals(False)
        self.setEnabled(samples > 1)
        for button in (self.back, self.on):
            button.setEnabled(len(self._marks) > 0)
        end_s = start_s + max(0, samples - 1) / sample_rate_hz
        self._widest = max((_read_out(start_s), _read_out(end_s)), key=len)
        self._size_read_out()
        self.slider.setToolTip(
            f"{start_s * 1e3:.1f} ms to {end_s * 1e3:.1f} ms; the arrow keys go by one sample of "
            f"{1e3 / sample_rate_hz:.3g} ms, Space plays"
        )
        self._moved(self.slider.value())

    def go_to(self, sample: int) -> None:
        """Show a sample."""
        self.slider.setValue(sample)

    def to_mark(self, way: int) -> None:
        """Go to the next mark after (1), or before (-1), what is shown; round at the ends."""
        if not len(self._marks):
            return
        here = self.sample
        if way > 0:
            after = self._marks[self._marks > here]
            self.go_to(int(after[0] if len(after) else self._marks[0]))
        else:
            before = self._marks[self._marks < here]
            self.go_to(int(before[-1] if len(before) else self._marks[-1]))

    def pause(self) -> None:
        """Stand still."""
        self.play.setChecked(False)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.slider.theme = theme
        self.slider.update()
        play = "pause" if self.playing else "play"
        for button, sign in ((self.back, "back"), (self.play, play), (self.on, "on"), (self.loop, "loop")):
            button.setIcon(player_icon(sign, theme))

    def hideEvent(self, event: QHideEvent | None) -> None:  # noqa: N802
        """Nobody looks: stand still."""
        super().hideEvent(event)
        self.pause()

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802
        """Make room for larger text."""
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.FontChange:
            self._size_read_out()

    def _size_read_out(self) -> None:
        """Of one size, whatever it says: else each text would lay out, and draw, the whole window anew."""
        metrics = self.read_out.fontMetrics()
        self.read_out.setFixedSize(metrics.horizontalAdvance(self._widest) + 8, metrics.height() + 4)

    def _toggled(self, plays: bool) -> None:
        self.play.setIcon(player_icon("pause" if plays else "play", self.slider.theme))
        self.play.setToolTip("Pause (Space)" if plays else "Play (Space)")
        self.play.setAccessibleName("Pause" if plays else "Play")
        if plays:
            if self.sample >= self.slider.maximum():
                self.go_to(0)
            self._exact, self._looked_s = float(self.sample), time.monotonic()
            self._timer.start()
        else:
            self._timer.stop()

    def _go_on(self) -> None:
        now_s = time.monotonic()
        step = (now_s - self._looked_s) * self._rate_hz / int(self.slower.currentData())
        self._looked_s = now_s
        if round(self._exact) != self.sample:  # somebody moved it meanwhile
            self._exact = float(self.sample)
        self._exact += step
        last = self.slider.maximum()
        if self._exact > last:
            if not self.loop.isChecked():
                self.go_to(last)
                self.pause()
                return
            self._exact = 0.0
        if round(self._exact) != self.sample:
            self.go_to(round(self._exact))

    def _moved(self, sample: int) -> None:
        self.read_out.setText(_read_out(self.time_s))
        self.moved.emit(sample)


class _MarkedSlider(QSlider):
    """A slider with marks beneath its groove; a click goes there at once."""

    wants_mark = pyqtSignal(int)
    wants_play = pyqtSignal()

    def __init__(self) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self.marks: list[int] = []
        self.theme = LIGHT
        self.setMinimumWidth(120)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def paintEvent(self, event: QPaintEvent | None) -> None:  # noqa: N802
        """Marks first, the handle above them."""
        painter = QPainter(self)
        painter.setPen(QColor(self.theme.accent))
        handle, span = self._geometry()
        low, high, foot = self.minimum(), self.maximum(), self.height() - 1
        lines = []
        for mark in self.marks:
            x = handle // 2 + QStyle.sliderPositionFromValue(low, high, mark, span)
            lines += [QLine(x, 0, x, 5), QLine(x, foot - 5, x, foot)]
        if lines:
            painter.drawLines(*lines)
        painter.end()
        super().paintEvent(event)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        """Go where it was clicked, and on from there by dragging."""
        if event is not None and event.button() == Qt.MouseButton.LeftButton:
            handle, span = self._geometry()
            self.setValue(QStyle.sliderValueFromPosition(
                self.minimum(), self.maximum(), event.pos().x() - handle // 2, span
            ))  # fmt: skip
        super().mousePressEvent(event)

    def keyPressEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        """Page keys go from mark to mark, Space plays."""
        ways = {Qt.Key.Key_PageUp: 1, Qt.Key.Key_PageDown: -1}
        if event.key() in ways:
            self.wants_mark.emit(ways[event.key()])
        elif event.key() == Qt.Key.Key_Space:
            self.wants_play.emit()
        else:
            super().keyPressEvent(event)

    def _geometry(self) -> tuple[int, int]:
        """Width of the handle, and how far it can go, in pixels."""
        option = QStyleOptionSlider()
        self.initStyleOption(option)
        style = self.style()
        assert style is not None
        handle = style.pixelMetric(QStyle.PixelMetric.PM_SliderLength, option, self)
        return handle, max(1, self.width() - handle)


def _button(sign: str, tip: str) -> QToolButton:
    button = QToolButton()
    button.setIcon(player_icon(sign, LIGHT))
    button.setToolTip(tip)
    button.setAccessibleName(tip.partition(" (")[0])
    button.setAutoRaise(True)
    return button


def _read_out(time_s: float) -> str:
    return f"{time_s * 1e3:.2f} ms"
