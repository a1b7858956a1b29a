"""What comes of a scene while it is edited: drives, field, figures, files, play on the rig, and live sources."""

import multiprocessing
import os
import re
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from PyQt5.QtCore import QEvent, QPoint, QPointF, Qt
from PyQt5.QtGui import QTouchEvent

from tests.gui.conftest import LEFT, NO_KEY, click, edit, line_scene, mouse, pixel, press, shown_tab, wait
from tests.lab_files import green_of, record_of, write_bank
from wavefocus.config.messages.live import LiveReady, LiveState
from wavefocus.config.scene import Output, QuietTable
from wavefocus.gui.scene.calculation import NO_BANK, _drives, _field
from wavefocus.gui.scene.document import EMPTY, changed
from wavefocus.gui.scene.exports import IDLE, LIVE, OPENING, PLAYING, RENDERING
from wavefocus.gui.scene.live_panel import KEYS, MOUSE
from wavefocus.gui.scene.live_panel import figures_of as live_figures
from wavefocus.gui.scene.results_panel import GOOD, HELD, MISSED, figures_of
from wavefocus.gui.scene.tab import DRAW, SceneTab
from wavefocus.gui.scene.tab import LIVE as LIVE_PAGE
from wavefocus.gui.surface import VIRTUAL
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.drive_file import read_drive

FINGER_SCENE = """
[[source]]
path = { kind = "trajectory", file = "finger.csv" }
signal = { kind = "sine", frequency_hz = 150, duration_s = 0.2 }
emission = "continuous"
amplitude = 0.001
"""


class Bench:
    """The Scene tab, empty and without a rig, on the measured bank."""

    def __init__(self, qtbot, window, bank):
        self.qtbot, self.window = qtbot, window
        self.tab = shown_tab(window, SceneTab)
        self.panel, self.document = self.tab.results, self.tab.document
        window.messages.dismiss()
        self.tab.use_mode(DRAW)
        self.document.clear()
        self.document.use_bank(bank)
        self.use_rig("")

    def use_rig(self, name):
        self.tab.rig_field.line.setText(name)
        self.tab.rig_field.line.editingFinished.emit()

    def edit(self, draft, *, complete=True):
        edit(self.document, draft)
        self.qtbot.wait(60)  # edits are reported together
        if complete:
            wait(self.qtbot, lambda: self.panel.calculation.complete)

    def says(self, words):
        wait(self.qtbot, lambda: words in self.panel.problem.text())

    def told(self, words):
        wait(self.qtbot, lambda: words in self.window.messages.sentence)


@pytest.fixture
def bench(qtbot, shared_window, finished):
    return Bench(qtbot, shared_window, finished)


