"""Levels of both inputs as bars in decibels of the range, with the peak held until it is let go."""

from __future__ import annotations

import math

from PyQt5.QtCore import QPointF, QRectF, QSize, Qt
from PyQt5.QtGui import QColor, QPainter, QPaintEvent, QPen, QPolygonF
from PyQt5.QtWidgets import QSizePolicy, QWidget

from gui.rig.facts import ChannelLevel, volts
from gui.shell.theme import LIGHT, Theme

_FLOOR_DB = -100.0
_TICKS_DB = (-80, -60, -40, -20, 0)
_NEAR_END_DB = -3.0


class LevelMeter(QWidget):
    """One bar per input: rms filled, the peak as a line, the highest peak since the last reset as a triangle.

    A click lets the held peaks go.
    """

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self._levels: dict[str, ChannelLevel] = {}
        self._held_v: dict[str, float] = {}
        self._light: float | None = None
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setToolTip("Decibels of the input's range: bar rms, line peak, ▼ highest peak; a click lets it go")
        self.setAccessibleName("Levels: none")

    @property
    def held_v(self) -> dict[str, float]:
        """The highest peak of each input since the last reset, in V."""
        return dict(self._held_v)

    def show_levels(self, reference: ChannelLevel | None, response: ChannelLevel | None, light: float | None) -> None:
        """Show what is heard now; None for nothing."""
        self._levels = {
            name: level for name, level in (("response", response), ("reference", reference)) if level is not None
        }
        for name, level in self._levels.items():
            self._held_v[name] = max(self._held_v.get(name, 0.0), level.peak_v)
        self._light = light
        told = "; ".join(f"{name} {_words(level)}" for name, level in self._levels.items())
        self.setAccessibleName(f"Levels: {told or 'none'}")
        self.update()

    def reset(self) -> None:
        """Let the held peaks go."""
        self._held_v.clear()
        self.update()

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.update()

    def sizeHint(self) -> QSize:  # noqa: N802
        """Two bars with their words, and a scale."""
        line = self.fontMetrics().height()
        return QSize(420, 2 * (2 * line + 6) + line + 4)

    def minimumSizeHint(self) -> QSize:  # noqa: N802
        """As high, and narrow."""
        return QSize(240, self.sizeHint().height())

    def mousePressEvent(self, _event: object) -> None:  # noqa: N802
        """Let the held peaks go."""
        self.reset()

    def paintEvent(self, _event: QPaintEvent | None) -> None:  # noqa: N802
        """Draw it."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        line, top = self.fontMetrics().height(), 0
        for name in ("response", "reference"):
            self._paint_words(painter, name, top, line)
            bar = QRectF(0, top + line + 1, self.width() - 1, line)
            self._paint_bar(painter, name, bar)
            top += 2 * line + 6
        painter.setPen(QColor(self._theme.faint))
        for tick_db in _TICKS_DB:
            x = self._x(tick_db)
            words = f"{tick_db} dB" if tick_db else "0 dB"
            width = self.fontMetrics().horizontalAdvance(words)
            painter.drawText(int(min(max(0, x - width / 2), self.width() - width)), top + line - 3, words)

    def _paint_words(self, painter: QPainter, name: str, top: int, line: int) -> None:
        level = self._levels.get(name)
        over = level is not None and level.over_range
        painter.setPen(QColor(self._theme.fault if over else self._theme.text))
        left = QRectF(0, top, self.width(), line)
        words = f"{name}: {_words(level)}" if level is not None else f"{name}: not listened to"
        if name == "response" and self._light is not None:
            words += f"; light {self._light:.0%}"
        painter.drawText(left, Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter, words)

    def _paint_bar(self, painter: QPainter, name: str, bar: QRectF) -> None:
        theme, level = self._theme, self._levels.get(name)
        painter.fillRect(bar, QColor(theme.cell))
        painter.setPen(QColor(theme.grid))
        for tick_db in _TICKS_DB[:-1]:
            painter.drawLine(int(self._x(tick_db)), int(bar.top()), int(self._x(tick_db)), int(bar.bottom()))
        if level is None:
            return
        rms_db, peak_db = (_decibels(value_v, level.range_v) for value_v in (level.rms_v, level.peak_v))
        colour = theme.fault if level.over_range else theme.warning if peak_db > _NEAR_END_DB else theme.good
        painter.fillRect(QRectF(0, bar.top(), self._x(rms_db), bar.height()), QColor(colour))
        painter.setPen(QPen(QColor(theme.text), 2))
        painter.drawLine(int(self._x(peak_db)), int(bar.top()), int(self._x(peak_db)), int(bar.bottom()))
        held_x = self._x(_decibels(self._held_v.get(name, 0.0), level.range_v))
        painter.setBrush(QColor(theme.text))
        painter.setPen(Qt.PenStyle.NoPen)
        half = bar.height() / 3
        tip = QPointF(held_x, bar.top() + half)
        painter.drawPolygon(QPolygonF([tip, QPointF(held_x - half, bar.top()), QPointF(held_x + half, bar.top())]))

    def _x(self, level_db: float) -> float:
        share = (level_db - _FLOOR_DB) / -_FLOOR_DB
        return min(max(share, 0.0), 1.0) * (self.width() - 1)


def _words(level: ChannelLevel) -> str:
    share = _percent(level.peak_v / level.range_v)
    told = f"{volts(level.rms_v)} rms, {volts(level.peak_v)} peak, {share} of {level.range_v:g} V"
    return f"▲ over-range! {told}" if level.over_range else told


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _decibels(value_v: float, range_v: float) -> float:
    return 20 * math.log10(max(value_v, 1e-12) / range_v)
