"""Sequential and staggered captures, their recordings, and the levels that a bank states."""

import json
import shutil
import signal
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import Listener, answered, captured, held, refused, resumed_after_a_kill, wavefocus
from tests.system.conftest import with_faults, write_lab
from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.calibration.check import check_bank
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.campaign.blueprint import bank_configuration, blueprint_from_bank, blueprint_from_files, blueprint_of
from wavefocus.config.run import Virtual
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank

KEEP = "keep_raw = true"
SCHEDULES = ["sequential", "staggered"]


def _with_capture(lab, *lines):
    """The lab's run file with more lines in its capture table."""
    change_text(lab / "run.toml", "[capture]\n", "[capture]\n" + "".join(f"{line}\n" for line in lines))


def _as(schedule):
    return f'excitation = "{schedule}"'


@pytest.fixture(scope="module")
def labs(tmp_path_factory):
    """A lab of each schedule with a bank and its recordings; to be copied."""
    labs = {}
    for schedule in SCHEDULES:
        labs[schedule] = lab = write_lab(tmp_path_factory.mktemp(schedule))
        _with_capture(lab, _as(schedule), KEEP)
        assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    return labs


def _errors_db(bank):
    """Error of each row, in dB: by the plate's truth, and as the bank's noise states it."""
    with open_bank(bank) as view:
        configuration = bank_configuration(view)
        rig = virtual_rig(configuration.rig, configuration.run.virtual or Virtual())
        return compare_with_truth(view, rig), bank_noise_error_db(view)


def test_a_staggered_bank_is_as_near_the_truth_as_a_sequential_one(labs):
    sequential_db, staggered_db = (np.nanmedian(_errors_db(labs[one] / "plate.h5")[0]) for one in SCHEDULES)
    assert held(labs["staggered"] / "plate.h5") == [1] * 6
    # A period of 0.375 s takes the place of two sweeps of 0.3 s each.
    assert staggered_db < sequential_db + 10 * np.log10(0.6 / 0.375) + 1.5


def test_given_sigkill_then_staggered_bank_and_recordings_end_byte_identical(lab, labs):
    _with_capture(lab, _as("staggered"), KEEP)
    assert 0 in resumed_after_a_kill(lab, lab / "plate.h5", "position_committed")
    for name in ("plate.h5", "plate.raw.h5"):
        assert (lab / name).read_bytes() == (labs["staggered"] / name).read_bytes()


def test_a_staggered_bank_measures_one_position_both_ways_and_states_it(lab, capsys):
    _with_capture(lab, _as("staggered"))
    bank, trial = lab / "plate.h5", 'role = "recorder"\noperation = "read"\npurpose = "trial"'
    with_faults(
        lab,
        'role = "mirror"\noperation = "wait_settled"\nkind = "timeout"\nat_call = 1',
        f'{trial}\nattempt = 2\nrecord = 1\nkind = "missing_reference"',
        f'{trial}\nattempt = 3\nrecord = 0\nkind = "unplugged"',
    )
    told = captured(capsys, lab)
    compared = told.of()[0]
    assert compared["event"] == "schedule_settled"
    assert str(compared["reason"]) in told.err
    staggered, sequential = compared["candidates"]
    assert staggered["name"] == compared["chosen"]
    assert -70.0 < sequential["error_db"] < staggered["error_db"] < -25.0
    assert staggered["campaign_s"] < sequential["campaign_s"]
    # The bank is there: nothing is compared again.
    assert not captured(capsys, lab).of("schedule_settled")
    assert wavefocus("resume", bank) == 0


def test_given_sigterm_while_both_ways_are_measured_then_it_ends_in_130(lab, monkeypatch):
    _with_capture(lab, _as("staggered"))
    with_faults(lab, 'role = "mirror"\noperation = "wait_settled"\nkind = "timeout"\nat_call = 1')
    former = signal.signal(signal.SIGTERM, lambda *_: None)
    monkeypatch.setattr(sys, "stderr", Listener(("repeated", lambda: signal.raise_signal(signal.SIGTERM))))
    code = wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5")
    signal.signal(signal.SIGTERM, former)
    assert (code, (lab / "plate.h5").exists()) == (130, False)


def test_given_a_bank_whose_trial_has_settled_sequential_capture_then_it_goes_on_so(lab):
    _with_capture(lab, _as("staggered"))
    blueprint = blueprint_from_files(lab / "run.toml")
    run = blueprint.configuration.run
    capture = run.capture.model_copy(update={"excitation": "sequential", "level_db": -6.0})
    settled = blueprint_of(replace(blueprint.configuration, run=run.with_schedule(capture, "it distorts")))
    header = settled.bank_header()
    run_json = json.loads(header.run_json)
    run_json["settled"]["asked"] |= {"when_staggered_does_not_pay": "choose", "allowed_loss_db": 3.0}
    create_bank(lab / "plate.h5", replace(header, run_json=json.dumps(run_json)))
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    assert blueprint_from_bank(lab / "plate.h5").plan.staggered is None


def _estimated(lab, out):
    """Rows and status of the bank that the lab's recordings give."""
    assert wavefocus("estimate", lab / "plate.raw.h5", "--bank", out) == 0
    return held(out, "green"), held(out)


