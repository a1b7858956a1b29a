"""Campaigns through the command line, from the first position to the last, with all that can go wrong."""

import os
import shutil
import signal
import time

import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import capture_process, events_of, held, of_kind, wavefocus
from tests.system.conftest import with_faults, write_lab


def _capture(lab, name="plate.h5"):
    bank = lab / name
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 0
    return bank


def _take_longer(lab):
    """More sweeps a record, so that a signal still meets the campaign on a machine that is busy."""
    change_text(lab / "run.toml", "averages = 2", "averages = 6")


def test_given_a_run_then_every_position_is_valid_and_events_tell_it(lab, capsys):
    bank = lab / "plate.h5"
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    events = events_of(capsys.readouterr().out)
    assert events[0]["event"] == "session_started"
    assert events[-1]["event"] == "session_ended"
    assert events[-1]["counts"] == {
        "not-measured": 0, "valid": 6, "over-range": 0, "poor": 0, "failed": 0, "disabled": 0,
    }  # fmt: skip
    committed = of_kind(events, "position_committed")
    assert [event["position"] for event in committed] == list(range(6))
    progress = of_kind(events, "progress")
    assert [event["done"] for event in progress] == [1, 2, 3, 4, 5, 6]
    # The sentinel is measured last, with the loopback alone.
    position_s = (events[0]["planned_s"] - 2 * 0.64) / 7
    assert progress[-1]["remaining_s"] == pytest.approx(position_s + 0.64, rel=0.05)
    assert held(bank) == held(bank, "quality/attempts") == [1] * 6
    assert np.all(np.abs(held(bank, "green")).max(axis=2) > 0)
    # Nobody said how the clocks are.
    for event in committed:
        assert event["clock_ppm"] == pytest.approx(30.0, abs=0.5)
        assert event["start_offset_samples"] > 200  # 20 ms of pre-roll and 5-30 ms of latency at 10 kHz


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The bank of an undisturbed capture that takes longer."""
    lab = write_lab(tmp_path_factory.mktemp("reference"))
    _take_longer(lab)
    return _capture(lab).read_bytes()


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
@pytest.mark.parametrize("interrupts", [1, 2])
def test_given_ctrl_c_then_exit_130_and_resume_ends_byte_identical(lab, reference, interrupts):
    _take_longer(lab)
    bank = lab / "plate.h5"
    # HDF5 may be asked for locks, which a capture does without.
    with capture_process(lab, bank, {**os.environ, "HDF5_USE_FILE_LOCKING": "TRUE"}) as child:
        child.hear("position_started")
        for _ in range(interrupts):
            child.process.send_signal(signal.SIGINT)
            time.sleep(0.001)
        ended = child.rest()[-1]
        assert child.end() == 130
    assert (ended["event"], ended["state"]) == ("session_ended", "stopped")
    assert f"wavefocus resume {bank}" in "".join(child.said)
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == reference


READ = 'role = "recorder"\noperation = "read"\n'


def test_given_passing_faults_then_their_positions_are_repeated_and_valid(lab, capsys):
    passing = {1: "short_read", 2: "missing_reference", 4: "over_range"}
    with_faults(lab, *(f'{READ}kind = "{kind}"\nposition = {row}\nattempt = 1' for row, kind in passing.items()))
    bank = lab / "plate.h5"
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    repeated = events_of(capsys.readouterr().out, "position_repeated")
    assert [event["position"] for event in repeated] == [*passing]
    assert all(event["reason"] for event in repeated)
    assert held(bank) == [1] * 6
    assert held(bank, "quality/attempts") == [1, 2, 2, 1, 2, 1]


def test_given_faults_that_stay_then_positions_are_not_valid_and_a_poor_one_is_cured(lab):
    staying = {0: "timeout", 2: "dropout", 3: "over_range", 5: "missing_reference"}
    with_faults(lab, *(f'{READ}kind = "{kind}"\nposition = {row}\ncount = 6' for row, kind in staying.items()))
    bank = _capture(lab)
    status, before = held(bank), np.array(held(bank, "green"))
    assert [status[row] & bit for row, bit in ((0, 8), (2, 4), (3, 2), (5, 8))] == [8, 4, 2, 8]
    assert [one & 1 for one in status] == [0, 1, 0, 0, 1, 0]
    # Three, and three more in the pass at the end; the loopback alone, played at position 0, is not tried for ever.
    assert held(bank, "quality/attempts") == [6, 1, 6, 6, 1, 6]
    assert wavefocus("remeasure", bank, "--status", "poor") == 0
    assert held(bank) == [*status[:2], 1, *status[3:]]
    assert held(bank, "quality/attempts")[2] == 7
    changed = np.any(np.array(held(bank, "green")) != before, axis=(1, 2))
    assert np.flatnonzero(changed).tolist() == [2]


def test_given_three_positions_in_a_row_without_a_record_then_exit_3(lab, capsys):
    with_faults(lab, 'role = "recorder"\noperation = "read"\nkind = "missing_reference"\nrecord = 0\ncount = 3')
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 3
    assert "3 positions in a row" in capsys.readouterr().err.splitlines()[-1]


def test_given_another_run_file_then_the_bank_is_refused_and_untouched(lab, bank, capsys):
    before = bank.read_bytes()
    change_text(lab / "run.toml", "duration_s = 0.3", "duration_s = 0.4")
    capsys.readouterr()
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "plan" in told[0]
    assert bank.read_bytes() == before


def test_given_a_copied_bank_then_it_resumes_from_the_copy_alone(lab, bank, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "copy.h5"
    shutil.copyfile(bank, elsewhere)
    shutil.rmtree(lab)
    assert wavefocus("resume", elsewhere) == 0
    assert wavefocus("remeasure", elsewhere, "--positions", "1") == 0
    assert wavefocus("check", elsewhere) == 0
