"""Rendering, playing and scanning on the virtual rig, through the commands."""

import json
import shutil

import h5py
import numpy as np
import pytest
import soundfile

from tests.lab_files import change_text, write_positions
from tests.system.captures import answered, refused, said_by, wavefocus
from tests.system.conftest import add_to_rig, with_faults
from tests.system.lines import Lines, wait_until
from wavefocus.rendering.verify.record import read_record
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.scan_journal import ScanJournal, ScannedPosition


def _command(lab, bank, *more):
    return ["verify", lab / "scene.toml", "--bank", bank, "--rig", lab / "rig.toml", "--out", lab / "verify", *more]


def test_given_a_measured_bank_then_scan_and_prediction_agree_and_the_report_says_so(lab, bank, capsys):
    printed = answered(capsys, *_command(lab, bank))
    assert printed["passed"] is True
    figures = {figure["name"]: figure["value"] for figure in printed["figures"]}
    assert figures["normalised error"] < 2.0
    assert figures["correlation"] > 0.999
    report = (lab / "verify" / "report.html").read_text(encoding="utf-8")
    assert "✓ Passed" in report
    assert "<script" not in report
    assert "https://" not in report
    assert "http://" not in report.replace("http://www.w3.org", "")
    with h5py.File(lab / "verify" / "scan.h5", "r") as scan, h5py.File(lab / "verify" / "prediction.h5", "r") as field:
        assert scan["field"].shape == field["field"].shape
        assert scan.attrs["start_s"] == field.attrs["start_s"]


def test_one_position_and_another_loopback_then_its_field_but_no_focus_nor_drift(lab, capsys):
    write_positions(lab, [(0, 0)])
    line = '{ kind = "line", start_mm = [0, 0], end_mm = [8, 0] }'
    change_text(lab / "scene.toml", line, '{ kind = "point", at_mm = [0, 0] }')
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "one.h5") == 0
    add_to_rig(lab, "[recorder]\nreference_gain = 0.9\n")
    printed = said_by(capsys, *_command(lab, lab / "one.h5"), "--json")
    figures = {one["name"]: one["value"] for one in json.loads(printed.out)["figures"]}
    assert figures["normalised error"] < 2.0
    assert figures["focus to path point"] is None
    assert "sentinel level" not in figures
    assert "usable record: the reference is 0.92 dB above its calibration" in printed.err


def test_given_a_finger_on_the_plate_then_the_drive_is_corrected_by_scans(lab, bank, capsys):
    add_to_rig(lab, "[emulation.finger]\nplace_mm = [0.0, 0.0]\nmass_kg = 2e-4\n")
    change_text(lab / "scene.toml", "step_mm", "amplitude = 3e-4\nstep_mm")
    printed = answered(capsys, *_command(lab, bank, "--correct", "2"), code=1)["correction"]
    before, *after = [found["error"] for found in printed["rounds"]]
    assert before > 0.1
    assert after[printed["best"] - 1] < before / 4
    assert max(found["energy"] for found in printed["rounds"]) <= 5.0
    with h5py.File(lab / "verify" / "drive-corrected.h5") as file, h5py.File(lab / "verify" / "drive.h5") as first:
        assert file["drive"].shape == first["drive"].shape
        assert file.attrs["start_s"] == first.attrs["start_s"]
        assert np.abs(file["drive"][...]).max() <= 1.0
    record = read_record(lab / "verify" / "verify.json")
    assert len(record.correction.rounds) == len(printed["rounds"])
    assert "Correction of the drive" in (lab / "verify" / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("file", "old", "new", "options", "words"),
    [
        ("scene.toml", "step_mm", "amplitude = 0.0\nstep_mm", ("--correct", "1"), "is silent"),
        ("rig.toml", "110.0, 0.0", "109.0, 0.0", (), "actuators.position_mm"),
        ("scene.toml", "limit_v = 1.0", "", (), "output.limit_v"),
    ],
    ids=["a silent scene to correct", "other actuators", "beyond the rig's limit"],
)
def test_what_cannot_be_verified_is_refused_before_anything_plays(lab, bank, capsys, file, old, new, options, words):
    change_text(lab / file, old, new)
    assert words in refused(capsys, *_command(lab, bank, *options))
    assert not (lab / "verify" / "scan.h5").exists()
    log = lab / "verify" / "verify.events.jsonl"
    assert not log.exists() or "sentinel" not in log.read_text(encoding="utf-8")


def test_given_a_scan_with_a_lost_player_then_exit_3(lab, capsys):
    with_faults(lab, 'role = "player"\noperation = "play"\nkind = "lost"\nposition = 3\npurpose = "scan"')
    bank = lab / "plate.h5"
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 0
    printed = said_by(capsys, *_command(lab, bank), code=3).err
    assert "player" in printed.splitlines()[-1]
    assert "on the way out: virtual player" in printed


