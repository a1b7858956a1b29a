"""What comes of a scene while it is edited, in a real window: drives, field, figures, files, and play on the rig."""

import multiprocessing
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from PyQt5.QtCore import QPoint, Qt, QTimer
from pytestqt.qtbot import QtBot

from tests.gui.conftest import LEFT, click, edit, line_scene, pixel, wait
from wavefocus.config.scene import Output, QuietTable, SceneConfig
from wavefocus.gui.process import WAVEFOCUS
from wavefocus.gui.scene.document import EMPTY, SceneDocument
from wavefocus.gui.scene.exports import IDLE, OPENING, PLAYING, RENDERING
from wavefocus.gui.scene.results_panel import GOOD, HELD, MISSED, NO_BANK, ResultsPanel, figures_of
from wavefocus.gui.window import Window
from wavefocus.storage.drive_file import Drive, read_drive, write_drive

FINGER_SCENE = """
[[source]]
path = { kind = "trajectory", file = "finger.csv" }
signal = { kind = "sine", frequency_hz = 150, duration_s = 0.2 }
emission = "continuous"
amplitude = 0.01
"""


class Bench:
    """A results panel on a context, with the scene that it shows."""

    def __init__(self, qtbot: QtBot, window: Window, bank: Path | None) -> None:
        self.qtbot, self.window = qtbot, window
        self.document = SceneDocument(window)
        self.panel = ResultsPanel(window.context, self.document)
        ticks = QTimer(self.panel)
        ticks.timeout.connect(self.panel.poll)
        ticks.start(20)
        self.panel.resize(480, 700)
        self.panel.show()
        self.document.use_bank(bank)

    def edit(self, draft: SceneConfig, *, complete: bool = True) -> None:
        edit(self.document, draft)
        self.qtbot.wait(60)  # edits are reported together
        if complete:
            wait(self.qtbot, lambda: self.panel.complete)

    def says(self, words: str) -> None:
        wait(self.qtbot, lambda: words in self.panel.problem.text())

    def told(self, words: str) -> None:
        wait(self.qtbot, lambda: words in self.window.messages.sentence)


@pytest.fixture
def bench(qtbot, shared_window, finished):
    shared_window.messages.dismiss()
    shared_window.settings.keep("scene/rig", "")
    yield (made := Bench(qtbot, shared_window, finished))
    made.panel.calculation.close()
    made.panel.deleteLater()


@pytest.mark.timeout(500)
def test_drives_field_and_figures_follow_edits_and_nothing_older_is_shown(qtbot, bench):
    panel = bench.panel
    bench.says(EMPTY)
    assert not panel.actions_by_name["drive"].isEnabled()
    for amplitude in (1.0, 5.0, 2.0):
        bench.edit(line_scene(amplitude=amplitude), complete=False)
    wait(qtbot, lambda: panel.complete)
    first = np.abs(panel.results.drive.drive_v).max(axis=1)
    bench.edit(line_scene(amplitude=4.0))
    louder = np.abs(panel.results.drive.drive_v).max(axis=1)
    np.testing.assert_allclose(louder, 2.0 * first, rtol=1e-5)
    limit_v = float(louder.max()) / 4.0
    bench.edit(line_scene(amplitude=4.0, limit_v=limit_v))
    assert np.abs(panel.results.drive.drive_v).max() == pytest.approx(limit_v)
    assert [panel.figures.item(0, column).text() for column in (1, 2)] == ["0.25, for limit_v", HELD]
    assert panel.figures.item(1, 1).text().endswith(" V")
    bench.edit(line_scene(amplitude=1.0, limit_v=limit_v))
    assert panel.figures.item(0, 2).text() == GOOD
    assert not panel.warnings.isVisible()
    warned = replace(panel.results, facts={**panel.results.facts, "warnings": ["nearest is wrong by about 59 %"]})
    panel.calculation.made.emit(warned)
    assert panel.warnings.isVisible()
    assert panel.warnings.mapTo(panel, QPoint()).y() < panel.pages.y()
    assert "nearest is wrong" in panel.warnings.text()
    assert "a step is " in panel.drives.getPlotItem().titleLabel.text
    look_at_field(qtbot, bench)


def look_at_field(qtbot: QtBot, bench: Bench) -> None:
    panel, view = bench.panel, bench.panel.field
    panel.pages.setCurrentWidget(view)
    field, figures = panel.results.field, panel.results.figures
    assert len(field.field) == 12
    view.slider.to_mark(1)
    assert view.slider.time_s == pytest.approx(figures.time_s[1], abs=0.5 / field.sample_rate_hz)
    peak = np.abs(field.field).max()
    np.testing.assert_allclose(
        view.map.values * peak / view.map.levels[1], field.field[:, view.slider.sample], rtol=1e-5
    )
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
    bench.edit(line_scene(amplitude=2.0))
    assert view.slider.time_s >= at_s - 1e-9
    assert view.map.marked == 6


@pytest.mark.timeout(500)
def test_no_bank_path_off_grid_or_bank_that_goes_and_comes_then_sentence_says_so(bench, finished):
    panel = bench.panel
    bench.document.use_bank(None)
    bench.says(NO_BANK)
    bench.document.use_bank(finished)
    bench.edit(line_scene(end_mm=60.0), complete=False)
    bench.says("source 0")
    assert panel.results is None
    assert panel.figures.rowCount() == 0
    bench.edit(line_scene())
    bench.document.use_bank(None)
    bench.says(NO_BANK)
    bench.document.use_bank(finished)
    wait(bench.qtbot, lambda: panel.complete)
    away = finished.with_name("away.h5")
    finished.replace(away)
    bench.edit(line_scene(amplitude=1.2), complete=False)
    bench.says("is missing")
    assert panel.results is None
    away.replace(finished)
    wait(bench.qtbot, lambda: panel.complete)
    assert panel.results is not None

    # Its process killed: the next edit calculates again.
    bench.edit(line_scene(amplitude=2.0))
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
    bench.edit(line_scene(amplitude=2.5), complete=False)
    bench.says("process ended")
    bench.edit(line_scene(amplitude=3.0))
    assert panel.results is not None
    assert multiprocessing.active_children() != [process]


