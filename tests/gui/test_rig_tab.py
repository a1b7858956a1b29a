"""The Rig tab in a real window: examine, operate by hand, calibrate, on the virtual rig; and kinds of TOML files."""

import os
import signal
import tomllib
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace
from PyQt5.QtCore import Qt

from tests.gui.conftest import LEFT, pixel, press, shown_tab, tab_of, wait
from tests.system.test_calibrate import PRACTICE, TRUE
from wavefocus.config.messages.rig_checks import Act, Finding
from wavefocus.gui.files import FileKind, kind_of, names_virtual_rig, rig_of_run
from wavefocus.gui.rig.tab import RigTab, button_of, remedy_of

RIG = PRACTICE.replace("limit_v = 4.0", "limit_v = 2.0") + "dead_actuators = [2]\n"
REAL_RIG = '[rig]\nname = "lab"\n\n[mirror]\ndriver = "mirrorcle"\n\n[player]\nlimit_v = 2.0\n'


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path / "rig.toml"


@pytest.fixture
def tab(shared_window, rig):
    """The Rig tab with the rig file, as it is at first."""
    shared_window.open_file(rig)
    tab = shown_tab(shared_window, RigTab)
    tab.pages.setCurrentWidget(tab.examination)
    tab.calibration_page.choose("mirror")
    return tab


def in_hands(qtbot, window):
    """The tab with the instruments in its hands."""
    tab = shown_tab(window, RigTab)
    tab.pages.setCurrentWidget(tab.manual_page)
    press(qtbot, tab.manual_page.take)
    wait(qtbot, lambda: tab.session.state == "ready" and tab.manual_page.sound.sweep.isEnabled())
    return tab


@pytest.mark.smoke
def test_given_a_rig_then_it_is_examined_and_a_remedy_leads_to_what_it_names(qtbot, tab):
    page = tab.examination
    press(qtbot, page.examine)
    wait(qtbot, lambda: page.findings and not tab.examination.command.running)
    good = sum(one.verdict == "ok" for one in page.findings)
    assert good > 10
    assert page.summary.text().startswith("1 not good enough, ")  # where nothing keeps a computer awake, 1 is skipped
    assert page.summary.text().endswith(f", {good} ok")
    assert page.table.rowCount() == len(page.findings) >= good + 1
    (row,) = (row for row, one in enumerate(page.findings) if one.verdict == "fail")
    assert page.table.item(row, 0).text() == "✖ fail"
    assert "actuator 2 is hardly above the noise" in page.table.item(row, 3).text()
    assert page.buttons.keys() == {row}
    assert page.buttons[row].text() == "Calibrate actuators…"
    press(qtbot, page.buttons[row])
    assert tab.pages.currentWidget() is tab.calibration_page
    parts = tab.calibration_page.parts
    assert [name for name, box in parts.items() if box.isChecked()] == ["actuators"]


def test_given_instruments_in_hand_then_they_are_jogged_heard_swept_and_given_back(qtbot, tab):
    window = in_hands(qtbot, tab.window()).window()
    jog, sound, hands = tab.manual_page.jog, tab.manual_page.sound, tab.session
    assert sound.level_v.maximum() == 2.0
    assert sound.actuator.count() == 6
    facts = hands.facts
    for level_v, largest_v in ((0.1, 0.5), (facts.level_v, 2.0)):  # of another rig with as many actuators
        hands.facts = replace(facts, level_v=level_v, largest_level_v=largest_v)
        hands.changed.emit()
        assert (sound.level_v.value(), sound.level_v.maximum()) == (pytest.approx(level_v, abs=1e-3), largest_v)

    qtbot.mouseClick(jog.picture.viewport(), LEFT, pos=pixel(jog.picture, 40.0, -25.0))
    wait(qtbot, lambda: hands.place_mm is not None)
    assert hands.place_mm == pytest.approx((40.0, -25.0), abs=1.0)
    wait(qtbot, lambda: "mrad" in jog.where.text())
    before_mm = hands.place_mm[0]
    for _ in range(3):  # steps that come while the beam moves are not lost
        press(qtbot, jog.arrows.buttons["right"])
    wait(qtbot, lambda: hands.place_mm[0] == pytest.approx(before_mm + 3.0, abs=1e-3))
    qtbot.keyClick(jog.picture, Qt.Key.Key_Left)
    wait(qtbot, lambda: hands.place_mm[0] == pytest.approx(before_mm + 2.0, abs=1e-3))
    jog.x_mm.setValue(1000.0)
    press(qtbot, jog.go)
    wait(qtbot, lambda: "mirror.limit_mrad" in window.messages.sentence)
    press(qtbot, jog.park)
    wait(qtbot, lambda: hands.beam.parked)

    press(qtbot, jog.middle)
    sound.listen.click()
    wait(qtbot, lambda: hands.levels is not None)
    quiet_v = hands.levels.response.rms_v
    sound.sounds.click()
    wait(qtbot, lambda: hands.levels.response.rms_v > 5 * quiet_v)
    wait(qtbot, lambda: hands.levels.reference.peak_v > 0.1)
    assert "response" in sound.meter.accessibleName()

    sound.actuator.setCurrentIndex(2)
    press(qtbot, sound.sweep)
    wait(qtbot, lambda: hands.sweep is not None and "▲" in sound.verdict.text())
    assert sound.figures.text().startswith("actuator 2 at ")
    assert "parked" not in sound.verdict.text()
    assert len(sound.waveform.getPlotItem().listDataItems()) == 2
    assert len(sound.spectrum.getPlotItem().listDataItems()) == 2
    sound.actuator.setCurrentIndex(0)
    wait(qtbot, lambda: not hands.sweeping)  # a second sweep is not asked for before
    press(qtbot, sound.sweep)
    wait(qtbot, lambda: "✔" in sound.verdict.text())
    press(qtbot, tab.manual_page.mute)
    wait(qtbot, lambda: not hands.listening and not hands.sweeping)
    press(qtbot, jog.park)
    wait(qtbot, lambda: hands.beam.parked)
    press(qtbot, sound.sweep)
    wait(qtbot, lambda: "parked" in sound.verdict.text())  # what it shows is not of the surface
    press(qtbot, tab.manual_page.release)
    wait(qtbot, lambda: hands.state == "released")


