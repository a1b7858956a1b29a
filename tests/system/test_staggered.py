"""Staggered campaigns through the command line, the trial before them, and recordings kept beside the bank."""

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import capture_process, events_of, wavefocus
from tests.system.conftest import with_faults, write_lab
from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.campaign.blueprint import blueprint_from_bank, blueprint_from_files, blueprint_of
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import create_bank

KEEP = 'excitation = "staggered"'


def _with_capture(lab, *lines):
    """The lab's run file with more lines in its capture table."""
    path = lab / "run.toml"
    change_text(path, "[capture]\n", "[capture]\n" + "\n".join(lines) + "\n")
    return path


def _median_error_db(bank):
    configuration = blueprint_from_bank(bank).configuration
    with open_bank(bank) as content:
        rig = virtual_rig(configuration.rig, configuration.run.virtual)
        return float(np.nanmedian(compare_with_truth(content, rig)))


def test_a_staggered_run_then_its_bank_is_as_near_the_truth_as_a_sequential_one(lab):
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "sequential.h5") == 0
    _with_capture(lab, KEEP)
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "staggered.h5") == 0
    with h5py.File(lab / "staggered.h5") as file:
        assert list(file["status"]) == [1] * 6
    # A period of 0.375 s takes the place of two sweeps of 0.3 s each.
    allowed_db = 10 * np.log10(0.6 / 0.375) + 1.5
    assert _median_error_db(lab / "staggered.h5") < _median_error_db(lab / "sequential.h5") + allowed_db


def test_given_sigkill_then_staggered_bank_and_recordings_end_byte_identical(lab):
    # Many periods, so that the kill meets the campaign on a machine that is busy too.
    _with_capture(lab, KEEP, "periods = 20", "keep_raw = true")
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "reference.h5") == 0
    bank = lab / "plate.h5"
    with capture_process(lab, bank) as child:
        child.hear("position_committed")
        child.process.kill()
    with h5py.File(bank) as file:
        assert np.count_nonzero(file["status"]) < 6
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == (lab / "reference.h5").read_bytes()
    assert bank.with_suffix(".raw.h5").read_bytes() == (lab / "reference.raw.h5").read_bytes()


def test_a_staggered_bank_measures_one_position_both_ways_and_states_it(lab, capsys):
    _with_capture(lab, 'excitation = "staggered"')
    bank, trial = lab / "plate.h5", 'role = "recorder"\noperation = "read"\npurpose = "trial"'
    with_faults(
        lab,
        'role = "mirror"\noperation = "wait_settled"\nkind = "timeout"\nat_call = 1',
        f'{trial}\nattempt = 2\nrecord = 1\nkind = "missing_reference"',
        f'{trial}\nattempt = 3\nrecord = 0\nkind = "unplugged"',
    )
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    output = capsys.readouterr()
    compared = events_of(output.out)[0]
    assert compared["event"] == "schedule_settled"
    assert str(compared["reason"]) in output.err
    staggered, sequential = compared["candidates"]
    assert staggered["name"] == compared["chosen"]
    assert -70.0 < sequential["error_db"] < staggered["error_db"] < -25.0
    assert staggered["campaign_s"] < sequential["campaign_s"]
    # The bank is there: nothing is compared again.
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    assert "schedule_settled" not in capsys.readouterr().out
    assert wavefocus("resume", bank) == 0


def test_given_a_bank_whose_trial_has_settled_sequential_capture_then_it_goes_on_so(lab):
    _with_capture(lab, 'excitation = "staggered"')
    blueprint = blueprint_from_files(lab / "run.toml")
    run = blueprint.configuration.run
    capture = run.capture.model_copy(update={"excitation": "sequential", "level_db": -6.0})
    settled = blueprint_of(replace(blueprint.configuration, run=run.with_schedule(capture, "it distorts")))
    header = settled.bank_header()
    held = json.loads(header.run_json)
    held["settled"]["asked"] |= {"when_staggered_does_not_pay": "choose", "allowed_loss_db": 3.0}
    create_bank(lab / "plate.h5", replace(header, run_json=json.dumps(held)))
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    assert blueprint_from_bank(lab / "plate.h5").plan.staggered is None


@pytest.fixture(scope="module")
def with_recordings(tmp_path_factory):
    """A lab with a sequential bank and its recordings; to be copied."""
    lab = write_lab(tmp_path_factory.mktemp("with_recordings"))
    _with_capture(lab, "keep_raw = true")
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    return lab


@pytest.fixture
def kept(lab, with_recordings):
    """The lab with a sequential bank and its recordings."""
    shutil.copytree(with_recordings, lab, dirs_exist_ok=True)
    return lab


def test_given_kept_recordings_then_estimate_makes_the_same_bank_to_the_bit(lab):
    _with_capture(lab, KEEP, "keep_raw = true")
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    assert wavefocus("estimate", lab / "plate.raw.h5", "--bank", lab / "again.h5") == 0
    with h5py.File(lab / "plate.h5") as then, h5py.File(lab / "again.h5") as now:
        assert np.array_equal(then["green"][:], now["green"][:])
        assert np.array_equal(then["status"][:], now["status"][:])


def test_given_recordings_that_are_gone_then_resume_refuses_by_a_sentence(kept, capsys):
    (kept / "plate.raw.h5").unlink()
    capsys.readouterr()
    assert wavefocus("resume", kept / "plate.h5") == 2
    assert "plate.raw.h5 is missing" in capsys.readouterr().err


def test_given_a_lost_row_of_recordings_then_resume_measures_that_position_again(kept, capsys):
    raw = kept / "plate.raw.h5"
    with h5py.File(raw, "r+") as file:
        file["durability/ledger"][2] = 0
    capsys.readouterr()
    assert wavefocus("resume", kept / "plate.h5") == 0
    assert "lacks the recordings of 1 measured position" in capsys.readouterr().err
    assert wavefocus("estimate", raw, "--bank", kept / "again.h5") == 0
    with h5py.File(kept / "plate.h5") as then, h5py.File(kept / "again.h5") as now:
        assert np.array_equal(then["green"][:], now["green"][:])


def test_damaged_recordings_then_estimate_tells_and_remeasuring_position_cures_it(kept, capsys):
    raw = kept / "plate.raw.h5"
    with h5py.File(raw, "r+") as file:
        file["response"][2, 0, 100:200] ^= 64
    capsys.readouterr()
    assert wavefocus("estimate", raw, "--bank", kept / "damaged.h5") == 0
    assert "position 2 failed" in capsys.readouterr().err
    assert wavefocus("remeasure", kept / "plate.h5", "--positions", "2") == 0
    assert wavefocus("estimate", raw, "--bank", kept / "cured.h5") == 0
    with h5py.File(kept / "plate.h5") as then, h5py.File(kept / "cured.h5") as now:
        assert list(now["status"]) == [1] * 6
        assert np.array_equal(then["green"][:], now["green"][:])