@pytest.mark.timeout(500)
def test_drives_field_and_figures_follow_edits_and_nothing_older_is_shown(qtbot, bench):
    panel = bench.panel
    bench.says(EMPTY)
    assert not panel.actions_by_name["drive"].isEnabled()
    for amplitude in (1.0, 5.0, 2.0):
        bench.edit(line_scene(amplitude=amplitude), complete=False)
    wait(qtbot, lambda: panel.calculation.complete)
    first = np.abs(panel.calculation.results.drive.drive_v).max(axis=1)
    bench.edit(line_scene(amplitude=4.0))
    louder = np.abs(panel.calculation.results.drive.drive_v).max(axis=1)
    np.testing.assert_allclose(louder, 2.0 * first, rtol=1e-5)
    limit_v = float(louder.max()) / 4.0
    bench.edit(line_scene(amplitude=4.0, limit_v=limit_v))
    assert np.abs(panel.calculation.results.drive.drive_v).max() == pytest.approx(limit_v)
    assert [panel.figures.item(0, column).text() for column in (1, 2)] == ["0.25, for limit_v", HELD]
    assert panel.figures.item(1, 1).text().endswith(" V")
    bench.edit(line_scene(amplitude=1.0, limit_v=limit_v))
    assert panel.figures.item(0, 2).text() == GOOD
    assert not panel.warnings.isVisible()
    facts = {**panel.calculation.results.facts, "warnings": ["nearest is wrong"]}
    panel.calculation.results = replace(panel.calculation.results, facts=facts)
    panel.calculation.changed.emit()
    assert panel.warnings.isVisible()
    assert panel.warnings.mapTo(panel, QPoint()).y() < panel.pages.y()
    assert "nearest is wrong" in panel.warnings.text()
    assert "a step is " in panel.drives.getPlotItem().titleLabel.text

    # The field: its marks, a click on a position, and the film, which an edit leaves where it is.
    view, field, figures = panel.field, panel.calculation.results.field, panel.calculation.results.figures
    panel.pages.setCurrentWidget(view)
    assert len(field.field) == 12
    view.slider.to_mark(1)
    assert view.slider.time_s == pytest.approx(figures.time_s[1], abs=0.5 / field.sample_rate_hz)
    peak = np.abs(field.field).max()
    shown = view.map.values * peak / view.map.levels[1]
    np.testing.assert_allclose(shown, field.field[:, view.slider.sample], rtol=1e-5)
    assert view.map.levels[0] == -view.map.levels[1]
    assert "response (" in view.map.bar.accessibleName()
    click(view.map, pixel(view.map, 3.0, 1.5))
    assert view.map.marked == 6
    assert "position 6 at (3.0, 1.5) mm" in view.response.getPlotItem().titleLabel.text
    (curve,) = view.response.curves
    np.testing.assert_allclose(curve.yData / np.abs(curve.yData).max(), field.field[6] / np.abs(field.field[6]).max())
    view.slider.go_to(0)
    qtbot.keyClick(view.slider.slider, Qt.Key.Key_Space)
    wait(qtbot, lambda: view.slider.sample > 0)
    at_s = view.slider.time_s
    view.slider.pause()
    edit(bench.document, line_scene(amplitude=2.0))
    panel.poll()
    assert panel.calculation.stage == "drives"  # it has waited for the last key: nothing waits again
    wait(qtbot, lambda: panel.calculation.complete)
    assert view.slider.time_s >= at_s - 1e-9
    assert view.map.marked == 6
    drawn = [np.ptp(line.yData) for line in panel.drives.getPlotItem().listDataItems()]
    drive_v = panel.calculation.results.drive.drive_v
    np.testing.assert_allclose(drawn, 0.45 * np.ptp(drive_v, axis=1) / np.abs(drive_v).max(), rtol=1e-6)


@pytest.mark.timeout(500)
def test_no_bank_path_off_grid_or_bank_that_goes_and_comes_then_sentence_says_so(bench, finished):
    panel = bench.panel
    bench.document.use_bank(None)
    bench.says(NO_BANK)
    bench.document.use_bank(finished)
    bench.edit(line_scene(end_mm=60.0), complete=False)
    bench.says("source 0")
    assert panel.calculation.results is None
    assert panel.figures.rowCount() == 0
    bench.edit(line_scene())
    away = finished.rename(finished.with_name("away.h5"))
    panel.calculation._looked_s = 0.0  # without an edit, and sooner than it would look by itself
    bench.says("is missing")
    assert panel.calculation.results is None
    away.rename(finished)
    wait(bench.qtbot, lambda: panel.calculation.complete)
    assert panel.calculation.results is not None

    # Its process killed: the next edit calculates again.
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    bench.edit(line_scene(amplitude=2.5), complete=False)
    bench.says("process ended")
    bench.edit(line_scene(amplitude=3.0))
    assert panel.calculation.results is not None
    assert multiprocessing.active_children() != [process]

    bench.edit(line_scene(amplitude=3.5), complete=False)
    wait(bench.qtbot, lambda: panel.calculation.stage)
    os.utime(finished, (0, 0))
    panel.calculation._looked_s = 0.0
    panel.calculation.poll(shown=True)
    assert not panel.calculation._wanted  # a bank that is measured would never let a calculation end