def test_given_marks_then_the_wizard_measures_draws_mends_and_writes_the_map(qtbot, tab, rig):
    window, page, calibration = tab.window(), tab.calibration_page, tab.calibration
    tab.pages.setCurrentWidget(page)
    press(qtbot, page.start)
    for number in range(1, 8):
        meet(qtbot, window, number, off_mm=9.0 if number == 2 else 0.0)
    wait(qtbot, lambda: page.residuals.rowCount() == 7)
    assert "mark 2 is wrong" in page.note.text()
    assert not page.yes.isEnabled()
    assert page.chosen_mark == 2
    press(qtbot, page.redo)
    meet(qtbot, window, 2)
    wait(qtbot, lambda: page.residuals.isVisible() and page.yes.isEnabled())
    press(qtbot, page.yes)
    wait(qtbot, lambda: not calibration.running and "✔ written" in page.question.text())
    file = Path(str(calibration.outcome.file))
    assert tomllib.loads(file.read_text(encoding="utf-8"))["mirror"]["residual_rms_mm"] < 1e-3
    assert tomllib.loads(rig.read_text(encoding="utf-8"))["calibration"]["file"] == file.name


def test_a_wizard_without_moves_says_what_to_do_and_writes_nothing(qtbot, tab, rig):
    window, page = tab.window(), tab.calibration_page
    tab.pages.setCurrentWidget(page)
    press(qtbot, page.start)
    wait(qtbot, lambda: "Mark 1 of 7" in page.question.text())
    tab.examine()
    assert "being calibrated; wait for its end, or cancel it" in window.messages.sentence
    for number in range(1, 8):  # "on the mark" each time, where the beam stood
        wait(qtbot, lambda number=number: f"Mark {number} of 7" in page.question.text() and page.yes.isEnabled())
        press(qtbot, page.yes)
    wait(qtbot, lambda: "▲ Move the beam onto at least 4 marks. It was moved at 0 of 7" in page.note.text())
    assert not page.yes.isEnabled()
    press(qtbot, page.cancel)
    wait(qtbot, lambda: page.question.text().startswith("cancelled"))
    assert {one.name for one in rig.parent.iterdir() if one.suffix == ".toml"} == {"rig.toml"}
    assert page.options.isVisible()


def test_instruments_of_a_killed_process_are_taken_again_and_freed_by_a_close(qtbot, open_window, rig):
    window = open_window(rig)
    tab = in_hands(qtbot, window)
    os.kill(tab.session.own.pid, signal.SIGKILL)
    wait(qtbot, lambda: tab.session.state == "released")
    assert "ended unexpectedly" in window.messages.sentence
    in_hands(qtbot, window)
    pid = tab.session.own.pid
    window.close()
    assert not window.isVisible()
    os.waitpid(pid, 0)  # the window does not wait for it


