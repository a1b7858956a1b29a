"""Page "By hand": moves the beam, shows levels, takes sweeps."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pyqtgraph
from msgspec.structs import asdict
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QColor, QKeyEvent, QPalette
from PyQt5.QtWidgets import QFormLayout, QGridLayout, QToolButton, QWidget

from wavefocus.config.messages.operate import ChannelLevel, LevelMeasured, Numbers, Ready, SweepTaken
from wavefocus.config.outline import Outline
from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import Plot
from wavefocus.gui.rig.session import ManualSession
from wavefocus.gui.surface import surface_from
from wavefocus.gui.surface_view import STEPS, Keys, PointMm, SurfaceView
from wavefocus.gui.theme import Themed

_FARTHEST_MM = 10_000.0
_ARROWS = (
    ("up", Qt.ArrowType.UpArrow, 0, 1, 0, 1),
    ("left", Qt.ArrowType.LeftArrow, 1, 0, -1, 0),
    ("right", Qt.ArrowType.RightArrow, 1, 2, 1, 0),
    ("down", Qt.ArrowType.DownArrow, 2, 1, 0, -1),
)


class SurfacePicture(SurfaceView):
    """The surface with the beam; arrow keys press those of `arrows`, a click emits `clicked` with the place in mm."""

    clicked = pyqtSignal(float, float)

    def __init__(self, name: str, arrows: "Arrows") -> None:
        super().__init__(name)
        self._arrows = arrows
        self.setAccessibleDescription("A click sends the beam there; arrow keys move it by a step")
        theme = self.theme
        self.chosen = self.add_spots(30, "o", 15, pyqtgraph.mkPen(theme.accent, width=3))
        self._marks = self.add_spots(31, "s", 11)
        self._spot = self.add_spots(34, "o", 12, pyqtgraph.mkPen(theme.base, width=1.5), theme.fault)

    def show_rig(self, outline: Outline, actuator_mm: Sequence[Numbers]) -> None:
        self.show_outline(outline.line(180))
        self.show_actuators(_points(actuator_mm))
        self.fit()

    def show_spot(self, place_mm: Numbers | None) -> None:
        """Show the beam; None for nowhere on the surface."""
        for mark in (self._spot, self._cross):
            mark.setData(pos=_points([] if place_mm is None else [place_mm]))

    def show_marks(self, place_mm: Sequence[Numbers], current: int, done: int) -> None:
        """Show numbered marks: filled when done, the current one large."""
        theme, places = self.theme, range(len(place_mm))
        self._marks.setData(
            pos=_points(place_mm),
            size=[17 if number == current else 11 for number in places],
            brush=[pyqtgraph.mkBrush(theme.good if number < done else theme.base) for number in places],
            pen=[pyqtgraph.mkPen(theme.fault if number == current else theme.text, width=2) for number in places],
        )
        self.show_texts([str(number + 1) for number in places], place_mm, (-0.5, 1.0))

    def click_at(self, at_mm: PointMm, _keys: Keys) -> None:
        self.clicked.emit(*at_mm)

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        if event is None or event.key() not in STEPS:
            super().keyPressEvent(event)
            return
        self._arrows.step(*STEPS[event.key()])
        event.accept()


def _points(place_mm: Sequence[Numbers]) -> np.ndarray:
    return np.asarray(place_mm, np.float64).reshape(-1, 2)


class Arrows(QWidget):
    """Four arrow buttons around a choice of the step; holding a button repeats it.

    move: Receives the steps along x and y.
    """

    def __init__(self, steps: Sequence[float], unit: str, chosen: int, move: Callable[[float, float], object]) -> None:
        super().__init__()
        self._steps, self._move = steps, move
        tip = "Step of the arrows; Page up and Page down choose another"
        self.step_choice = ui.choice("Step", tip, [f"{step:g} {unit}" for step in steps], chosen)
        self.buttons: dict[str, QToolButton] = {}
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        for word, arrow, line, place, x, y in _ARROWS:
            tip, name = f"Move the beam {word} by a step (arrow key)", f"Move the beam {word}"
            button = ui.tool_button("", tip, partial(self.step, x, y), name)
            button.setArrowType(arrow)
            button.setAutoRepeat(True)
            button.setAutoRepeatInterval(120)
            grid.addWidget(button, line, place, Qt.AlignmentFlag.AlignCenter)
            self.buttons[word] = button
        grid.addWidget(self.step_choice, 1, 1)

    def step(self, x: float, y: float) -> None:
        """Move by a step along x, y or both."""
        size = self._steps[self.step_choice.currentIndex()]
        self._move(size * x, size * y)


class _JogPanel(QWidget):
    """Moves the beam by clicks on the picture, arrows and coordinates."""

    def __init__(self, session: ManualSession) -> None:
        super().__init__()
        self._session = session
        self.arrows = Arrows((0.1, 0.5, 1.0, 5.0, 20.0), "mm", 2, session.jog_by)
        self.picture = SurfacePicture("Surface: click to send the beam there", self.arrows)
        self.picture.setToolTip("Click: send the beam there. Arrow keys: one step. Wheel: zoom. Drag: pan. Unit: mm")
        tip = "{} on the surface in mm, from its middle; seen from the laser, x right, y up"
        self.x_mm, self.y_mm = (
            ui.number_box(f"{axis} in mm", tip.format(axis), " mm", 2, -_FARTHEST_MM, _FARTHEST_MM) for axis in "xy"
        )
        tip = "Send the beam to x, y on the surface"
        self.go = ui.push_button("Go &there", tip, lambda: session.jog_to(self.x_mm.value(), self.y_mm.value()))
        tip = "Send the beam to the middle of the surface, (0, 0) mm"
        self.middle = ui.push_button("&Middle", tip, lambda: session.jog_to(0.0, 0.0))
        tip = "Send the beam to the rig's safe direction (mirror.park_mrad)"
        self.park = ui.action(self, "&Park the beam", session.park, "Ctrl+Shift+P", tip=tip)
        self.where = ui.label("Place of the beam", wraps=True, any_width=True)
        form = QFormLayout()
        form.addRow("x", self.x_mm)
        form.addRow("y", self.y_mm)
        controls = ui.row(self.arrows, 12, form, ui.column(self.go, self.middle, ui.button(self.park)), None)
        ui.column((self.picture, 1), self.where, controls, owner=self)
        self.picture.clicked.connect(lambda x, y: session.jog_to(round(x, 2), round(y, 2)))
        self._shown: Ready | None = None
        session.changed.connect(self._show)
        self._show()

    def _show(self) -> None:
        session, beam, facts = self._session, self._session.beam, self._session.facts
        for part in (self.arrows, self.x_mm, self.y_mm, self.go, self.middle):
            part.setEnabled(session.state == "ready")
        if facts is not None and facts is not self._shown:
            self.picture.show_rig(surface_from(asdict(facts.surface)).outline, facts.actuator_mm)
        self._shown = facts
        self.picture.show_spot(session.place_mm)
        if session.state != "ready":
            text = "The instruments are not open in this window"
        elif beam.x_mrad is None or beam.y_mrad is None:
            text = "Beam: not moved yet"
        else:
            angles = f"({beam.x_mrad:.3f}, {beam.y_mrad:.3f}) mrad"
            if beam.parked:
                text = f"Beam: parked at {angles}"
            elif session.place_mm is None:
                text = f"Beam: at {angles}, outside the surface"
            else:
                text = "Beam: at ({:.2f}, {:.2f}) mm, ".format(*session.place_mm) + angles
        if facts is not None and not facts.mapped:
            text += "\n▲ The mirror map is not measured: places are as accurate as the rig file"
        self.where.setText(text)


_FLOOR_DB = -100
_STATES = {
    "released": "○ The instruments are free",
    "opening": "◌ Opening the instruments…",
    "ready": "● The instruments are open in this window",
    "ending": "◌ Muting, parking and closing…",
}
_HIGHEST_HZ = 4999.0
_LEGEND_AT = (-8, 6)


class ManualPage(QWidget):
    """Jogging on the left, levels and sweeps on the right."""

    def __init__(self, session: ManualSession, take: Callable[[], object]) -> None:
        super().__init__()
        self._session = session
        tip = "Open mirror, recorder and player in a separate process"
        self.take = ui.action(self, "&Open instruments", take, "Ctrl+Shift+T", tip=tip)
        tip = "Mute, park and close the instruments, so that other programs can use them"
        self.release = ui.action(self, "&Close instruments", session.release, "Ctrl+Shift+G", tip=tip)
        self.jog, self.sound = _JogPanel(session), _SoundPanel(session)
        tip = "Silence every output at once and drop waiting orders"
        self.mute = ui.action(self, "M&ute", session.mute, "Ctrl+0", tip=tip)
        self.state = ui.label("State of the instruments")
        self.splitter = ui.side_by_side((self.jog, 600), (self.sound, 640))
        buttons = ui.row(*map(ui.button, (self.take, self.release, self.mute)), self.state, None)
        ui.column(buttons, (self.splitter, 1), owner=self, margins=ui.PAGE_MARGINS)
        self.sound.actuator.currentIndexChanged.connect(self._mark_actuator)
        session.changed.connect(self._show_state)
        self._show_state()

    def _show_state(self) -> None:
        state, facts = self._session.state, self._session.facts
        self.state.setText(_STATES[state])
        instruments = facts.instruments if facts is not None else {}
        self.state.setToolTip("\n".join(f"{role}: {name}" for role, name in instruments.items()))

    def _mark_actuator(self, actuator: int) -> None:
        """Emphasise the actuator that would play."""
        place_mm = () if self._session.facts is None or actuator < 0 else self._session.facts.actuator_mm
        self.jog.picture.chosen.setData(pos=_points(place_mm[actuator : actuator + 1]))


class _SoundPanel(Themed, QWidget):
    """Levels of the inputs, and one sweep at a time."""

    def __init__(self, session: ManualSession) -> None:
        super().__init__()
        self._session = session
        self.meter = LevelMeter()
        self.listen = ui.check("&Listen", "Show the levels of both inputs four times a second")
        tip = (
            "Play a sweep of 0.1 s on the actuator below each time, at its level: jog to where the response is largest"
        )
        self.sounds = ui.check("Wh&ile the actuator sounds", tip)
        self.actuator = ui.choice("Actuator", "Actuator that plays, in the bank's order", ())
        self.level_v = ui.number_box("Level in V", "Peak of the sweep in V", " V", 3, 0.001, 1000.0)
        self.start_hz = ui.number_box("Start in Hz", "Start of the sweep in Hz", " Hz", 0, 1.0, _HIGHEST_HZ)
        self.stop_hz = ui.number_box("Stop in Hz", "End of the sweep in Hz", " Hz", 0, 2.0, _HIGHEST_HZ)
        self.length_s = ui.number_box("Duration in s", "Duration of the sweep in s", " s", 2, 0.05, 10.0, value=0.5)
        tip = "Play one sweep and show its recording"
        self.sweep = ui.action(self, "S&weep", self._take_sweep, "F5", tip=tip)
        self.figures = ui.label("Figures of the sweep", wraps=True, any_width=True)
        self.verdict = ui.label("Defects of the sweep", wraps=True, any_width=True)
        self.waveform = Plot("Waveform of the sweep", "time (s)", "mV", legend_at=_LEGEND_AT)
        bottom = "frequency (Hz); dashed: the sweep's band; dB re 1 V/√Hz"
        self.spectrum = Plot("Spectrum of the sweep", bottom, "dB", legend_at=_LEGEND_AT)
        for plot in (self.waveform, self.spectrum):
            plot.setMinimumHeight(90)
            plot.title("no sweep yet", faint=True, size="9pt")
        first = (*ui.labelled("A&ctuator", self.actuator), *ui.labelled("Le&vel", self.level_v), ui.button(self.sweep))
        pairs = (("F&rom", self.start_hz), ("to", self.stop_hz), ("for", self.length_s))
        second = [part for pair in pairs for part in ui.labelled(*pair)]
        ui.column(
            ui.row(self.listen, self.sounds, None),
            self.meter,
            ui.row(*first, None),
            ui.row(*second, None),
            self.figures,
            self.verdict,
            (ui.side_by_side((self.waveform, 200), (self.spectrum, 200), above=True), 1),
            owner=self,
        )
        self.listen.clicked.connect(self._listen)
        self.sounds.clicked.connect(self._listen_again)
        self.actuator.activated.connect(self._listen_again)
        self.level_v.editingFinished.connect(self._listen_again)
        self._shown: SweepTaken | None = None
        self._filled: object = None
        session.changed.connect(self._show)
        self._show()

    def _take_sweep(self) -> None:
        if not self._session.sweeping:
            boxes = (self.level_v, self.start_hz, self.stop_hz, self.length_s)
            self._session.take_sweep(self.actuator.currentIndex(), *(box.value() for box in boxes))

    def _show(self) -> None:
        facts, ready = self._session.facts, self._session.state == "ready"
        for part in (self.listen, self.sounds, self.actuator, self.level_v, self.start_hz, self.stop_hz,
                     self.length_s):  # fmt: skip
            part.setEnabled(ready)
        filled = facts and (facts.name, len(facts.actuator_mm), facts.level_v, facts.largest_level_v, facts.band_hz)
        if facts is not None and filled != self._filled:
            self._filled = filled
            self.actuator.clear()
            self.actuator.addItems([str(one) for one in range(len(facts.actuator_mm))])
            self.level_v.setMaximum(facts.largest_level_v)
            self.level_v.setValue(facts.level_v)
            self.level_v.setToolTip(f"Peak of the sweep in V; this rig allows up to {facts.largest_level_v:.4g} V")
            self.start_hz.setValue(facts.band_hz[0])
            self.stop_hz.setValue(facts.band_hz[1])
        self.listen.setChecked(self._session.listening)
        self.meter.show_levels(self._session.levels if self._session.listening else None)
        sweep = self._session.sweep
        if sweep is not None and sweep is not self._shown:
            self._show_sweep(sweep)
        self._shown = sweep

    def _show_sweep(self, sweep: SweepTaken) -> None:
        self.figures.setText(_sweep_text(sweep))
        defects = [] if sweep.figures is None else [defect.sentence for defect in sweep.figures.defects]
        defects = [trouble for trouble in (self._session.swept_off, sweep.trouble) if trouble] + defects
        self.verdict.setText("▲ " + "; ".join(defects) if defects else "✔ no defects")
        self.verdict.setStyleSheet(f"color: {self.theme.fault if defects else self.theme.good};")
        self._draw_waveform(sweep)
        self._draw_spectrum(sweep)

    def _draw_waveform(self, sweep: SweepTaken) -> None:
        """Draw both inputs; the reference is scaled to the response's peak."""
        plot = self.waveform.getPlotItem()
        self.waveform.title("")
        plot.clear()
        response_v, reference_v = np.array(sweep.response_v), np.array(sweep.reference_v)
        response_peak_v = sweep.level.response.peak_v
        factor, unit = (1e3, "mV") if response_peak_v < 0.5 else (1.0, "V")
        plot.setLabel("left", unit)
        time_s = np.arange(len(response_v)) / sweep.sample_rate_hz
        reference_peak_v = float(np.abs(reference_v).max(initial=0.0))
        share, theme = response_peak_v / reference_peak_v if reference_peak_v > 0 else 1.0, self.theme
        self.waveform.line(time_s, factor * share * reference_v, theme.grid, 1.2, f"reference × {share:.2g}")
        self.waveform.line(time_s, factor * response_v, theme.traces[0], 1.2, "response")
        plot.getViewBox().autoRange()

    def _draw_spectrum(self, sweep: SweepTaken) -> None:
        plot, theme, frequency_hz = self.spectrum.getPlotItem(), self.theme, np.array(sweep.frequency_hz)
        self.spectrum.title("")
        plot.clear()
        self.spectrum.line(frequency_hz, np.array(sweep.noise_db), theme.faint, 1.0, "in silence")
        self.spectrum.line(frequency_hz, np.array(sweep.response_db), theme.traces[0], 1.6, "with the sweep")
        self.spectrum.mark_band(sweep.start_hz, sweep.stop_hz)
        lowest_db = float(np.median(sweep.noise_db)) - 15.0
        plot.setYRange(lowest_db, max(sweep.response_db) + 10.0, padding=0)
        plot.setXRange(0.0, sweep.frequency_hz[-1], padding=0.01)

    def _listen(self) -> None:
        sounding = self.actuator.currentIndex() if self.sounds.isChecked() else None
        self._session.listen(self.listen.isChecked(), sounding, self.level_v.value())

    def _listen_again(self) -> None:
        if self._session.listening:
            self.listen.setChecked(True)
            self._listen()


