"""A slider over the samples of a field: marks at chosen instants, play, pause, loop, and the time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import QEvent, QLine, Qt, QTimer, pyqtSignal
from PyQt5.QtGui import QColor, QHideEvent, QIcon, QMouseEvent, QPainter, QPaintEvent, QPixmap
from PyQt5.QtWidgets import QComboBox, QSizePolicy, QSlider, QStyle, QStyleOptionSlider, QToolButton, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.theme import Themed

FRAME_EVERY_MS = 50
# Waves of some hundred hertz can be followed by eye at about 1/1000 of real time.
SLOWER = (1, 10, 50, 100, 200, 500, 1000, 2000, 5000)
_USUALLY_SLOWER = 200
_ICON_PX = 32
_ICONS = {
    "play": QStyle.StandardPixmap.SP_MediaPlay,
    "pause": QStyle.StandardPixmap.SP_MediaPause,
    "previous": QStyle.StandardPixmap.SP_MediaSkipBackward,
    "next": QStyle.StandardPixmap.SP_MediaSkipForward,
    "loop": QStyle.StandardPixmap.SP_BrowserReload,
}


class TimeSlider(Themed, QWidget):
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
        self._widest = ""
        self.slider = _MarkedSlider()
        self.previous = _button("Previous focus instant (Page Down)", lambda: self.to_mark(-1))
        self.play = _button("Play (Space)", checkable=True)
        self.next = _button("Next focus instant (Page Up)", lambda: self.to_mark(1))
        self.loop = _button("Loop: start again at the end", checkable=True)
        self.loop.setChecked(True)
        self.slower = ui.named(QComboBox(), "How many times slower than real time the field is played", "Playing speed")
        for factor in SLOWER:
            self.slower.addItem("real time" if factor == 1 else f"{factor} × slower", factor)
        self.slower.setCurrentIndex(SLOWER.index(_USUALLY_SLOWER))
        self.time_label = ui.label("Time shown")
        self.time_label.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        buttons = (self.previous, self.play, self.next, self.loop)
        ui.row(*buttons, (self.slider, 1), self.time_label, self.slower, owner=self)
        self._timer = QTimer(self)
        self._timer.setInterval(FRAME_EVERY_MS)
        self._timer.timeout.connect(self.advance)
        self.slider.valueChanged.connect(self._moved)
        self.play.toggled.connect(self._toggled)
        self.slider.mark_requested.connect(self.to_mark)
        self.slider.play_requested.connect(self.play.toggle)
        self.show_samples(0.0, 1.0, 0)
        self.redraw()

    @property
    def sample(self) -> int:
        return self.slider.value()

    @property
    def time_s(self) -> float:
        """Its time on the scene's clock."""
        return self._start_s + self.sample / self._rate_hz

    @property
    def playing(self) -> bool:
        return self.play.isChecked()

    def show_samples(
        self, start_s: float, sample_rate_hz: float, samples: int, marks: Sequence[int] | NDArray[np.int64] = ()
    ) -> None:
        """Show another field, at its first mark or else its first sample.

        start_s: Time of sample 0.
        sample_rate_hz: Rate, > 0.
        samples: Number of samples; 0 disables everything.
        marks: Samples to be marked, in any order.
        """
        self.pause()
        self._start_s, self._rate_hz = start_s, sample_rate_hz
        inside = np.unique(np.asarray(marks, np.int64))
        self._marks = inside[(inside >= 0) & (inside < samples)]
        self.slider.marks = self._marks.tolist()
        self.slider.blockSignals(True)
        self.slider.setRange(0, max(0, samples - 1))
        self.slider.setValue(int(self._marks[0]) if len(self._marks) else 0)
        self.slider.blockSignals(False)
        self.setEnabled(samples > 1)
        for button in (self.previous, self.next):
            button.setEnabled(len(self._marks) > 0)
        end_s = start_s + max(0, samples - 1) / sample_rate_hz
        self._widest = max((_in_ms(start_s), _in_ms(end_s)), key=len)
        self._size_time_label()
        self.slider.setToolTip(
            f"{start_s * 1e3:.1f} ms to {end_s * 1e3:.1f} ms; arrow keys: one sample of {1e3 / sample_rate_hz:.3g} ms; "
            "Space: play"
        )
        self._moved(self.sample)

    def go_to(self, sample: int) -> None:
        self.slider.setValue(sample)

    def to_mark(self, way: int) -> None:
        """Go to the next mark (1) or the previous one (-1), and from the last one to the first."""
        if len(self._marks):
            place = np.searchsorted(self._marks, self.sample, side="right" if way > 0 else "left")
            self.go_to(int(self._marks[(place if way > 0 else place - 1) % len(self._marks)]))

    def pause(self) -> None:
        self.play.setChecked(False)

    def advance(self) -> None:
        """Show the sample that is due by the clock."""
        now_s = self._clock()
        step = (now_s - self._shown_at_s) * self._rate_hz / int(self.slower.currentData())
        self._shown_at_s = now_s
        if round(self._exact) != self.sample:  # moved by hand meanwhile
            self._exact = float(self.sample)
        self._exact += step
        if self._exact > self.slider.maximum():
            if not self.loop.isChecked():
                self.go_to(self.slider.maximum())
                self.pause()
                return
            self._exact = 0.0
        self.go_to(round(self._exact))

    def redraw(self) -> None:
        self.slider.update()
        names = ("previous", "pause" if self.playing else "play", "next", "loop")
        for button, name in zip((self.previous, self.play, self.next, self.loop), names, strict=True):
            button.setIcon(self._icon(name))

    def hideEvent(self, event: QHideEvent | None) -> None:  # noqa: N802
        super().hideEvent(event)
        self.pause()

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802
        super().changeEvent(event)
        if event is not None and event.type() == QEvent.Type.FontChange:
            self._size_time_label()

    def _size_time_label(self) -> None:
        """Give the label a fixed size: else each new text would lay out the whole window again."""
        metrics = self.time_label.fontMetrics()
        self.time_label.setFixedSize(metrics.horizontalAdvance(self._widest) + 8, metrics.height() + 4)

    def _toggled(self, plays: bool) -> None:
        self.play.setIcon(self._icon("pause" if plays else "play"))
        self.play.setToolTip("Pause (Space)" if plays else "Play (Space)")
        self.play.setAccessibleName("Pause" if plays else "Play")
        if plays:
            if self.sample >= self.slider.maximum():
                self.go_to(0)
            self._exact, self._shown_at_s = float(self.sample), self._clock()
            self._timer.start()
        else:
            self._timer.stop()

    def _moved(self, sample: int) -> None:
        self.time_label.setText(_in_ms(self.time_s))
        self.moved.emit(sample)

    def _icon(self, name: str) -> QIcon:
        """The style's icon in the colour of text: Qt's own are dark in a dark window, too."""
        style, theme = self.style(), self.theme
        assert style is not None
        picture: QPixmap = style.standardIcon(_ICONS[name]).pixmap(_ICON_PX)
        icon = QIcon()
        for mode, state, colour in (
            (QIcon.Mode.Normal, QIcon.State.Off, theme.text),
            (QIcon.Mode.Normal, QIcon.State.On, theme.window),  # a checked button has the accent's colour
            (QIcon.Mode.Disabled, QIcon.State.Off, theme.faint),
            (QIcon.Mode.Disabled, QIcon.State.On, theme.faint),
        ):
            tinted = QPixmap(picture)
            painter = QPainter(tinted)
            painter.setCompositionMode(QPainter.CompositionMode.CompositionMode_SourceIn)
            painter.fillRect(tinted.rect(), QColor(colour))
            painter.end()
            icon.addPixmap(tinted, mode, state)
        return icon


