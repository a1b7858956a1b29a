"""The Verification tab: runs on the virtual rig in processes of their own, and what earlier ones left."""

import json
import os
import shutil
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import QApplication

from tests.gui.conftest import LEFT, pixel, shown_tab, wait
from tests.lab_files import stroke_scene, with_check_rows
from wavefocus.__main__ import run
from wavefocus.gui.files import FileKind, kind_of
from wavefocus.gui.film_player import TimeSlider
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.verification.tab import VerificationTab, unused_folder

SCENE = stroke_scene(
    [0, 1.5], [4.5, 1.5], 'kind = "sine", frequency_hz = 200.0, duration_s = 0.02', 'emission = "per_point"',
    "[output]\nlimit_v = 1.0", step_mm=1.5,
)  # fmt: skip


@pytest.fixture(scope="session")
def verified(measured, tmp_path_factory):
    """A lab whose bank was verified into the folder ``verify``; to be copied before anything is written."""
    lab = tmp_path_factory.mktemp("verified") / "lab"
    shutil.copytree(measured, lab)
    (lab / "scene.toml").write_text(SCENE, encoding="utf-8")
    files = ["--bank", lab / "plate.h5", "--rig", lab / "rig.toml", "--out", lab / "verify"]
    assert run(["verify", *map(str, [lab / "scene.toml", *files]), "--json"]) == 0
    return lab


@pytest.fixture
def lab(verified, tmp_path):
    """The same to be changed by a test."""
    return shutil.copytree(verified, tmp_path / "lab")


def other_bank(lab, name, *, gain=1.0, copies=1):
    """A bank with the measured one's Green's functions, louder by `gain`, and its grid several times side by side."""
    away_mm = np.array([[0.1 * copy, 0.1 * (copy % 7)] for copy in range(copies)])
    with h5py.File(lab / "plate.h5", "r") as file, h5py.File(lab / name, "w") as other:
        other["green"] = np.tile(file["green"][:] * np.float32(gain), (copies, 1, 1))
        other["position_mm"] = (away_mm[:, None, :] + file["position_mm"][:]).reshape(-1, 2)
        other["actuator_mm"] = file["actuator_mm"][:]
        other["status"] = np.tile(file["status"][:], copies)
        other.attrs.update({one: file.attrs[one] for one in ("sample_rate_hz", "rig", "run", "band_hz")})
    return lab / name


def opened(qtbot, window, file):
    """The tab with a verification that is read anew."""
    tab = shown_tab(window, VerificationTab)
    former = tab.results
    window.open_file(file)
    wait(qtbot, lambda: tab.results is not None and tab.results is not former)
    return tab


def ready(window, bank):
    """The tab with all chosen that a verification of a bank needs; the folder is a new one."""
    tab = shown_tab(window, VerificationTab)
    tab.form.take_bank(bank)
    tab.form.out.show_path(bank.with_name("new"))
    window.refresh()
    return tab


def test_an_earlier_verification_then_its_fields_and_figures_are_those_of_its_files(qtbot, shared_window, verified):
    tab = opened(qtbot, shared_window, file := verified / "verify" / "verify.json")
    record = json.loads(file.read_text(encoding="utf-8"))
    predicted, scanned, difference = tab.maps.maps
    with h5py.File(verified / "verify" / "scan.h5", "r") as file:
        sample = round((tab.maps.time.time_s - file.attrs["start_s"]) * file.attrs["sample_rate_hz"])
        of_file = 1e3 * file["field"][:, sample]  # shown in mm/s
    # Only what lies outside the bank's band differs from the file.
    assert np.linalg.norm(scanned.values - of_file) < 0.1 * np.linalg.norm(of_file)
    assert predicted.levels == scanned.levels
    assert predicted.levels[0] == -predicted.levels[1]
    assert "mm/s" in predicted.bar.accessibleName()
    in_mm_s = 1e-3 if "µm/s" in difference.bar.accessibleName() else 1.0
    np.testing.assert_allclose(in_mm_s * difference.values, scanned.values - predicted.values, atol=1e-6)
    assert tab.figures.table.rowCount() == len(record["figures"])
    item = tab.figures.table.item
    for row, figure in enumerate(record["figures"]):
        assert item(row, 0).text() == figure["name"]
        assert figure["definition"] in item(row, 0).toolTip()
        if figure["limit"] is not None:
            assert item(row, 5).text() == {True: "✓ pass", False: "✗ fail", None: "– not judged"}[figure["passed"]]
    error = next(one for one in record["figures"] if one["name"] == "normalised error")
    assert (item(0, 3).text(), item(0, 4).text()) == (f"{error['difference']:.3g} %", "≤ 5 %")