def test_positions_measured_after_the_drives_then_the_field_has_their_places(tmp_path):
    green = np.stack([green_of(position) for position in range(3)])
    bank = write_bank(tmp_path / "plate.h5", green, rows=(0, 1))
    drives = _drives(0, line_scene(end_mm=1.5), tmp_path / "scene.toml", bank, "")
    with BankWriter.open(bank) as writer:
        writer.commit(2, green[2], record_of(2))
    results = _field(0, drives, 2000.0)
    assert len(results.field.field) == results.surface.positions == 3


def test_given_save_then_the_files_are_what_the_command_makes(bench, finished, tmp_path):
    bench.edit(line_scene(limit_v=2.0))
    panel, drawn = bench.panel, bench.panel.calculation.results.drive
    panel.output.save(tmp_path / "out.h5")
    assert panel.output.running
    assert not panel.actions_by_name["drive"].isEnabled()
    bench.told("out.h5 is saved")
    drive = read_drive(tmp_path / "out.h5")
    assert drive.omitted_bound == 0.0
    assert np.linalg.norm(drawn.drive_v - drive.drive_v) < 1.1e-3 * np.linalg.norm(drive.drive_v)
    panel.output.save(tmp_path / "never.h5")
    panel.actions_by_name["stop"].trigger()
    bench.told("never.h5 is not saved: cancelled")
    assert not (tmp_path / "never.h5").exists()

    # A relative name in a text that is not saved is that of a file beside the scene.
    scene = finished.with_name("finger.toml")
    scene.write_text(FINGER_SCENE, encoding="utf-8")
    scene.with_name("finger.csv").write_text("time_s,x_mm,y_mm\n0,0,0\n0.05,4.5,0\n", encoding="utf-8")
    bench.document.load(scene)
    bench.document.replace(FINGER_SCENE.replace("0.001", "0.002"))
    assert not bench.document.saved
    wait(bench.qtbot, lambda: panel.calculation.complete)
    drawn = panel.calculation.results.drive
    panel.output.save(tmp_path / "out.wav")
    bench.told("out.wav is saved")
    sound, rate_hz = soundfile.read(tmp_path / "out.wav")
    assert sound.shape[1] == 3
    assert len(sound) == pytest.approx(drawn.drive_v.shape[1] * rate_hz / drawn.sample_rate_hz, abs=2)
    assert scene.read_text(encoding="utf-8") == FINGER_SCENE


@pytest.mark.timeout(500)
def test_given_play_then_the_rig_plays_the_scene_and_stop_mutes_it(bench, finished):
    panel, playing = bench.panel, bench.panel.output
    bench.edit(line_scene())
    assert not panel.actions_by_name["play"].isEnabled()
    bench.use_rig(str(finished.with_name("rig.toml")))
    bench.edit(line_scene(amplitude=0.5))
    assert panel.actions_by_name["play"].isEnabled()
    panel.gain.setValue(0.0)
    panel.loops.setValue(2)
    states = []
    playing.changed.connect(lambda: states.append(playing.state))
    bench.qtbot.mouseClick(panel.buttons["play"], LEFT)
    assert playing.state == RENDERING
    bench.told("the scene: played; the outputs are muted")
    assert list(dict.fromkeys(states)) == [RENDERING, OPENING, PLAYING, IDLE]

    bench.qtbot.mouseClick(panel.buttons["play"], LEFT)
    bench.qtbot.mouseClick(panel.buttons["stop"], LEFT)
    bench.told("nothing was played")
    assert playing.state == IDLE

    # It ends muted when its input closes, as it does when the window is gone.
    panel.loops.setValue(10_000)
    bench.qtbot.mouseClick(panel.buttons["play"], LEFT)
    wait(bench.qtbot, lambda: playing.state == PLAYING)
    playing.own.close_input()
    bench.told("stopped by the user; the outputs are muted")

    panel.gain.setValue(60.0)
    bench.qtbot.mouseClick(panel.buttons["play"], LEFT)
    bench.told("the rig's actuators may get")


