"""Campaigns through the command line, from the first position to the last, with all that can go wrong."""

import os
import shutil
import signal
import time

import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import answered, capture_process, captured, held, refused, told_by, wavefocus
from tests.system.conftest import with_faults, write_lab


def _take_longer(lab):
    """More sweeps a record, so that a signal still meets the campaign on a machine that is busy."""
    change_text(lab / "run.toml", "averages = 2", "averages = 6")


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The bank of an undisturbed capture that takes longer."""
    lab = write_lab(tmp_path_factory.mktemp("reference"))
    _take_longer(lab)
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    return (lab / "plate.h5").read_bytes()


def test_a_bank_deleted_while_it_is_measured_exits_3_and_its_rescue_is_identical(lab, reference):
    _take_longer(lab)
    bank = lab / "plate.h5"
    with capture_process(lab, bank) as child:
        while child.hear("progress")["done"] < 2:
            pass
        bank.unlink()
        assert child.rest()[-1]["state"] == "failed"
        assert child.end() == 3
    rescue = lab / "plate.rescue.h5"
    assert str(rescue) in "".join(child.said)
    assert wavefocus("resume", rescue) == 0
    assert rescue.read_bytes() == reference


@pytest.mark.skipif(os.name != "posix", reason="Windows has no SIGINT for one process alone")
def test_given_ctrl_c_twice_then_exit_130_and_resume_ends_byte_identical(lab, reference):
    _take_longer(lab)
    bank = lab / "plate.h5"
    # HDF5 may be asked for locks, which a capture does without.
    with capture_process(lab, bank, {**os.environ, "HDF5_USE_FILE_LOCKING": "TRUE"}) as child:
        child.hear("position_started")
        for _ in range(2):
            child.process.send_signal(signal.SIGINT)
            time.sleep(0.001)
        ended = child.rest()[-1]
        assert child.end() == 130
    assert (ended["event"], ended["state"]) == ("session_ended", "stopped")
    assert f"wavefocus resume {bank}" in "".join(child.said)
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == reference


READ = 'role = "recorder"\noperation = "read"\n'


def test_faults_that_pass_are_repeated_and_of_those_that_stay_a_poor_one_is_cured(lab, capsys):
    passing = {1: "short_read", 4: "missing_reference"}
    staying = {0: "timeout", 2: "dropout", 3: "over_range", 5: "missing_reference"}
    with_faults(
        lab,
        *(f'{READ}kind = "{kind}"\nposition = {row}\nattempt = 1' for row, kind in passing.items()),
        *(f'{READ}kind = "{kind}"\nposition = {row}\ncount = 6' for row, kind in staying.items()),
    )
    bank = lab / "plate.h5"
    repeated = captured(capsys, lab).of("position_repeated")
    assert [event["position"] for event in repeated if event["position"] in passing] == [*passing]
    assert all(event["reason"] for event in repeated)
    status, before = held(bank), np.array(held(bank, "green"))
    assert [status[row] & bit for row, bit in ((0, 8), (2, 4), (3, 2), (5, 8))] == [8, 4, 2, 8]
    assert [one & 1 for one in status] == [0, 1, 0, 0, 1, 0]
    # Three, and three more in the pass at the end; the loopback alone, played at position 0, is not tried for ever.
    assert held(bank, "quality/attempts") == [6, 2, 6, 6, 2, 6]
    assert wavefocus("remeasure", bank, "--status", "poor") == 0
    assert held(bank) == [*status[:2], 1, *status[3:]]
    assert held(bank, "quality/attempts")[2] == 7
    changed = np.any(np.array(held(bank, "green")) != before, axis=(1, 2))
    assert np.flatnonzero(changed).tolist() == [2]


def test_given_three_positions_in_a_row_without_a_record_then_exit_3(lab, capsys):
    read = 'role = "recorder"\noperation = "read"\nkind = '
    passing = f'{read}"timeout"\nposition = 0\nattempt = 1'  # it is over, and not why
    with_faults(lab, f'{read}"missing_reference"\nrecord = 0\ncount = 3', passing)
    assert "recorder: recording the reference: 3 positions in a row" in captured(capsys, lab, code=3).last


def test_a_bank_refuses_another_run_file_and_goes_on_from_a_copy_alone(lab, bank, tmp_path_factory, capsys):
    before = bank.read_bytes()
    change_text(lab / "run.toml", "duration_s = 0.3", "duration_s = 0.4")
    assert "plan" in refused(capsys, "capture", lab / "run.toml", "--bank", bank)
    assert bank.read_bytes() == before
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "copy.h5"
    shutil.copyfile(bank, elsewhere)
    shutil.rmtree(lab)
    assert wavefocus("resume", elsewhere) == 0
    assert wavefocus("remeasure", elsewhere, "--positions", "1") == 0
    assert wavefocus("check", elsewhere) == 0


@pytest.fixture
def far(lab):
    """The lab, with two positions that are near to nothing of the scene."""
    with (lab / "positions.csv").open("a", encoding="utf-8") as file:
        file.write("0,40\n4,40\n")
    change_text(lab / "scene.toml", "limit_v = 1.0", 'limit_v = 1.0\ninterpolation = "nearest"')
    return lab


def test_a_scene_then_its_positions_are_measured_once_and_the_rest_as_in_one_night(far, capsys):
    bank, whole, scene = far / "plate.h5", far / "whole.h5", far / "scene.toml"
    for _ in range(2):
        assert wavefocus("capture", far / "run.toml", "--bank", bank, "--scene", scene) == 0
    assert held(bank) == [1] * 6 + [0] * 2
    told = capsys.readouterr().err
    assert "the other 2 are left" in told
    assert told.count("all 6 positions that are needed are in the bank") == 2
    assert told.count("finished:") == 1
    assert wavefocus("render", scene, "--bank", bank, "--out", far / "drive.h5") == 0
    assert wavefocus("resume", bank) == 0
    assert wavefocus("capture", far / "run.toml", "--bank", whole) == 0
    assert bank.read_bytes() == whole.read_bytes()


def test_given_a_scene_off_the_grid_then_no_bank_is_made(far, capsys):
    change_text(far / "scene.toml", "[8, 0]", "[60, 0]")
    told = refused(capsys, "capture", far / "run.toml", "--bank", far / "plate.h5", "--scene", far / "scene.toml")
    assert "scene.toml" in told
    assert "mm from the nearest position" in told
    assert not (far / "plate.h5").exists()


def _captured(capsys, lab, *faults, schedule="sequential"):
    change_text(lab / "run.toml", "[capture]\n", f'[capture]\nexcitation = "{schedule}"\n')
    with_faults(lab, *(READ + fault for fault in faults))
    captured(capsys, lab)
    return lab / "plate.h5"


def _remeasured(bank, position, capsys, *options):
    """Kinds of events and defects of measuring a position again, and the positions kept by `status` then."""
    told = told_by(capsys, "remeasure", bank, "--positions", position, *options)
    events = told.of("position_repeated", "position_committed", "position_kept")
    kept = [one["position"] for one in answered(capsys, "status", bank)["kept_positions"]]
    return [event["event"] for event in events], events[-1]["defects"], kept


@pytest.mark.parametrize(
    ("schedule", "reference_db", "drift_db"),
    [("sequential", -0.3, -20.0), pytest.param("staggered", 6.0, -0.3, marks=pytest.mark.nightly)],
)
def test_given_faults_that_stay_then_valid_rows_are_kept_and_named(lab, capsys, schedule, reference_db, drift_db):
    stays = "attempt = 2\ncount = 99\nrecord = 0\n"
    faults = (
        f'{stays}position = 2\nkind = "faint_reference"\nlevel_db = {reference_db}',
        f'{stays}position = 4\nkind = "drift"\nlevel_db = {drift_db}',
    )
    bank = _captured(capsys, lab, *faults, schedule=schedule)
    before = bank.read_bytes()
    kinds = ["position_repeated", "position_repeated", "position_kept"]
    assert _remeasured(bank, 2, capsys) == (kinds, ["reference level"], [2])
    assert _remeasured(bank, 4, capsys)[:2] == (kinds, ["neighbours"])
    assert bank.read_bytes() == before


def test_a_row_is_replaced_if_the_next_try_agrees_or_on_request_if_two_others_do(lab, capsys):
    fault = 'position = {}\nkind = "drift"\nlevel_db = {}\nrecord = 1'
    bank = _captured(capsys, lab, fault.format(5, -0.3) + "\nattempt = 2", fault.format(2, -0.5))
    before = np.array(held(bank, "green"))
    assert _remeasured(bank, 5, capsys) == (["position_repeated", "position_committed"], [], [])
    assert "position_committed" not in _remeasured(bank, 2, capsys)[0]
    assert _remeasured(bank, 2, capsys, "--replace")[0] == ["position_repeated", "position_committed"]
    log = (lab / "plate.events.jsonl").read_text(encoding="utf-8")
    assert "the row is replaced where another attempt agrees" in log
    green = np.array(held(bank, "green"))
    assert np.flatnonzero(np.any(green != before, axis=(1, 2))).tolist() == [2, 5]
    level_db = 20 * np.log10(np.linalg.norm(green[2, 1]) / np.linalg.norm(before[2, 1]))
    assert level_db == pytest.approx(0.5, abs=0.1)
    assert held(bank) == [1] * 6