def test_given_a_click_on_a_map_or_the_slider_then_waveforms_figures_and_maps_follow(qtbot, shared_window, verified):
    tab, index = opened(qtbot, shared_window, verified / "verify" / "verify.json"), 7
    qtbot.waitExposed(tab.window())
    scan, record = tab.maps.maps[1], tab.results.record
    QApplication.processEvents()
    qtbot.mouseClick(scan.viewport(), LEFT, pos=pixel(scan, *record.position_mm[index]))
    wait(qtbot, lambda: tab.maps.marked == index)
    assert all(one.marked == index for one in tab.maps.maps)
    title = tab.maps.response.getPlotItem().titleLabel.text
    assert f"position {record.position_index[index]} " in title
    assert f"error {100 * record.position_error[index]:.3g} %" in title
    assert f"correlation {record.position_correlation[index]:.5f}" in title
    lines = [curve.yData for curve in tab.maps.response.curves]
    np.testing.assert_allclose(lines[2], lines[1] - lines[0], atol=1e-6 * np.abs(lines[1]).max())
    qtbot.keyClick(scan, Qt.Key.Key_Right)
    assert tab.maps.marked == index or record.position_mm[tab.maps.marked][0] > record.position_mm[index][0]
    time, focus, before = tab.maps.time, record.focus_s, tab.maps.maps[0].values.copy()
    assert time.time_s == pytest.approx(focus[0], abs=1e-4)
    qtbot.mouseClick(time.next, LEFT)
    assert time.time_s == pytest.approx(focus[1], abs=1e-4)
    assert time.time_label.text() == f"{1e3 * time.time_s:.2f} ms"
    assert not np.array_equal(before, tab.maps.maps[0].values)


def test_given_play_then_samples_follow_the_clock_and_begin_anew_at_the_end(qtbot):
    now_s = 0.0
    qtbot.addWidget(time := TimeSlider(lambda: now_s))
    time.show_samples(0.0, 1000.0, 101, marks=[10])
    time.slower.setCurrentIndex(time.slower.findData(50))
    time.play.click()
    for at_s, sample in ((2.0, 10 + 40), (4.6, 0)):  # the second is beyond the end
        now_s = at_s
        time.advance()
        assert (time.sample, time.playing) == (sample, True)
    time.to_mark(-1)
    assert time.sample == 10


def test_given_a_bank_that_is_too_loud_then_the_run_is_watched_and_its_failure_told(qtbot, open_window, lab):
    window, steps = open_window(), set()
    tab = ready(window, other_bank(lab, "loud.h5", gain=1.2))
    tab.form.positions.setText("every:2")
    tab.row.start.trigger()
    wait(qtbot, lambda: steps.add(tab.run.step.step) or tab.results is not None)
    assert steps & {"scan", "compare and report"}
    assert window.messages.sentence.startswith("Not good enough. ")
    assert "normalised error" in window.messages.sentence
    assert "not good enough" in tab.verdict.verdict.text()
    # What is beyond its limit stands above the maps, in the colour of faults.
    assert "▲ normalised error: " in tab.verdict.findings.text()
    assert tab.verdict.findings.isVisible()
    assert tab.verdict.findings.palette().windowText().color() == QColor(tab.verdict.theme.fault)
    assert tab.figures.table.item(0, 5).text() == "✗ fail"
    assert list(tab.results.record.position_index) == list(range(0, 12, 2))
    assert tab.results.folder == lab / "new"