def test_given_quiet_places_then_the_levels_reached_are_shown_beside_those_asked_for(bench):
    quiet = (QuietTable(at_mm=(4.5, 4.5), level_db=-20.0),)
    bench.edit(line_scene(end_mm=1.5).model_copy(update={"quiet": quiet, "output": Output(most_energy=1.5)}))
    results = bench.panel.calculation.results
    (level,) = results.facts["quiet"]
    assert (level["name"], level["level_db"]) == ("quiet[0]", -20.0)
    ((_, value, verdict, _),) = [one for one in figures_of(results) if one[0] == "level at quiet[0]"]
    assert value == f"{level['reached_db']:.1f} dB of -20 dB"
    assert verdict == (GOOD if level["reached_db"] <= -19.8 else MISSED)  # as `render` warns


SHORT_MM = 0.75


def live_page(bench, rig=""):
    """The Live page with a bank of the virtual rig, ready to start."""
    tab = bench.tab
    bench.use_rig(rig or str(bench.document.bank.with_name("rig.toml")))
    tab.modes[LIVE_PAGE].click()
    wait(bench.qtbot, lambda: tab.live.backdrop.surface is not None)
    return tab


def started(qtbot, tab):
    press(qtbot, tab.live_panel.buttons["start"])
    wait(qtbot, lambda: tab.live_run.state in (LIVE, IDLE))
    assert tab.live_run.state == LIVE, tab.context.messages.sentence


def sounds(tab, name, *at_mm):
    """Whether a source was reported last, at a place if one is given."""
    state = tab.live_run.latest
    here = [] if state is None else [one for one in state.sources if one.name == name]
    if not here or not at_mm:
        return bool(here)
    return here[0].at_mm == pytest.approx(at_mm, abs=SHORT_MM)


def touch(surface, kind, *fingers):
    """Send a touch event: number, state and place (mm) of each finger; Qt's own points can be made in C++ only."""
    event = QTouchEvent(kind)
    points = [
        SimpleNamespace(
            id=lambda number=number: number, state=lambda state=state: state,
            pos=lambda x_mm=x_mm, y_mm=y_mm: QPointF(pixel(surface, x_mm, y_mm)),
        )
        for number, state, x_mm, y_mm in fingers
    ]  # fmt: skip
    event.touchPoints = lambda: points
    assert surface.viewportEvent(event)