class _MarkedSlider(Themed, QSlider):
    """A slider with marks along its groove; a click moves the handle there at once."""

    mark_requested = pyqtSignal(int)
    play_requested = pyqtSignal()

    def __init__(self) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self.setAccessibleName("Instant of the field")
        self.marks: list[int] = []
        self.setMinimumWidth(120)
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def paintEvent(self, event: QPaintEvent | None) -> None:  # noqa: N802
        painter = QPainter(self)
        painter.setPen(QColor(self.theme.accent))
        handle, span = self._geometry()
        foot = self.height() - 1
        for mark in self.marks:
            x = handle // 2 + QStyle.sliderPositionFromValue(self.minimum(), self.maximum(), mark, span)
            painter.drawLines(QLine(x, 0, x, 5), QLine(x, foot - 5, x, foot))
        painter.end()
        super().paintEvent(event)

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802
        if event is not None and event.button() == Qt.MouseButton.LeftButton:
            handle, span = self._geometry()
            at = event.pos().x() - handle // 2
            self.setValue(QStyle.sliderValueFromPosition(self.minimum(), self.maximum(), at, span))
        super().mousePressEvent(event)

    def keyPressEvent(self, event) -> None:  # type: ignore[no-untyped-def]  # noqa: N802
        ways = {Qt.Key.Key_PageUp: 1, Qt.Key.Key_PageDown: -1}
        if event.key() in ways:
            self.mark_requested.emit(ways[event.key()])
        elif event.key() == Qt.Key.Key_Space:
            self.play_requested.emit()
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


def _button(tip: str, act: Callable[[], object] | None = None, *, checkable: bool = False) -> QToolButton:
    button = ui.tool_button("", tip, act, tip.partition(" (")[0], checkable=checkable)
    button.setAutoRaise(True)
    return button


def _in_ms(time_s: float) -> str:
    return f"{time_s * 1e3:.2f} ms"
