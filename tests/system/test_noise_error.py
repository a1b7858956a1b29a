"""Levels that are stated: white noise in the rows, and the reference of each record."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import events_of, of_kind, wavefocus
from tests.system.conftest import with_faults
from wavefocus.__main__ import run
from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.calibration.check import check_bank
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.config.run import Virtual
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

STAGGERED = 'taps = 1000\nexcitation = "staggered"\nstagger_s = 0.15'


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("taps = 1000", "taps = 1000"),
        ("decay_s = 0.1", "decay_s = 0.6"),
        ("duration_s = 0.3", "duration_s = 0.6\nstop_hz = 200.0"),
        ("taps = 1000", STAGGERED),
    ],
    ids=["short periods", "long silence", "narrow band", "staggered"],
)
def test_given_white_noise_then_the_error_of_the_rows_is_stated_within_1_db(lab, capsys, before, after):
    file, bank = lab / "run.toml", lab / "plate.h5"
    text = file.read_text(encoding="utf-8").replace("noise_v = 1e-4", "noise_v = 1e-3")
    file.write_text(text.replace(before, after), encoding="utf-8")
    assert run(["capture", str(file), "--bank", str(bank)]) in (0, 1)
    with open_bank(bank) as view:
        configuration = bank_configuration(view)
        truth_db = compare_with_truth(view, virtual_rig(configuration.rig, configuration.run.virtual or Virtual()))
        stated_db = bank_noise_error_db(view)
        assert stated_db is not None
        median_db = float(np.median(stated_db))
        assert float(np.median(truth_db - stated_db)) == pytest.approx(0.0, abs=1.0)
        # The ratio itself would not do.
        assert float(np.median(truth_db + view.quality["snr_db"])) < -3.0
    capsys.readouterr()
    assert run(["status", str(bank), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["median_noise_error_db"] == pytest.approx(median_db)
    assert any(f"{median_db:.1f} dB" in found.message for found in check_bank(bank) if found.severity == "note")


def test_rows_that_noise_hides_then_they_are_counted_and_worst_is_one_that_is_heard(bank):
    with open_bank(bank) as view:
        plan = view.plan_sha256
    with BankWriter.open(bank, plan_sha256=plan) as writer:
        record = writer.record(2)
        snr_db = np.array([10.0, -230.0, 40.0], np.float32)
        writer.commit(2, writer.green(2), replace(record, snr_db=snr_db))
    (note,) = [found.message for found in check_bank(bank) if "white noise" in found.message]
    assert "in the worst (position 2, actuator 0)" in note
    assert "it hides: 1 (the first: position 2, actuator 1)" in note


READ = 'role = "recorder"\noperation = "read"\nkind = "faint_reference"\n'
SCHEDULES = ["sequential", "staggered"]


def _as(lab, schedule):
    change_text(lab / "run.toml", "[capture]\n", f'[capture]\nexcitation = "{schedule}"\n')


def _captured(lab, name, capsys):
    bank = lab / name
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    return bank, events_of(capsys.readouterr().out)


def _rows(bank):
    with h5py.File(bank, "r") as file:
        return file["status"][...], file["green"][...].astype(np.float64)


@pytest.mark.parametrize(("schedule", "level_db"), [("sequential", -0.3), ("staggered", 6.0)])
def test_a_faint_reference_in_one_record_of_each_position_is_taken_again(lab, capsys, schedule, level_db):
    _as(lab, schedule)
    quiet, _ = _captured(lab, "quiet.h5", capsys)
    faults = [f"{READ}position = {row}\nrecord = {'0' if schedule == 'staggered' else row % 3}" for row in range(6)]
    with_faults(lab, *(f"{one}\nlevel_db = {level_db}" for one in faults))
    bank, events = _captured(lab, "faint.h5", capsys)
    assert {tuple(one["defects"]) for one in of_kind(events, "position_repeated")} == {("reference level",)}
    status, green = _rows(bank)
    _, right = _rows(quiet)
    assert list(status) == [1] * 6
    assert np.linalg.norm(green - right) < 2e-2 * np.linalg.norm(right)  # the noise of both


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_that_changes_within_its_calibration_is_refused(lab, capsys, schedule):
    _as(lab, schedule)
    records = 3 if schedule == "sequential" else 1
    with_faults(lab, f"{READ}at_call = {2 * records + 2}\ncount = 999\nlevel_db = -0.2")
    bank, events = _captured(lab, "plate.h5", capsys)
    assert list(_rows(bank)[0]) == [1, 1, 4, 4, 4, 4]
    assert {tuple(one["defects"]) for one in of_kind(events, "position_committed")} == {
        (),
        ("reference level",),
    }
    with h5py.File(bank, "r") as file:
        assert file["quality/reference_db"][...] == pytest.approx([0.0, 0.0, -0.2, -0.2, -0.2, -0.2], abs=0.01)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_off_in_every_record_stops_capture_early_and_says_why(lab, capsys, schedule):
    _as(lab, schedule)
    with_faults(lab, f'{READ}purpose = "capture"\ncount = 999\nlevel_db = -0.54')
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert "every record" in last
    assert "0.54 dB below its calibration" in last
    assert "wavefocus doctor" in last
    assert list(_rows(lab / "plate.h5")[0]) == ([4] if schedule == "sequential" else [4, 4]) + [0] * (
        5 if schedule == "sequential" else 4
    )
