"""The Rig tab in a real window: examine, operate by hand, calibrate; the virtual rig behind it in its own processes."""

from __future__ import annotations

import os
import signal
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from PyQt5.QtCore import QPoint, QPointF, Qt
from PyQt5.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from calibration.mirror_map import MirrorMap
from config.messages.rig_checks import Act, AskJog, Finding
from gui.rig.examination import button_of
from gui.rig.tab import RigTab, line_of
from gui.window import Window
from tests.gui.conftest import SOON_MS, tab_of, write_lab

MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0))
TRUE = MirrorMap(MAP)
RIG = f"""
[rig]
name = "practice"

[actuators]
position_mm = [[110.0, 0.0], [40.0, 66.0], [-40.0, 66.0], [-110.0, 0.0], [-40.0, -66.0], [40.0, -66.0]]

[player]
limit_v = 2.0

[emulation]
dead_actuators = [2]
mirror_map = {[list(row) for row in MAP]}
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path / "rig.toml"


def until(qtbot: QtBot, window: Window, true: Callable[[], object]) -> None:
    """Let the window live until something is so; else say what it showed."""
    try:
        qtbot.waitUntil(lambda: bool(true()), timeout=SOON_MS)
    except Exception as late:
        tab = tab_of(window, RigTab)
        shown = tab.session.state, tab.examination.summary.text(), tab.calibration_page.question.text()
        pytest.fail(f"it did not come about ({late}); the window says {window.messages.sentence!r}, {shown}")


def click(qtbot: QtBot, window: Window, button: object) -> None:
    until(qtbot, window, button.isEnabled)  # type: ignore[attr-defined]
    qtbot.mouseClick(button, Qt.MouseButton.LeftButton)


def in_hands(qtbot: QtBot, window: Window) -> RigTab:
    """The tab with the instruments in its hands."""
    tab = tab_of(window, RigTab)
    tab.pages.setCurrentWidget(tab.manual_page)
    click(qtbot, window, tab.manual_page.take)
    until(qtbot, window, lambda: tab.session.state == "ready" and tab.manual_page.sound.sweep.isEnabled())
    return tab


def test_given_a_rig_then_it_is_examined_and_a_remedy_leads_to_what_it_names(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab, page = tab_of(window, RigTab), tab_of(window, RigTab).examination
    click(qtbot, window, page.examine)
    until(qtbot, window, lambda: page.findings and not tab.examination.running)
    assert page.summary.text() == "1 not good enough, 16 ok"
    assert page.table.rowCount() == len(page.findings) == 17
    (row,) = (row for row, one in enumerate(page.findings) if one.verdict == "fail")
    assert page.table.item(row, 0).text() == "✖ fail"
    assert "actuator 2 is hardly above the noise" in page.table.item(row, 3).text()
    assert page.buttons.keys() == {row}
    assert page.buttons[row].text() == "Calibrate actuators…"
    page.only_bad.click()
    assert [page.table.isRowHidden(one) for one in range(17)] == [one != row for one in range(17)]
    click(qtbot, window, page.buttons[row])
    assert tab.pages.currentWidget() is tab.calibration_page
    parts = tab.calibration_page.options.parts
    assert [name for name, box in parts.items() if box.isChecked()] == ["actuators"]


def test_given_instruments_in_hand_then_they_are_jogged_heard_swept_and_given_back(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab = in_hands(qtbot, window)
    jog, sound, hands = tab.manual_page.jog, tab.manual_page.sound, tab.session
    assert sound.level_v.maximum() == 2.0
    assert sound.actuator.count() == 6

    view = jog.picture.getPlotItem().getViewBox()
    place = jog.picture.mapFromScene(view.mapViewToScene(QPointF(40.0, -25.0)))
    qtbot.mouseClick(jog.picture.viewport(), Qt.MouseButton.LeftButton, pos=QPoint(place.x(), place.y()))
    until(qtbot, window, lambda: hands.place_mm is not None)
    assert hands.place_mm == pytest.approx((40.0, -25.0), abs=1.0)
    until(qtbot, window, lambda: "mrad" in jog.where.text())
    before_mm = hands.place_mm[0]
    for _ in range(3):  # steps that come while the beam moves are not lost
        click(qtbot, window, jog.arrows.buttons["right"])
    until(qtbot, window, lambda: hands.place_mm[0] == pytest.approx(before_mm + 3.0, abs=1e-3))
    qtbot.keyClick(jog.picture, Qt.Key.Key_Left)
    until(qtbot, window, lambda: hands.place_mm[0] == pytest.approx(before_mm + 2.0, abs=1e-3))
    jog.x_mm.setValue(1000.0)
    click(qtbot, window, jog.go)
    until(qtbot, window, lambda: "mirror.limit_mrad" in window.messages.sentence)
    click(qtbot, window, jog.park)
    until(qtbot, window, lambda: hands.beam.parked)

    click(qtbot, window, jog.middle)
    sound.listen.click()
    until(qtbot, window, lambda: hands.levels is not None)
    quiet_v = hands.levels.response.rms_v
    sound.sounds.click()
    until(qtbot, window, lambda: hands.levels.response.rms_v > 5 * quiet_v)
    until(qtbot, window, lambda: sound.meter.held_v.get("reference", 0.0) > 0.1)
    assert "response" in sound.meter.accessibleName()

    sound.actuator.setCurrentIndex(2)
    click(qtbot, window, sound.sweep)
    until(qtbot, window, lambda: hands.sweep is not None and "▲" in sound.verdict.text())
    assert sound.figures.text().startswith("actuator 2 at ")
    assert len(sound.waveform.getPlotItem().listDataItems()) == 2
    assert len(sound.spectrum.getPlotItem().listDataItems()) == 2
    sound.actuator.setCurrentIndex(0)
    sound.again.click()
    sweeps: list[None] = []
    hands.sweep_changed.connect(lambda: sweeps.append(None))
    until(qtbot, window, lambda: len(sweeps) > 1 and "✔" in sound.verdict.text())
    click(qtbot, window, tab.manual_page.mute)
    until(qtbot, window, lambda: not hands.listening and not hands.sweeping)
    assert not sound.again.isChecked()
    click(qtbot, window, tab.manual_page.release)
    until(qtbot, window, lambda: hands.state == "released")


def test_given_marks_then_the_wizard_measures_draws_mends_and_writes_the_map(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab, page, calibration = (
        tab_of(window, RigTab),
        tab_of(window, RigTab).calibration_page,
        tab_of(window, RigTab).calibration,
    )
    tab.pages.setCurrentWidget(page)
    click(qtbot, window, page.options.start)
    for number in range(1, 8):
        meet(qtbot, window, number, off_mm=9.0 if number == 2 else 0.0)
    until(qtbot, window, lambda: page.residuals.rowCount() == 7)
    assert calibration.levels is not None
    assert "mark 2 is wrong" in page.note.text()
    assert "times larger" in page.note.text()
    assert not page.yes.isEnabled()
    assert page.chosen_mark == 2
    click(qtbot, window, page.redo)
    meet(qtbot, window, 2)
    until(qtbot, window, lambda: page.residuals.isVisible() and page.yes.isEnabled())
    click(qtbot, window, page.yes)
    until(qtbot, window, lambda: not calibration.running and "✔ written" in page.question.text())
    assert calibration.outcome is not None
    file = Path(str(calibration.outcome.file))
    assert tomllib.loads(file.read_text(encoding="utf-8"))["mirror"]["residual_rms_mm"] < 1e-3
    assert tomllib.loads(rig.read_text(encoding="utf-8"))["calibration"]["file"] == file.name


def test_given_a_wizard_that_is_cancelled_then_nothing_is_written_and_the_instruments_are_free(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab, page = tab_of(window, RigTab), tab_of(window, RigTab).calibration_page
    tab.pages.setCurrentWidget(page)
    page.options.marks.setCurrentIndex(1)
    click(qtbot, window, page.options.start)
    until(qtbot, window, lambda: "Mark 1 of 5" in page.question.text())
    tab.examine()
    assert "being calibrated; wait for its end, or cancel it" in window.messages.sentence
    click(qtbot, window, page.cancel)
    until(qtbot, window, lambda: page.question.text().startswith("cancelled"))
    assert {one.name for one in rig.parent.iterdir() if one.suffix == ".toml"} == {"rig.toml"}
    assert page.options.isVisible()


def test_given_the_process_is_killed_then_the_window_says_so_and_takes_them_again_and_a_close_frees_them(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab = in_hands(qtbot, window)
    assert tab.session.pid is not None
    os.kill(tab.session.pid, signal.SIGKILL)
    until(qtbot, window, lambda: tab.session.state == "released")
    assert "ended unexpectedly" in window.messages.sentence
    in_hands(qtbot, window)
    pid = tab.session.pid
    assert pid is not None
    window.close()
    assert not window.isVisible()
    qtbot.waitUntil(lambda: _ended(pid), timeout=SOON_MS)


def test_given_a_rig_file_with_a_mistake_then_it_is_a_sentence_and_the_window_lives(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    rig.write_text(RIG + "[mirror]\nlimit_mrad = -5\n", encoding="utf-8")
    window = open_window(rig)
    tab = tab_of(window, RigTab)
    click(qtbot, window, tab.examination.examine)
    until(qtbot, window, lambda: "mirror.limit_mrad" in window.messages.sentence)
    assert not tab.examination.findings
    rig.write_text("[rig\n", encoding="utf-8")
    tab.open_file(rig)
    assert f"{rig}: is no TOML file" in window.messages.sentence


def test_given_a_run_file_then_the_rig_that_it_names_is_taken(
    open_window: Callable[..., Window], tmp_path: Path
) -> None:
    run = write_lab(tmp_path / "lab", 2, 2)
    window = open_window(run)
    tab = tab_of(window, RigTab)
    tab.of_run.click()
    assert tab.rig is not None
    assert tab.rig.path == run.parent / "rig.toml"
    assert tab.rig.actuator_mm == [(110.0, 0.0), (0.0, 60.0), (-110.0, 10.0)]


def test_given_deeds_of_the_doctor_then_each_is_done_or_asked_first(
    qtbot: QtBot, open_window: Callable[..., Window], rig: Path
) -> None:
    window = open_window(rig)
    tab = tab_of(window, RigTab)
    tab.do("run", "pip install nidaqmx")
    assert QApplication.clipboard().text() == "pip install nidaqmx"
    assert "paste it into a terminal" in window.messages.sentence
    tab.do("calibrate", "")
    assert all(box.isChecked() for box in tab.calibration_page.options.parts.values())
    tab.do("reset-usb", "mirror")
    assert window.messages.sentence.startswith("Reset the USB device of the mirror?")
    assert not tab.examination.running
    (reset, _) = window.messages.buttons()
    click(qtbot, window, reset)
    until(qtbot, window, lambda: "expects no USB device of that role" in window.messages.sentence)


def test_given_a_key_then_its_line_in_the_rig_file_is_found(rig: Path) -> None:
    keys = ("player.limit_v", "player.channels", "usb", "rig.name")
    assert [line_of(rig, key) for key in keys] == [9, 8, 0, 3]


def test_given_findings_then_a_button_is_offered_where_something_can_be_done() -> None:
    finding = Finding("player", "latency", "warn", "30 ms", "raise it")
    assert button_of(finding) == ("again", "Check again")
    assert button_of(replace(finding, act=Act("edit-rig", "recorder.post_roll_s"))) == ("edit-rig", "Open the rig file")
    assert button_of(replace(finding, act=Act("calibrate"))) == ("calibrate", "Calibrate…")
    assert button_of(replace(finding, verdict="ok")) is None


def meet(qtbot: QtBot, window: Window, number: int, off_mm: float = 0.0) -> None:
    """Bring the spot onto the mark that is asked for, as a person does who sees where it really is."""
    tab = tab_of(window, RigTab)
    page, calibration = tab.calibration_page, tab.calibration
    until(qtbot, window, lambda: page.question.text().startswith(f"Mark {number} of 7") and page.yes.isEnabled())
    assert isinstance(calibration.question, AskJog)
    place, at = calibration.question.place_mm, calibration.question.at_mrad
    x_mrad, y_mrad = (float(one) for one in TRUE.angles_mrad(place[0] + off_mm, place[1]))
    if number == 1:
        until(qtbot, window, lambda: calibration.levels is not None)
    calibration.step(x_mrad - at[0], y_mrad - at[1])
    until(qtbot, window, lambda: f"({x_mrad:.3f}, {y_mrad:.3f})" in page.note.text())
    click(qtbot, window, page.yes)


def _ended(pid: int) -> bool:
    """Whether a child of this process has ended; nobody else waits for it any more."""
    try:
        return os.waitpid(pid, os.WNOHANG)[0] == pid
    except ChildProcessError:
        return True