def test_examination_or_calibration_then_its_rig_stays_and_a_close_ends_it_first(open_window, rig, tmp_path):
    tab, ended = tab_of(window := open_window(rig), RigTab), []
    for name, command in (("examined", tab.examination.command), ("calibrated", tab.calibration)):
        command.own = SimpleNamespace(interrupt=partial(ended.append, name), detach=lambda: None)
    tab.rig_field.show_path(tmp_path / "other.toml")
    tab.open_file(tmp_path / "other.toml")
    assert window.messages.sentence == "rig.toml is being examined; wait for its end, or cancel it"
    assert tab.rig_field.path == tab.rig == rig
    (tmp_path / "other.toml").write_text(RIG, encoding="utf-8")
    for path in (tmp_path / "other.toml", rig):  # the one opened last reaches the other tabs
        tab.open_file(path)
        assert (tab.context.shared[FileKind.RIG], tab.rig) == (path, rig)
    window.close()
    assert ended == ["examined", "calibrated"]


def test_given_no_rig_or_a_wrong_one_then_it_is_said_and_nothing_is_offered(qtbot, open_window, rig):
    window = open_window()
    tab = shown_tab(window, RigTab)

    def enabled():
        window.refresh()
        return {action.text() for action in tab.menu_actions() if action is not None and action.isEnabled()}

    assert enabled() == set()
    window.open_file(rig)
    assert enabled() == {"E&xamine", "&Open instruments"}
    rig.write_text(RIG + "[mirror]\nlimit_mrad = -5\n", encoding="utf-8")
    press(qtbot, tab.examination.examine)
    wait(qtbot, lambda: "mirror.limit_mrad" in window.messages.sentence)
    assert not tab.examination.findings
    rig.write_text("[rig\n", encoding="utf-8")
    tab.open_file(rig)
    assert f"{rig}: not TOML" in window.messages.sentence


def test_given_findings_then_a_button_is_offered_where_the_window_can_do_something():
    finding = Finding("player", "latency", "warn", "30 ms", "raise it")
    edit = replace(finding, act=Act("edit-rig", "recorder.post_roll_s"))
    calibrate = replace(finding, remedy="run wavefocus calibrate --only outputs", act=Act("calibrate", "outputs"))
    for one, button, remedy in (
        (finding, ("again", "Check again"), "raise it"),
        (edit, ("again", "Check again"), "raise it (recorder.post_roll_s in the rig file)"),
        (calibrate, ("calibrate", "Calibrate outputs…"), "press Calibrate outputs…"),
        (replace(finding, verdict="ok"), None, "raise it"),
    ):
        assert (button_of(one), remedy_of(one)) == (button, remedy)


KINDS = {
    '[[source]]\npath = { kind = "point" }\n': FileKind.SCENE, '[scene]\nbank = "plate.h5"\n': FileKind.SCENE,
    REAL_RIG: FileKind.RIG, "\ufeff" + REAL_RIG: FileKind.RIG,  # with a byte-order mark
    '[mirror]\ndriver = "virtual"\n[player]\nlimit_v = 1.0\n': FileKind.RIG,
    "[actuators]\nposition_mm = [[0, 0], [10, 0]]\n": FileKind.RIG, '[rig]\nname = "lab"\n': FileKind.RIG,
    'rig = "rig.toml"\n\n[grid]\nspacing_mm = 2.0\n': FileKind.RUN, "rig = [": None, None: None,
    'format = "wavefocus-calibration"\nrig = "lab"\n[mirror]\ndevice = "virtual mirror"\n': FileKind.CALIBRATION,
}  # fmt: skip


def test_the_kind_of_a_file_follows_from_its_tables_whatever_editor_wrote_it(tmp_path):
    for number, (text, kind) in enumerate(KINDS.items()):
        file = tmp_path / f"{number}.toml"
        if text is not None:
            file.write_text(text, encoding="utf-8")
        assert kind_of(file) is kind
    rig, run = tmp_path / "rig.toml", tmp_path / "run.toml"
    rig.write_text("\ufeff" + REAL_RIG, encoding="utf-8")
    run.write_text('\ufeffrig = "rig.toml"\n', encoding="utf-8")
    assert rig_of_run(run) == rig
    assert not names_virtual_rig(rig)


def meet(qtbot, window, number, off_mm=0.0):
    """Bring the spot onto the mark that is asked for, as a person does who sees where it really is."""
    tab = shown_tab(window, RigTab)
    page, calibration = tab.calibration_page, tab.calibration
    wait(qtbot, lambda: page.question.text().startswith(f"Mark {number} of 7") and page.yes.isEnabled())
    place, at = calibration.question.place_mm, calibration.question.at_mrad
    x_mrad, y_mrad = (float(one) for one in TRUE.angles_mrad(place[0] + off_mm, place[1]))
    if number == 1:
        wait(qtbot, lambda: calibration.levels is not None)
    calibration.step(x_mrad - at[0], y_mrad - at[1])
    wait(qtbot, lambda: f"({x_mrad:.3f}, {y_mrad:.3f})" in page.note.text())
    press(qtbot, page.yes)