def test_given_save_then_the_files_are_what_the_command_makes(bench, tmp_path):
    bench.edit(line_scene(limit_v=2.0))
    panel, drawn = bench.panel, bench.panel.results.drive
    panel.save(tmp_path / "out.h5")
    assert panel.saving.busy
    assert not panel.actions_by_name["drive"].isEnabled()
    bench.told("out.h5 is saved")
    drive = read_drive(tmp_path / "out.h5")
    assert drive.omitted_bound == 0.0
    assert np.linalg.norm(drawn.drive_v - drive.drive_v) < 1.1e-3 * np.linalg.norm(drive.drive_v)
    panel.save(tmp_path / "out.wav")
    bench.told("out.wav is saved")
    sound, rate_hz = soundfile.read(tmp_path / "out.wav")
    assert sound.shape[1] == 3
    assert len(sound) == pytest.approx(drawn.drive_v.shape[1] * rate_hz / drawn.sample_rate_hz, abs=2)
    panel.save(tmp_path / "never.h5")
    panel.saving.cancel()
    bench.told("never.h5 is not saved: cancelled")
    assert not (tmp_path / "never.h5").exists()


def test_unsaved_text_with_relative_name_then_file_beside_scene_is_meant(bench, finished, tmp_path):
    scene = finished.with_name("finger.toml")
    scene.write_text(FINGER_SCENE, encoding="utf-8")
    scene.with_name("finger.csv").write_text("time_s,x_mm,y_mm\n0,0,0\n0.05,4.5,0\n", encoding="utf-8")
    bench.document.load(scene)
    bench.document.replace(FINGER_SCENE.replace("0.01", "0.02"))
    assert not bench.document.saved
    wait(bench.qtbot, lambda: bench.panel.complete)
    bench.panel.save(tmp_path / "out.h5")
    bench.told("out.h5 is saved")
    assert scene.read_text(encoding="utf-8") == FINGER_SCENE


@pytest.mark.timeout(500)
def test_given_play_then_the_rig_plays_the_scene_and_stop_mutes_it(bench, finished):
    panel = bar = bench.panel
    bench.edit(line_scene())
    assert not bar.actions_by_name["play"].isEnabled()
    bar.rig_field.line.setText(str(finished.with_name("rig.toml")))
    bar.rig_field.line.editingFinished.emit()
    bench.edit(line_scene(amplitude=0.5))
    assert bar.actions_by_name["play"].isEnabled()
    bar.loops.setValue(2)
    states: list[str] = []
    panel.playing.changed.connect(lambda: states.append(panel.playing.state))
    bench.qtbot.mouseClick(bar.buttons["play"], LEFT)
    assert panel.playing.state == RENDERING
    wait(bench.qtbot, lambda: panel.playing.state != RENDERING)
    bench.told("the scene: played; the outputs are muted")
    assert list(dict.fromkeys(states)) == [RENDERING, OPENING, PLAYING, IDLE]
    assert panel.playing.state == IDLE

    bench.qtbot.mouseClick(bar.buttons["play"], LEFT)
    assert panel.playing.state == RENDERING
    bench.qtbot.mouseClick(bar.buttons["stop"], LEFT)
    bench.told("nothing was played")
    assert panel.playing.state == IDLE

    bar.gain.setValue(60.0)
    bench.qtbot.mouseClick(bar.buttons["play"], LEFT)
    wait(bench.qtbot, lambda: panel.playing.state != RENDERING)
    bench.told("the rig's actuators may get")

    bar.gain.setValue(-3.0)
    bench.qtbot.mouseClick(bar.buttons["play"], LEFT)
    wait(bench.qtbot, lambda: panel.playing.state == OPENING)
    process = panel.playing.own.pid
    panel.playing.detach()
    _, status = os.waitpid(process, 0)  # the window does not wait for it; it ends by itself, muted
    assert os.waitstatus_to_exitcode(status) != 0


def test_given_a_play_that_is_watched_then_it_ends_muted_when_its_input_closes(finished):
    out = finished.with_name("drive.h5")
    none = np.zeros(0, np.int64)
    write_drive(out, Drive(np.full((3, 20_000), 0.1), 10_000.0, 0.0, "exact", 1.0, 0.0, none, none, none))
    command = [*WAVEFOCUS, "play", str(out), "--rig", str(finished.with_name("rig.toml")), "--lines"]
    ended = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert ended.returncode == 130
    assert "stopped by the user; the outputs are muted" in ended.stderr


def test_given_quiet_places_then_the_levels_reached_are_shown_beside_those_asked_for(qtbot, bench):
    quiet = (QuietTable(at_mm=(4.5, 4.5), level_db=-20.0),)
    draft = line_scene(end_mm=1.5).model_copy(update={"quiet": quiet, "output": Output(most_energy=1.5)})
    bench.edit(draft)
    (level,) = bench.panel.results.facts["quiet"]
    assert (level["name"], level["level_db"]) == ("quiet[0]", -20.0)
    ((_, value, verdict, _),) = [one for one in figures_of(bench.panel.results) if one[0] == "level at quiet[0]"]
    assert value == f"{level['reached_db']:.1f} dB of -20 dB"
    assert verdict == (GOOD if level["reached_db"] <= -19.8 else MISSED)  # as `render` warns
