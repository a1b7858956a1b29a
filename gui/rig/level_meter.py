"""Levels of both inputs as bars in decibels of the input range."""

from __future__ import annotations

import math

from PyQt5.QtGui import QColor, QMouseEvent, QPalette
from PyQt5.QtWidgets import QLabel, QProgressBar, QVBoxLayout, QWidget

from config.messages.operate import ChannelLevel, LevelMeasured
from gui.rig.messages import volts
from gui.shell.theme import LIGHT, Theme

_FLOOR_DB = -100
_NEAR_RANGE_DB = -3.0


class LevelMeter(QWidget):
    """One bar per input for the peak; the text holds rms, peak and the highest peak. A click resets the highest."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self._levels: LevelMeasured | None = None
        self.held_v: dict[str, float] = {}
        """Highest peak of each input since the last reset, in V."""
        self._rows: dict[str, tuple[QLabel, QProgressBar]] = {}
        self.setToolTip("Peak in dB of the input's range; a click resets the highest peak")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(1)
        for name in ("response", "reference"):
            label, bar = QLabel(), QProgressBar()
            bar.setRange(_FLOOR_DB, 0)
            bar.setFormat("%v dB")
            bar.setAccessibleName(f"Peak of the {name} in dB of its range")
            column.addWidget(label)
            column.addWidget(bar)
            self._rows[name] = label, bar
        self.show_levels(None)

    def show_levels(self, levels: LevelMeasured | None) -> None:
        """Show the latest levels; None while there are none."""
        self._levels = levels
        for name, (label, bar) in self._rows.items():
            level: ChannelLevel | None = getattr(levels, name, None)
            if level is None:
                label.setText(f"{name}: no levels")
                bar.setValue(_FLOOR_DB)
                continue
            self.held_v[name] = max(self.held_v.get(name, 0.0), level.peak_v)
            peak_db = 20 * math.log10(max(level.peak_v, 1e-12) / level.range_v)
            label.setText(self._text(name, level))
            bar.setValue(min(0, max(_FLOOR_DB, round(peak_db))))
            theme = self._theme
            colour = theme.fault if level.over_range else theme.warning if peak_db > _NEAR_RANGE_DB else theme.good
            palette = bar.palette()
            palette.setColor(QPalette.ColorRole.Highlight, QColor(colour))
            bar.setPalette(palette)
        self.setAccessibleName("; ".join(label.text() for label, _ in self._rows.values()))

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        for _, bar in self._rows.values():
            bar.setPalette(QPalette())
        self.show_levels(self._levels)

    def mousePressEvent(self, _event: QMouseEvent | None) -> None:  # noqa: N802
        self.held_v.clear()
        self.show_levels(self._levels)

    def _text(self, name: str, level: ChannelLevel) -> str:
        share = 100 * level.peak_v / level.range_v
        percent = f"{share:.0f}" if share >= 10 else f"{share:.2g}"
        text = f"{name}: {volts(level.rms_v)} rms, {volts(level.peak_v)} peak, {percent} % of {level.range_v:g} V"
        text += f"; highest {volts(self.held_v[name])}"
        if name == "response" and self._levels is not None and self._levels.light is not None:
            text += f"; signal {self._levels.light:.0%}"
        return f"▲ over-range! {text}" if level.over_range else text