@pytest.mark.skipif(os.name != "posix", reason="ends processes by signals")
def test_long_scan_then_closing_asks_cancel_parks_and_killed_process_is_sentence(qtbot, open_window, lab, monkeypatch):
    monkeypatch.setattr(CommandProcess, "interrupt", lambda _process: None)  # on Windows no signal reaches it
    window = open_window()
    tab = ready(window, other_bank(lab, "many.h5", copies=60))
    tab.row.start.trigger()
    tab.row.cancel.trigger()  # before its process can hear anything
    wait(qtbot, lambda: not tab.run.running)
    assert "muted and the mirror is parked" in window.messages.sentence
    assert not (lab / "new" / "verify.json").exists()
    tab.row.start.trigger()
    wait(qtbot, lambda: tab.run.step.step == "scan" and tab.run.step.done > 0)
    window.refresh()
    assert "left" in tab.row.figures.text()
    window.close()
    assert window.isVisible()
    words = [button.text() for button in window.messages.buttons]
    assert words == ["Continue in the background", "Stop, mute and park", "Do not close"]
    window.messages.buttons[2].click()
    tab.row.cancel.trigger()
    wait(qtbot, lambda: not tab.run.running)
    assert "muted and the mirror is parked" in window.messages.sentence
    tab.row.start.trigger()
    wait(qtbot, lambda: tab.run.step.step == "scan")
    os.kill(tab.run.own.pid, signal.SIGKILL)
    wait(qtbot, lambda: not tab.run.running)
    assert "ended unexpectedly" in window.messages.sentence
    assert "run the verification again" in window.messages.sentence


def test_given_a_spoilt_folder_then_one_sentence_and_what_was_shown_stays(qtbot, shared_window, lab):
    window = shared_window
    tab = opened(qtbot, window, lab / "verify" / "verify.json")
    shown = tab.results
    record, scan = lab / "verify" / "verify.json", lab / "verify" / "scan.h5"
    scan.write_bytes(scan.read_bytes()[:3000])
    window.open_file(record)
    wait(qtbot, lambda: "scan.h5" in window.messages.sentence)
    record.write_text('{"passed": true}', encoding="utf-8")
    window.open_file(record)
    wait(qtbot, lambda: "is not the record of a verification" in window.messages.sentence)
    record.unlink()
    window.open_file(record)
    wait(qtbot, lambda: "does not exist" in window.messages.sentence)
    assert tab.results is shown
    (lab / "verify" / "report.html").unlink()
    tab.figures.report.click()
    assert "report.html is gone" in window.messages.sentence


def test_check_positions_of_the_bank_then_they_are_rings_and_take_no_cells(qtbot, shared_window, lab):
    record = lab / "verify" / "verify.json"
    content = json.loads(record.read_text(encoding="utf-8"))
    content["bank"] = str(with_check_rows(lab / "plate.h5", lab / "checked.h5", 5, 10))
    record.write_text(json.dumps(content), encoding="utf-8")
    surface = opened(qtbot, shared_window, record).results.film.surface
    assert list(surface.checks) == [5, 10]
    assert set(np.unique(surface.raster.index)) == {*range(13)} - {5, 10}  # the last one: no position


@pytest.mark.smoke
def test_given_choices_then_the_command_has_them_and_what_a_folder_holds_stays(shared_window, tmp_path):
    bank, record = tmp_path / "plate.h5", tmp_path / "verify" / "verify.json"
    record.parent.mkdir()
    for path in (bank, record, record.with_name("scan.h5"), tmp_path / "scene.toml", tmp_path / "rig.toml"):
        path.write_bytes(b"")
    assert kind_of(record.with_name("scan.h5")) == FileKind.VERIFICATION
    assert kind_of(bank) == FileKind.BANK
    form = ready(shared_window, bank).form
    form.positions.clear()
    files = ["--bank", str(bank), "--rig", str(tmp_path / "rig.toml"), "--out", "out", "--json"]
    assert form.arguments(Path("out")) == ["verify", str(tmp_path / "scene.toml"), *files]
    form.positions.setText(" 0-3,7 ")
    form.rig.line.setText("virtual")
    arguments = form.arguments(Path("out"))
    assert arguments[-2:] == ["--positions", "0-3,7"]
    assert arguments[arguments.index("--rig") + 1] == "virtual"
    form.take_bank(bank)
    assert form.rig.line.text() == "virtual"  # what was typed stays
    # The next folder with a number is taken.
    assert unused_folder(tmp_path / "verify") == tmp_path / "verify-2"
    (precious := tmp_path / "verify-2" / "drive.h5").parent.mkdir()
    precious.write_bytes(b"precious")
    assert unused_folder(tmp_path / "verify-2") == tmp_path / "verify-3"
    assert precious.read_bytes() == b"precious"
    form.scene.line.clear()
    assert form.missing() == "choose a scene file"
