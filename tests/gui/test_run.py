"""Captures of the window and of others, what goes wrong, and what the tabs owe each other: instruments, closing."""

import os
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.gui.conftest import answer, campaign_of, edit, line_scene, press, shown_tab, tab_of, wait, write_lab
from tests.lab_files import ABSENT_RIG, change_text
from tests.system.lines import python
from wavefocus.campaign.control import read_heartbeat
from wavefocus.gui.campaign.follower import Follower
from wavefocus.gui.rig.tab import RigTab
from wavefocus.gui.scene.exports import IDLE
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.verification.tab import VerificationTab
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.ledger.owner import bank_owner


@pytest.fixture
def real_rig(tmp_path):
    """A rig file of instruments that are not there."""
    (tmp_path / "real.toml").write_text(ABSENT_RIG.format(folder=tmp_path.as_posix()), encoding="utf-8")
    return tmp_path / "real.toml"


def test_orders_and_files_that_fail_then_their_sentences_are_messages(qtbot, shared_window, finished, tmp_path):
    window, tab = shared_window, campaign_of(shared_window)

    def refused(words):
        wait(qtbot, lambda: words in window.messages.sentence)
        assert "Traceback" not in window.messages.sentence

    other, scene = Path(shutil.copy(finished, tmp_path / "other.h5")), tab_of(window, SceneTab)
    finished.with_name("plate.h5.heartbeat").unlink()  # this process measured the bank, and will own it
    window.open_file(finished)
    with BankWriter.open(finished):
        wait(qtbot, lambda: tab.progress.state.text() == "preparing")
        assert not tab.controls.actions_by_name["resume"].isEnabled()
        scene.bank_field.chosen.emit(other)
        window.refresh()
        assert (scene.document.bank, tab.bank_field.path) == (other, finished)  # and each is kept
        # Even one who is quicker than the buttons harms nothing.
        tab.run.start(["resume", str(finished)], finished)
        refused("owned by process")
        assert f"process {os.getpid()}" in window.messages.sentence
    (tmp_path / "no.h5").write_bytes(b"nothing of the kind" * 100)
    window.open_file(tmp_path / "no.h5")
    refused("no.h5")
    window.open_file(finished)
    tab.run.order("pause", finished)
    refused("no process owns the bank")
    wrong = write_lab(tmp_path / "wrong", 2, 2)
    change_text(wrong, "taps = 1000", "taps = -3")
    window.open_file(wrong)
    press(qtbot, tab.controls.actions_by_name["start"])
    refused("capture.taps")


def test_a_bank_deleted_under_the_window_is_told_and_followed_when_it_is_back(qtbot, open_window, finished):
    window = open_window(finished)
    tab, scene = campaign_of(window), tab_of(window, SceneTab)
    wait(qtbot, lambda: tab.campaign.measured == 12 and scene.live.backdrop.surface is not None)
    away = finished.rename(finished.with_name("away.h5"))
    wait(qtbot, lambda: "deleted or moved" in window.messages.sentence)
    tab.map_panel.map.show_position(3)
    wait(qtbot, lambda: "plate.h5 does not exist" in window.messages.sentence)
    shown_tab(window, SceneTab)  # reads its bank again
    wait(qtbot, lambda: scene.live.backdrop.surface is None)
    away.rename(finished)
    wait(qtbot, lambda: scene.live.backdrop.surface is not None)
    shown = shown_tab(window, type(tab)).map_panel.map

    def seen():
        if shown.marked != 4:  # the bank is opened anew at some time, and then no position is shown
            shown.show_position(4)
        return tab.position_panel.greens is not None and window.messages.sentence == ""

    wait(qtbot, seen)


def test_defect_while_bank_is_followed_then_window_says_so_and_goes_on_following(qtbot, open_window, finished):
    broken = [True]
    window = open_window()
    tab = campaign_of(window)
    tab.bank_field.show_path(finished)
    report = partial(tab.context.report, "campaign")
    tab.follower = Follower(finished, report, lambda bank: 1 / 0 if broken else read_heartbeat(bank))
    wait(qtbot, lambda: "is not followed" in window.messages.sentence)
    assert [button.text() for button in window.messages.buttons] == ["Copy details"]
    broken.clear()
    wait(qtbot, lambda: window.messages.sentence == "")


