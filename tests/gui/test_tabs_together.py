"""What the tabs of one window owe each other: instruments, closing, a quick start, and one look."""

import subprocess
import sys

import numpy as np
import pytest

from tests.gui.conftest import answer, campaign_of, edit, line_scene, press, tab_of, wait, write_lab
from tests.gui.test_run import HOLDER
from tests.lab_files import ABSENT_RIG
from wavefocus.gui.rig.tab import RigTab
from wavefocus.gui.scene.exports import IDLE
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.verification.tab import VerificationTab
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.writer import create_bank


@pytest.fixture
def real_rig(tmp_path):
    """A rig file of instruments that are not there."""
    (tmp_path / "real.toml").write_text(ABSENT_RIG.format(folder=tmp_path.as_posix()), encoding="utf-8")
    return tmp_path / "real.toml"


@pytest.fixture
def measured_now(tmp_path):
    """A bank of a real rig, and the process that owns it."""
    bank = tmp_path / "real.h5"
    header = BankHeader(
        sample_rate_hz=10_000.0,
        taps=100,
        position_mm=np.array([[0.0, 0.0], [1.5, 0.0]]),
        actuator_mm=np.array([[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]),
        band_hz=(20.0, 500.0),
        rig_json='{"mirror": {"driver": "asi-tiger"}}',
        run_json="{}",
        plan_sha256="0" * 64,
        software="a test",
    )
    create_bank(bank, header)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(bank)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as owner:
        assert owner.stdout.readline().strip() == b"mine"
        yield bank, owner.pid
        owner.communicate(timeout=20)


def test_a_campaign_on_a_real_rig_then_other_tabs_say_that_its_instruments_are_busy(
    qtbot, open_window, measured_now, real_rig, tmp_path
):
    bank, owner = measured_now
    window = open_window(bank, real_rig)
    rig, scene, verification = tab_of(window, RigTab), tab_of(window, SceneTab), tab_of(window, VerificationTab)
    wait(qtbot, lambda: bool(campaign_of(window).run.held))

    def refused(word: str) -> None:
        assert f"process {owner} on " in window.messages.sentence
        assert window.messages.sentence.endswith(f"measures {bank}, so the instruments are busy: stop it first")
        assert [button.text() for button in window.messages.buttons] == [f"{word} anyway"]
        window.messages.dismiss()

    rig.examine()
    refused("Examine")
    rig.take()
    refused("Open them")
    rig.calibrate([])
    refused("Calibrate")
    assert [rig.examination.command.running, rig.session.running, rig.calibration.running] == [False, False, False]
    scene.results.rig_field.line.setText(str(real_rig))
    scene.results.play()
    refused("Play")
    assert scene.results.playing.state == IDLE
    form = verification.form
    (tmp_path / "scene.toml").write_text("[scene]\n", encoding="utf-8")
    for field, path in (
        (form.scene, tmp_path / "scene.toml"),
        (form.bank, bank),
        (form.rig, real_rig),
        (form.out, tmp_path / "verify"),
    ):
        field.show_path(path)
    verification.row.start.trigger()
    refused("Verify")
    assert not verification.run.running
    # Instruments in software are for everybody.
    form.rig.line.setText("virtual")
    verification.row.start.trigger()
    assert verification.run.running
    assert verification.run.held == ""
    verification.run.cancel()
    wait(qtbot, lambda: not verification.run.running)


def test_instruments_in_hand_then_a_campaign_on_them_is_not_started_without_a_word(
    qtbot, open_window, real_rig, tmp_path
):
    run = write_lab(tmp_path / "lab", 4, 3)
    text = run.read_text(encoding="utf-8").partition("[virtual]")[0]
    run.write_text(text.replace('"rig.toml"', f'"{real_rig}"'), encoding="utf-8")
    window = open_window(real_rig, run)
    tab, rig = campaign_of(window), tab_of(window, RigTab)
    wait(qtbot, tab.controls.buttons["start"].isEnabled)
    rig.take()
    assert rig.session.running
    press(qtbot, tab.controls.buttons["start"])
    told = "the Rig tab has the instruments of real.toml, so the instruments are busy: stop it first"
    assert window.messages.sentence == told
    assert tab.run.own is None
    answer(window, "Start anyway")
    assert tab.run.own is not None
    wait(qtbot, lambda: tab.run.own is None)  # the capture finds no such instruments


def test_campaign_and_unsaved_scene_then_closing_asks_one_after_other_and_then_acts(qtbot, open_window, long_run):
    window = open_window(long_run)
    tab, scene = campaign_of(window), tab_of(window, SceneTab)
    press(qtbot, tab.controls.buttons["start"])
    wait(qtbot, tab.controls.buttons["stop"].isEnabled)
    edit(scene.document, line_scene(step_mm=4.0))
    window.close()
    assert "plate.h5 is being measured by a run of this window" in window.messages.sentence
    answer(window, "Stop after this position")
    assert "a new scene has unsaved changes" in window.messages.sentence
    answer(window, "Do not close")
    assert window.isVisible()
    assert window.messages.sentence == ""  # nothing was ordered
    assert tab.run.own is not None
    window.close()
    answer(window, "Stop after this position")
    answer(window, "Close without saving")
    wait(qtbot, lambda: not window.isVisible())
    log = long_run.with_name("plate.events.jsonl")
    wait(qtbot, lambda: "session_ended" in log.read_text(encoding="utf-8"))


def test_a_bank_of_another_lab_then_it_is_said_whole_and_stays_and_start_is_off(qtbot, open_window, finished, tmp_path):
    other = write_lab(tmp_path / "other", 2, 2)
    window = open_window(other)
    tab, scene = campaign_of(window), tab_of(window, SceneTab)
    wait(qtbot, tab.controls.buttons["start"].isEnabled)
    scene.bank_field.line.setText(str(finished))
    scene.bank_field.line.editingFinished.emit()
    wait(qtbot, lambda: "plate.h5 is not of run.toml" in tab.progress.faults.text())
    assert str(finished) in tab.progress.faults.text()
    wait(qtbot, lambda: not tab.controls.buttons["start"].isEnabled())
    window.messages.note("something else")
    assert tab.progress.faults.isVisible()
    window.open_file(finished.with_name("run.toml"))  # the run of that bank
    window.open_file(finished)
    wait(qtbot, lambda: tab.progress.faults.text() == "")
    wait(qtbot, tab.controls.buttons["start"].isEnabled)