def test_given_wav_then_one_float_channel_per_actuator_at_the_interfaces_rate(lab, bank):
    files = ["--bank", bank, "--out", lab / "drive.h5", "--wav", lab / "drive.wav"]
    assert wavefocus("render", lab / "scene.toml", *files) == 0
    played, rate_hz = soundfile.read(lab / "drive.wav")
    drive_v = read_drive(lab / "drive.h5").drive_v
    assert (rate_hz, played.shape[1]) == (48_000, len(drive_v))
    assert np.abs(played).max() <= 1.0 / 5.0 * 1.05
    # Every 24th sample of the WAV falls on every 5th of the drive.
    common = min(played.shape[0] // 24, drive_v.shape[1] // 5)
    assert common > 100
    found, expected = 5.0 * played[: 24 * common : 24].T, drive_v[:, : 5 * common : 5]
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(drive_v).max())


def test_verification_killed_in_its_scan_then_same_command_goes_on_to_same_scan(lab, capsys):
    write_positions(lab, [(x_mm, y_mm) for y_mm in range(-4, 5, 4) for x_mm in range(-4, 13, 4)])
    bank, scene = lab / "more.h5", lab / "scene.toml"
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 0
    change_text(scene, "start_mm = [0, 0]", "start_mm = [1, 1]")
    render = ["render", scene, "--bank", bank, "--out"]
    assert wavefocus(*render, lab / "auto.h5") == 0
    change_text(scene, "[output]", '[output]\ninterpolation = "nearest"')
    assert wavefocus(*render, lab / "nearest.h5") == 0
    assert wavefocus(*_command(lab, bank)) in (0, 1)
    command, out = _command(lab, bank), lab / "verify"
    undisturbed, journal = (out / "scan.h5").read_bytes(), out / "scan.unfinished"
    shutil.rmtree(out)
    with Lines(*command, "--json") as killed:
        wait_until(lambda: journal.exists() and journal.stat().st_size > 2 * 4096, "two positions are scanned")
        killed.process.kill()
    assert not (out / "verify.json").exists()
    torn = journal.read_bytes()
    for of_earlier_version in (False, True):
        if of_earlier_version:  # "nearest" was the default; `auto` gives another drive between so many positions
            change_text(scene, 'interpolation = "nearest"', "")
            assert not np.array_equal(*(read_drive(lab / f"{kind}.h5").drive_v for kind in ("auto", "nearest")))
            shutil.rmtree(out)
            out.mkdir()
        journal.write_bytes(torn + torn[4096:5000])  # as a power cut may leave its end
        for published in ("drive.h5", "report.html"):  # as a kill leaves them that comes while results are moved in
            (out / published).write_bytes(b"of a verification without a record")
        capsys.readouterr()
        assert wavefocus(*command) in (0, 1)
        assert "the interrupted scan goes on" in capsys.readouterr().err
        assert (out / "scan.h5").read_bytes() == undisturbed
        assert not journal.exists()


def test_a_louder_actuator_is_named_first_in_a_scan_that_replaces_another_by_force(lab, bank, capsys):
    add_to_rig(lab, "\n[emulation]\noutput_gains_db = [0, 1]\n")
    (lab / "verify").mkdir()
    with ScanJournal(lab / "verify" / "scan.unfinished", "another", 5) as journal:
        journal.append(ScannedPosition(0, 1, 1, 0.0, 1.0, 1.0, np.zeros(5, np.float32)))
    assert "--force" in refused(capsys, *_command(lab, bank))
    (lab / "verify" / "scan.unfinished").write_bytes(b"somebody's")
    printed = said_by(capsys, *_command(lab, bank, "--linearity", "--force", "--positions", "1,4", "--json"), code=1)
    with h5py.File(lab / "verify" / "scan.h5", "r") as file:
        assert list(file["position_index"]) == [1, 4]
    record = read_record(lab / "verify" / "verify.json")
    assert [one.passed for one in record.figures if one.name == "linearity"] == [True]
    assert [actuator.level_db for actuator in record.actuators][:2] == pytest.approx([0.0, 1.0], abs=0.05)
    (symptom,) = json.loads(printed.out)["symptoms"]
    assert (symptom["code"], symptom["actuators"]) == ("level", [1])
    assert symptom["sentence"] in printed.err
    report = (lab / "verify" / "report.html").read_text(encoding="utf-8")
    assert report.index(symptom["sentence"]) < report.index(symptom["remedy"]) < report.index("<table>")