def test_a_campaign_on_a_real_rig_then_other_tabs_say_that_its_instruments_are_busy(
    qtbot, open_window, real_rig, tmp_path
):
    bank = tmp_path / "real.h5"
    header = BankHeader(
        10_000.0, 100, (20.0, 500.0), np.array([[0.0, 0.0], [1.5, 0.0]]), np.array([[110.0, 0.0], [0.0, 60.0]]),
        '{"mirror": {"driver": "asi-tiger"}}', "{}", "0" * 64, "a test",
    )  # fmt: skip
    create_bank(bank, header)
    (tmp_path / "scene.toml").write_text("[scene]\n", encoding="utf-8")
    with BankWriter.open(bank):
        window = open_window(bank, real_rig)
        rig, scene, verification = tab_of(window, RigTab), tab_of(window, SceneTab), tab_of(window, VerificationTab)
        wait(qtbot, lambda: bool(campaign_of(window).run.held))
        scene.rig_field.line.setText("virtual")
        assert scene.document.rig == "virtual"  # what the line shows counts, also without Enter
        scene.rig_field.line.setText(str(real_rig))
        form, start = verification.form, verification.row.start
        paths = tmp_path / "scene.toml", bank, real_rig, tmp_path / "verify"
        for field, path in zip((form.scene, form.bank, form.rig, form.out), paths, strict=True):
            field.show_path(path)
        for word, act in (
            ("Examine", rig.examine), ("Open them", rig.take), ("Calibrate", lambda: rig.calibrate([])),
            ("Play", scene.results.play), ("Verify", start.trigger),
        ):  # fmt: skip
            act()
            assert f"process {os.getpid()} on " in window.messages.sentence
            assert window.messages.sentence.endswith(f"measures {bank}, so the instruments are busy: stop it first")
            assert [button.text() for button in window.messages.buttons] == [f"{word} anyway"]
            window.messages.dismiss()
        assert not any(one.running for one in (rig.examination.command, rig.session, rig.calibration, verification.run))
        assert scene.results.output.state == IDLE
        form.rig.line.setText("virtual")  # instruments in software are for everybody
        start.trigger()
        assert verification.run.running
        assert verification.run.held == ""
        verification.run.cancel()
        wait(qtbot, lambda: not verification.run.running)


def test_another_calibration_and_a_drift_then_continue_anyway_accepts_both(open_window, finished, monkeypatch):
    window, asked = open_window(finished), []
    run = campaign_of(window).run
    monkeypatch.setattr(run, "run", lambda arguments, ended, **_options: asked.append((arguments, ended)))
    monkeypatch.setattr("wavefocus.gui.campaign.tab.session_failure", lambda *_: ("drift", "stopped by drift"))
    run.accept_calibration.setChecked(True)
    run.start(["resume"], finished)
    asked[0][1](SimpleNamespace(failure="stopped by drift", last_line="", stopped=False))
    answer(window, "Continue anyway")
    assert asked[1][0] == ["resume", "--accept-calibration", "--accept-drift"]


def test_instruments_in_hand_then_a_campaign_on_them_is_not_started_silently(qtbot, open_window, real_rig, tmp_path):
    run = write_lab(tmp_path / "lab", 4, 3)
    text = run.read_text(encoding="utf-8").partition("[virtual]")[0]
    run.write_text(text.replace('"rig.toml"', f'"{real_rig}"'), encoding="utf-8")
    window = open_window(real_rig, run)
    tab, rig = campaign_of(window), tab_of(window, RigTab)
    wait(qtbot, tab.controls.actions_by_name["start"].isEnabled)
    rig.take()
    assert rig.session.running
    press(qtbot, tab.controls.actions_by_name["start"])
    told = "the Rig tab has the instruments of real.toml, so the instruments are busy: stop it first"
    assert window.messages.sentence == told
    assert tab.run.own is None
    answer(window, "Start anyway")
    assert tab.run.own is not None
    wait(qtbot, lambda: tab.run.own is None)  # the capture finds no such instruments