def test_mouse_fingers_and_keys_then_sources_sound_follow_and_end_and_stop_mutes(qtbot, bench, tmp_path):
    tab = live_page(bench)
    edit(tab.document, line_scene(amplitude=1000.0))
    tab.live_panel.records.setChecked(True)
    tab.live_panel.folder.show_path(tmp_path)
    started(qtbot, tab)
    surface, run = tab.live_surface, tab.live_run

    mouse(surface, QEvent.Type.MouseButtonPress, pixel(surface, 0.0, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds(tab, MOUSE, 0.0, 1.5))
    mouse(surface, QEvent.Type.MouseMove, pixel(surface, 4.5, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds(tab, MOUSE, 4.5, 1.5))
    assert not tab.live_run.latest.sources[0].fading  # at rest it gets positions, too
    assert surface.texts[0].toPlainText() == MOUSE
    wait(qtbot, lambda: "▲ limiter: -" in tab.live_panel.figures.text())
    mouse(surface, QEvent.Type.MouseMove, pixel(surface, 40.0, 1.5), NO_KEY, held=True)
    assert run.places[MOUSE] == pytest.approx((6.0, 1.5), abs=SHORT_MM)  # as far as it can be felt
    mouse(surface, QEvent.Type.MouseButtonRelease, pixel(surface, 4.5, 1.5), NO_KEY, held=False)
    wait(qtbot, lambda: not sounds(tab, MOUSE))

    pressed, moved, released = (
        Qt.TouchPointState.TouchPointPressed, Qt.TouchPointState.TouchPointMoved, Qt.TouchPointState.TouchPointReleased,
    )  # fmt: skip
    touch(surface, QEvent.Type.TouchBegin, (7, pressed, 0.0, 0.0))
    touch(surface, QEvent.Type.TouchUpdate, (7, moved, 1.5, 0.0), (9, pressed, 4.5, 3.0))
    wait(qtbot, lambda: sounds(tab, "finger 1", 1.5, 0.0) and sounds(tab, "finger 2", 4.5, 3.0))
    touch(surface, QEvent.Type.TouchUpdate, (7, released, 1.5, 0.0), (9, moved, 3.0, 3.0))
    wait(qtbot, lambda: not sounds(tab, "finger 1") and sounds(tab, "finger 2", 3.0, 3.0))
    touch(surface, QEvent.Type.TouchCancel)
    assert run.places == {}

    qtbot.keyClick(surface, Qt.Key.Key_Space)
    from_mm = run.places[KEYS]
    qtbot.keyPress(surface, Qt.Key.Key_Left)
    wait(qtbot, lambda: run.places[KEYS][0] < from_mm[0] - SHORT_MM)
    qtbot.keyRelease(surface, Qt.Key.Key_Left)
    wait(qtbot, lambda: sounds(tab, KEYS, *run.places[KEYS]))
    qtbot.keyClick(surface, Qt.Key.Key_Space)
    wait(qtbot, lambda: not sounds(tab, KEYS))

    assert re.search(r"latency: [\d.]+ ms", tab.live_panel.figures.text())
    press(qtbot, tab.live_panel.buttons["stop"])
    wait(qtbot, lambda: run.state == IDLE)
    assert "muted" in bench.window.messages.sentence
    (scene,) = tmp_path.glob("live-*/scene.toml")
    assert scene.read_text(encoding="utf-8").count("[[source]]") >= 4  # late positions begin another


def test_source_that_sounds_then_leaving_page_or_closing_window_ends_session(qtbot, open_window, finished):
    window = open_window()
    tab = live_page(Bench(qtbot, window, finished))
    scene = line_scene()
    independent = changed(scene.regularisation, independent=True)
    edit(tab.document, changed(scene, regularisation=independent))
    started(qtbot, tab)
    assert tab.live_run.ready.independent
    tab.modes[DRAW].click()
    wait(qtbot, lambda: tab.live_run.state == IDLE)
    tab.modes[LIVE_PAGE].click()
    started(qtbot, tab)
    surface, pid = tab.live_surface, tab.live_run.own.pid
    mouse(surface, QEvent.Type.MouseButtonPress, pixel(surface, 1.5, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds(tab, MOUSE))
    window.close_at_once()
    _, status = os.waitpid(pid, 0)  # the window does not wait for it; it ends by itself, muted
    assert os.waitstatus_to_exitcode(status) == 0


def test_given_a_rig_of_other_actuators_then_one_sentence_says_so_and_nothing_sounds(qtbot, bench, finished):
    tab = live_page(bench, VIRTUAL)  # it has 20 actuators, the bank three
    press(qtbot, tab.live_panel.buttons["start"])
    wait(qtbot, lambda: tab.live_run.state == IDLE)
    assert str(finished) in bench.window.messages.sentence
    assert not tab.live_run.running


def test_figures_then_latency_underruns_and_limiter_are_marked():
    ready = LiveReady("player", "bank", 3, 5.0, 50.0, 215.0, 12.0, (0.0, 4.5), (0.0, 3.0))
    good = LiveState(2.0, 6.0, 9.0, 0.4, 0, 0.0, ())
    late = LiveState(2.0, 30.0, 25.0, 1.3, 2, -3.0, ())
    assert not any(wrong for _, wrong in live_figures(ready, good))
    assert [words for words, wrong in live_figures(ready, late) if wrong] == [
        "latency: 25.0 ms", "underruns: 2", "limiter: -3.0 dB",
    ]  # fmt: skip
    assert ("pointer to sound: 87 ms", False) in live_figures(ready, late)
    assert live_figures(None, None) == []
