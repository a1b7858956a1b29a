"""What is heard: levels as they come, and sweeps on one actuator, once or again and again."""

from __future__ import annotations

import time

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import (
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSplitter,
    QVBoxLayout,
    QWidget,
)

from gui.rig.hands import Hands
from gui.rig.level_meter import LevelMeter
from gui.rig.sweep_plots import SweepSpectrumPlot, WaveformPlot
from gui.shell.theme import LIGHT, Theme

_SHORTEST_S, _LONGEST_S, _USUAL_S = 0.05, 10.0, 0.5
_HIGHEST_HZ = 4999.0
# A virtual rig would sweep more often than anybody can look.
_AGAIN_AFTER_S = 0.5


class SoundPanel(QWidget):
    """Hears and plays.

    Parameters
    ----------
    hands : Hands
        Holds the instruments.
    """

    def __init__(self, hands: Hands) -> None:
        super().__init__()
        self._hands = hands
        self._theme = LIGHT
        self._due_s = 0.0
        self._seen = {"state": -1, "level": -1, "sweep": -1}
        self.meter = LevelMeter()
        self.listen = QCheckBox("&Listen")
        self.listen.setAccessibleName("Listen")
        self.listen.setToolTip("Show the level of both inputs four times a second (V rms and peak at the DAQ)")
        self.sounds = QCheckBox("W&hile the actuator sounds")
        self.sounds.setAccessibleName("While the actuator sounds")
        self.sounds.setToolTip(
            "Play a sweep of 0.1 s on the actuator below each time, at its level: jog to where the response is largest"
        )
        self.actuator = QComboBox()
        self.actuator.setAccessibleName("Actuator")
        self.actuator.setToolTip("Which actuator plays, in the bank's order")
        self.level_v = _box("Level", " V", 3, 0.001, 1000.0, "Peak of the sweep in V; at most what the rig file allows")
        self.start_hz = _box("From", " Hz", 0, 1.0, _HIGHEST_HZ, "Where the sweep starts, in Hz")
        self.stop_hz = _box("to", " Hz", 0, 2.0, _HIGHEST_HZ, "Where the sweep ends, in Hz")
        self.length_s = _box("for", " s", 2, _SHORTEST_S, _LONGEST_S, "Length of the sweep in s")
        self.length_s.setValue(_USUAL_S)
        self.sweep = QPushButton("S&weep")
        self.sweep.setAccessibleName("Sweep")
        self.sweep.setToolTip("Play one sweep and show what came back (F5)")
        self.again = QCheckBox("A&gain and again")
        self.again.setAccessibleName("Sweep again and again")
        self.again.setToolTip("Start the next sweep as soon as one was heard, until this is taken away or Mute")
        self.figures = QLabel("no sweep yet")
        self.figures.setAccessibleName("Figures of the sweep")
        self.figures.setWordWrap(True)
        self.verdict = QLabel()
        self.verdict.setAccessibleName("What is wrong with the sweep")
        self.verdict.setWordWrap(True)
        self.waveform, self.spectrum = WaveformPlot(), SweepSpectrumPlot()
        self._lay_out()
        self.listen.clicked.connect(self._listen)
        self.sounds.clicked.connect(self._listen_anew)
        self.actuator.activated.connect(self._listen_anew)
        self.level_v.editingFinished.connect(self._listen_anew)
        self.sweep.clicked.connect(lambda _checked=False: self.take_sweep())
        self.again.clicked.connect(lambda on: self.take_sweep() if on else None)

    def draw(self) -> None:
        """Draw what changed."""
        hands, seen = self._hands, self._hands.revision
        if self._seen["state"] != seen["state"]:
            self._seen["state"] = seen["state"]
            self._show_state()
        if self._seen["level"] != seen["level"]:
            self._seen["level"] = seen["level"]
            self.listen.setChecked(hands.listening)
            if hands.listening:
                self.meter.show_levels(hands.reference, hands.response, hands.light)
            else:
                self.meter.show_levels(None, None, None)
        if self._seen["sweep"] != seen["sweep"]:
            self._seen["sweep"] = seen["sweep"]
            self._show_sweep()
        if self.again.isChecked() and time.monotonic() >= self._due_s:
            self.take_sweep()

    def mute(self) -> None:
        """Take no more sweeps, and be silent."""
        self.again.setChecked(False)
        self._hands.mute()

    def take_sweep(self) -> None:
        """Take a sweep as it is set up, unless one is under way."""
        if not self._hands.sweeping and self._hands.state == "ready":
            self._due_s = time.monotonic() + _AGAIN_AFTER_S
            self._hands.take_sweep(
                self.actuator.currentIndex(),
                self.level_v.value(),
                self.start_hz.value(),
                self.stop_hz.value(),
                self.length_s.value(),
            )

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self._theme = theme
        self.meter.apply_theme(theme)
        for plot in (self.waveform, self.spectrum):
            plot.apply_theme(theme)
        self._seen["sweep"] = -1

    def _lay_out(self) -> None:
        listening = QHBoxLayout()
        listening.addWidget(self.listen)
        listening.addWidget(self.sounds)
        listening.addStretch(1)
        first, second = QHBoxLayout(), QHBoxLayout()
        for row, words, widget in (
            (first, "A&ctuator", self.actuator),
            (first, "Le&vel", self.level_v),
            (second, "&From", self.start_hz),
            (second, "to", self.stop_hz),
            (second, "for", self.length_s),
        ):
            label = QLabel(words)
            label.setBuddy(widget)
            row.addWidget(label)
            row.addWidget(widget)
        first.addWidget(self.sweep)
        first.addWidget(self.again)
        for row in (first, second):
            row.addStretch(1)
        plots = QSplitter(Qt.Orientation.Vertical)
        plots.setChildrenCollapsible(False)
        for plot in (self.waveform, self.spectrum):
            plot.setMinimumHeight(90)
            plots.addWidget(plot)
        self.figures.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.verdict.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        room = QVBoxLayout(self)
        room.setContentsMargins(0, 0, 0, 0)
        room.addLayout(listening)
        room.addWidget(self.meter)
        room.addLayout(first)
        room.addLayout(second)
        room.addWidget(self.figures)
        room.addWidget(self.verdict)
        room.addWidget(plots, stretch=1)

    def _show_state(self) -> None:
        hands = self._hands
        ready = hands.state == "ready"
        for part in (self.listen, self.sounds, self.actuator, self.level_v, self.start_hz, self.stop_hz,
                     self.length_s, self.sweep, self.again):  # fmt: skip
            part.setEnabled(ready)
        if not ready:
            self.again.setChecked(False)
        facts = hands.facts
        if facts is not None and self.actuator.count() != len(facts.actuator_mm):
            self.actuator.clear()
            self.actuator.addItems([str(one) for one in range(len(facts.actuator_mm))])
            self.level_v.setMaximum(facts.largest_level_v)
            self.level_v.setValue(facts.level_v)
            self.level_v.setToolTip(f"Peak of the sweep in V; this rig allows up to {facts.largest_level_v:.4g} V")
            self.start_hz.setValue(facts.band_hz[0])
            self.stop_hz.setValue(facts.band_hz[1])

    def _show_sweep(self) -> None:
        hands = self._hands
        if hands.sweep is None:
            return
        sweep = hands.sweep
        self.figures.setText(sweep.words)
        defects = sweep.defects
        self.verdict.setText("▲ " + "; ".join(defects) if defects else "✔ nothing wrong with it")
        self.verdict.setStyleSheet(f"color: {self._theme.fault if defects else self._theme.good};")
        self.waveform.show_sweep(sweep)
        self.spectrum.show_sweep(sweep)

    def _listen(self) -> None:
        sounding = self.actuator.currentIndex() if self.sounds.isChecked() else None
        self._hands.listen(self.listen.isChecked(), sounding, self.level_v.value())

    def _listen_anew(self) -> None:
        if self._hands.listening:
            self.listen.setChecked(True)
            self._listen()


def _box(name: str, suffix: str, decimals: int, low: float, high: float, tip: str) -> QDoubleSpinBox:
    box = QDoubleSpinBox()
    box.setDecimals(decimals)
    box.setRange(low, high)
    box.setSuffix(suffix)
    box.setAccessibleName(f"{name} in{suffix}")
    box.setToolTip(tip)
    return box