def test_given_kept_recordings_then_estimate_makes_the_same_bank_to_the_bit(labs, tmp_path):
    bank = labs["staggered"] / "plate.h5"
    assert _estimated(labs["staggered"], tmp_path / "again.h5") == (held(bank, "green"), held(bank))


def test_recordings_damaged_incomplete_or_missing_are_told_and_measuring_again_cures(lab, labs, capsys):
    shutil.copytree(labs["sequential"], lab, dirs_exist_ok=True)
    raw, bank = lab / "plate.raw.h5", lab / "plate.h5"
    with h5py.File(raw, "r+") as file:
        file["durability/ledger"][2] = 0
        file["response"][4, 0, 100:200] ^= 64
    assert wavefocus("resume", bank) == 0
    assert "lacks the recordings of 1 measured position" in capsys.readouterr().err
    assert _estimated(lab, lab / "damaged.h5")[1] == [1, 1, 1, 1, 8, 1]
    assert "position 4 failed" in capsys.readouterr().err
    assert wavefocus("remeasure", bank, "--positions", "4") == 0
    assert _estimated(lab, lab / "cured.h5") == (held(bank, "green"), [1] * 6)
    raw.unlink()
    assert "plate.raw.h5 is missing" in refused(capsys, "resume", bank)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param("taps = 1000", "taps = 1000", marks=pytest.mark.nightly),
        ("taps = 1000", f"taps = 1000\nstagger_s = 0.15\n{_as('staggered')}"),
        pytest.param("decay_s = 0.1", "decay_s = 0.6", marks=pytest.mark.nightly),
        pytest.param("duration_s = 0.3", "duration_s = 0.6\nstop_hz = 200.0", marks=pytest.mark.nightly),
    ],
    ids=["short periods", "staggered", "long silence", "narrow band"],
)
def test_given_white_noise_then_the_error_of_the_rows_is_stated_within_1_db(lab, capsys, before, after):
    file, bank = lab / "run.toml", lab / "plate.h5"
    change_text(file, "noise_v = 1e-4", "noise_v = 1e-3")
    change_text(file, before, after)
    assert wavefocus("capture", file, "--bank", bank) in (0, 1)
    truth_db, stated_db = _errors_db(bank)
    median_db = float(np.median(stated_db))
    assert float(np.median(truth_db - stated_db)) == pytest.approx(0.0, abs=1.0)
    # The ratio itself would not do.
    assert float(np.median(truth_db + np.array(held(bank, "quality/snr_db")))) < -3.0
    assert answered(capsys, "status", bank)["median_noise_error_db"] == pytest.approx(median_db)
    assert any(f"{median_db:.1f} dB" in found.message for found in check_bank(bank) if found.severity == "note")


def test_rows_that_noise_hides_then_they_are_counted_and_worst_is_one_that_is_heard(bank):
    with BankWriter.open(bank) as writer:
        snr_db = np.array([10.0, -230.0, 40.0], np.float32)
        writer.commit(2, writer.green(2), replace(writer.record(2), snr_db=snr_db))
    (note,) = [found.message for found in check_bank(bank) if "white noise" in found.message]
    assert "in the worst that it does not hide (position 2, actuator 0)" in note
    assert "it hides: 1 (the first: position 2, actuator 1)" in note


FAINT = 'role = "recorder"\noperation = "read"\nkind = "faint_reference"\n'


def _with_faint_reference(lab, schedule, capsys, *faults, code=0):
    """Bank of a capture in which the reference of some records is at another level, and what was told."""
    _with_capture(lab, _as(schedule))
    with_faults(lab, *(FAINT + fault for fault in faults))
    return lab / "plate.h5", captured(capsys, lab, code=code)


@pytest.mark.parametrize(
    ("schedule", "first"), [pytest.param("sequential", 8, marks=pytest.mark.nightly), ("staggered", 4)]
)
def test_a_reference_that_changes_within_its_calibration_is_refused(lab, capsys, schedule, first):
    fault = f"at_call = {first}\ncount = 999\nlevel_db = -0.2"
    bank, told = _with_faint_reference(lab, schedule, capsys, fault)
    assert held(bank) == [1, 1, 4, 4, 4, 4]
    defects = {tuple(one["defects"]) for one in told.of("position_committed")}
    assert defects == {(), ("reference level",)}
    assert held(bank, "quality/reference_db") == pytest.approx([0.0, 0.0, -0.2, -0.2, -0.2, -0.2], abs=0.01)


@pytest.mark.parametrize(
    ("schedule", "poor"), [("sequential", 1), pytest.param("staggered", 2, marks=pytest.mark.nightly)]
)
def test_a_reference_off_in_every_record_stops_capture_early_and_says_why(lab, capsys, schedule, poor):
    fault = 'purpose = "capture"\ncount = 999\nlevel_db = -0.54'
    bank, told = _with_faint_reference(lab, schedule, capsys, fault, code=3)
    for words in ("every record", "0.54 dB below its calibration", "wavefocus doctor"):
        assert words in told.last
    assert held(bank) == [4] * poor + [0] * (6 - poor)