def test_own_run_and_unsaved_scene_then_closing_asks_one_after_other_and_then_acts(qtbot, open_window, tmp_path):
    run_file = write_lab(tmp_path / "lab", 50, 40)  # it takes longer than any order on a busy machine
    window, bank = open_window(run_file), run_file.with_name("plate.h5")
    tab, scene = campaign_of(window), tab_of(window, SceneTab)
    press(qtbot, tab.controls.actions_by_name["start"])
    wait(qtbot, lambda: tab.campaign.measured > 0)
    edit(scene.document, line_scene())
    window.close()
    assert "plate.h5 is being measured by a run of this window" in window.messages.sentence
    answer(window, "Stop after this position")
    assert "a new scene has unsaved changes" in window.messages.sentence
    answer(window, "Do not close")
    assert window.isVisible()
    assert window.messages.sentence == ""  # nothing was ordered
    assert tab.run.own is not None
    window.close()
    answer(window, "Continue in the background")
    answer(window, "Close without saving")
    wait(qtbot, lambda: not window.isVisible())
    assert bank_owner(bank) is not None
    other, again = open_window(bank), open_window(bank)  # it is no run of theirs: followed, and left alone on closing
    wait(qtbot, lambda: campaign_of(other).progress.state.text() == "running")
    wait(qtbot, lambda: campaign_of(other).campaign.measured > tab.campaign.measured)
    assert other.close()
    assert bank_owner(bank) is not None
    press(qtbot, campaign_of(again).controls.actions_by_name["stop"])  # an order reaches it all the same
    wait(qtbot, lambda: bank_owner(bank) is None)
    press(qtbot, campaign_of(again).controls.actions_by_name["resume"])
    wait(qtbot, lambda: bank_owner(bank) is not None)
    again.close()
    answer(again, "Stop after this position")
    wait(qtbot, lambda: not again.isVisible())
    wait(qtbot, lambda: bank_owner(bank) is None)
    assert bank.with_suffix(".events.jsonl").read_text(encoding="utf-8").count('"session_ended"') == 2


def test_a_bank_of_another_lab_then_it_is_said_whole_and_stays_and_start_is_off(qtbot, open_window, finished, tmp_path):
    other = write_lab(tmp_path / "other", 2, 2)
    window = open_window(other)
    tab, scene = campaign_of(window), tab_of(window, SceneTab)
    wait(qtbot, tab.controls.actions_by_name["start"].isEnabled)
    scene.bank_field.line.setText(str(finished))
    scene.bank_field.line.editingFinished.emit()
    wait(qtbot, lambda: "plate.h5 is not of run.toml" in tab.progress.faults.text())
    assert str(finished) in tab.progress.faults.text()
    wait(qtbot, lambda: not tab.controls.actions_by_name["start"].isEnabled())
    window.messages.note("something else")
    assert tab.progress.faults.isVisible()
    window.open_file(finished.with_name("run.toml"))  # the run of that bank
    window.open_file(finished)
    wait(qtbot, lambda: tab.progress.faults.text() == "")
    wait(qtbot, tab.controls.actions_by_name["start"].isEnabled)


def refused_at_start(*words, **environment):
    """The window's command ends with exit 2 and one sentence that has some words."""
    without = "DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"
    kept = {key: value for key, value in os.environ.items() if key not in without} | environment
    done = python("-m", "wavefocus", "gui", env=kept)
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("wavefocus: ")]
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in line


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="about X servers and fontconfig")
@pytest.mark.may_skip("Windows and macOS always have a display and fonts")
def test_given_no_display_a_dead_one_or_no_font_then_exit_2_and_what_to_do(tmp_path):
    refused_at_start("needs a display", "DISPLAY")
    refused_at_start("no X server answers at DISPLAY=:4711", DISPLAY=":4711")
    none = tmp_path / "fonts.conf"
    none.write_text("<?xml version='1.0'?><fontconfig></fontconfig>", encoding="utf-8")
    environment = {"FONTCONFIG_FILE": str(none), "FONTCONFIG_PATH": str(tmp_path)}
    refused_at_start("no font", "fonts-dejavu-core", QT_QPA_PLATFORM="offscreen", **environment)


def test_given_no_pyqt5_or_a_library_that_it_misses_then_exit_2_and_what_to_install(tmp_path):
    for failure, *words in (
        ("""ModuleNotFoundError("No module named 'PyQt5'", name="PyQt5")""", 'pip install "wavefocus[window]"'),
        ('ImportError("libGL.so.1: cannot open shared object file")', "libGL.so.1", "apt-get install", "libgl1"),
    ):
        (tmp_path / "PyQt5.py").write_text(f"raise {failure}\n", encoding="utf-8")
        refused_at_start(*words, PYTHONPATH=str(tmp_path), QT_QPA_PLATFORM="offscreen")