class LevelMeter(Themed, QWidget):
    """One bar per input for the peak in dB of its range; its text holds rms and peak."""

    def __init__(self) -> None:
        super().__init__()
        self._bars = {name: ui.progress_bar(f"Level of the {name}", name) for name in ("response", "reference")}
        for bar in self._bars.values():
            bar.setRange(_FLOOR_DB, 0)
            bar.setToolTip("Bar: peak in dB of the input's range")
        ui.column(*self._bars.values(), owner=self, spacing=1)
        self.show_levels(None)

    def show_levels(self, levels: LevelMeasured | None) -> None:
        """Show the latest levels; None while there are none."""
        for name, bar in self._bars.items():
            level: ChannelLevel | None = getattr(levels, name, None)
            if level is None:
                bar.setFormat(f"{name}: no levels")
                bar.setValue(_FLOOR_DB)
                continue
            text = f"{name}: {_volts(level.rms_v)} rms, {_volts(level.peak_v)} peak of {level.range_v:g} V"
            if name == "response" and levels is not None and levels.light is not None:
                text += f"; signal {100 * levels.light:.0f} %"
            peak_db = 20 * math.log10(max(level.peak_v, 1e-12) / level.range_v)
            bar.setFormat(f"▲ over-range! {text}" if level.over_range else text)
            bar.setValue(min(0, max(_FLOOR_DB, round(peak_db))))
            theme, palette = self.theme, bar.palette()
            colour = theme.fault if level.over_range else theme.warning if peak_db > -3.0 else theme.good
            palette.setColor(QPalette.ColorRole.Highlight, QColor(colour))
            bar.setPalette(palette)
        self.setAccessibleName("; ".join(bar.format() for bar in self._bars.values()))


def _volts(value_v: float) -> str:
    return str(pyqtgraph.siFormat(value_v, precision=3, suffix="V"))


def _sweep_text(sweep: SweepTaken) -> str:
    """Figures of a sweep in one line."""
    parts = [
        f"actuator {sweep.actuator} at {sweep.level_v:.3g} V",
        f"response {_volts(sweep.level.response.peak_v)} peak",
    ]
    if sweep.figures is not None:
        heard = "signal {:.0f} dB above noise" if sweep.figures.snr_db > 0 else "no signal above the noise"
        for value, template in (
            (sweep.figures.snr_db, heard),
            (sweep.figures.residual_db, "{:z.0f} dB unexplained"),
            (1e3 * sweep.figures.latency_s, "latency {:.1f} ms"),
            (sweep.figures.clock_ppm, "clocks {:+.0f} ppm apart"),
        ):
            if math.isfinite(value):
                parts.append(template.format(value))
    return "; ".join(parts)
