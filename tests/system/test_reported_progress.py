"""Reports to people and programs: dry run, status, events, progress."""

import contextlib
import io
import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import ABSENT_RIG, POSITIONS, write_positions
from tests.system.captures import Listener, answered, capture, captured, held, said_by, wavefocus
from tests.system.lines import wait_until
from wavefocus.campaign.control import give_order, orders_path

# Three records of two periods of 0.4 s with 0.12 s around them, and 0.05 s a position beside, the sentinel being the
# seventh; 0.52 s of the loopback alone with 0.12 s around them, at the beginning and with the sentinel.
PLANNED_S = 7 * (3 * (2 * 0.4 + 0.12) + 0.05) + 2 * (0.52 + 0.12)


def test_given_a_plan_then_people_and_programs_are_told_what_it_takes(lab, bank, capsys):
    facts = answered(capsys, "plan", lab / "run.toml")
    assert (facts["positions"], facts["records"], len(facts["plan_sha256"])) == (6, 18, 64)
    assert facts["duration_s"] == pytest.approx(PLANNED_S)
    # The plan allows HDF5 four front blocks of 1 MB, of which it needs one or two.
    assert facts["bank_bytes"] - 4.5e6 < bank.stat().st_size <= facts["bank_bytes"]
    told = said_by(capsys, "plan", lab / "run.toml")
    assert told.err == ""
    assert "6, 3 actuators, 18 records" in told.out


def test_given_real_instruments_then_the_dry_run_asks_none_of_them(lab, capsys):
    (lab / "rig.toml").write_text(ABSENT_RIG.format(folder=lab.as_posix()), encoding="utf-8")
    (lab / "run.toml").write_text('rig = "rig.toml"\n[grid]\npositions_file = "positions.csv"\n', encoding="utf-8")
    write_positions(lab, POSITIONS[:2])
    facts = answered(capsys, "plan", lab / "run.toml")
    assert (facts["records"], facts["second_looks"]) == (6, 0)
    # Two positions and the sentinel; the loopback alone at the beginning and with the sentinel.
    assert facts["duration_s"] == pytest.approx(3 * (3 * (3 * 1.2 + 0.12) + 0.05) + 2 * (0.52 + 0.12))
    assert facts["instruments"][0] == f"mirror generic at {lab.as_posix()}/no-such-port, not asked"
    assert "player sounddevice no such interface, 4 outputs, not asked" in facts["instruments"]


def test_given_nothing_to_measure_then_a_program_is_told_the_end_of_the_session(bank, capsys, monkeypatch):
    monkeypatch.chdir(bank.parent)
    for command in (
        ["remeasure", "plate.h5"],
        ["extend", "plate.h5", "--run", "run.toml", "--bank", "new.h5"],
        ["capture", "run.toml", "--bank", "plate.h5", "--scene", "scene.toml"],
    ):
        ended = answered(capsys, *command)
        assert (ended["event"], ended["state"], ended["done"], ended["total"]) == ("session_ended", "finished", 6, 6)


@pytest.mark.may_skip("only Linux has a device that is always full")
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_given_a_log_that_cannot_be_written_then_the_campaign_goes_on_and_says_so(lab, capsys):
    (lab / "plate.events.jsonl").symlink_to("/dev/full")
    told = captured(capsys, lab).err
    assert told.count("plate.events.jsonl cannot be written any more") == 1
    assert "finished: 6 of 6 positions (6 valid)" in told


def test_a_run_then_every_position_is_valid_and_events_tell_it_and_what_is_left(lab, capsys):
    bank, told = lab / "plate.h5", captured(capsys, lab)
    events = told.of()
    assert events[0]["event"] == "session_started"
    assert events[-1]["event"] == "session_ended"
    assert events[-1]["counts"] == {
        "not-measured": 0, "valid": 6, "over-range": 0, "poor": 0, "failed": 0, "disabled": 0,
    }  # fmt: skip
    end_s = max(event["time_s"] for event in events)  # the sentinel, measured once more, included
    assert end_s == pytest.approx(PLANNED_S, rel=0.02)
    progress = told.of("progress")
    assert [event["done"] for event in progress] == [1, 2, 3, 4, 5, 6]
    for event in progress:
        assert event["remaining_s"] == pytest.approx(end_s - event["time_s"], abs=0.2 * end_s / 7)
    # The sentinel is measured last, with the loopback alone.
    assert progress[-1]["remaining_s"] == pytest.approx((PLANNED_S - 2 * 0.64) / 7 + 0.64, rel=0.05)
    taken = told.of("record_taken")
    assert [(event["record"], event["records"]) for event in taken] == [(1, 3), (2, 3), (3, 3)] * 6
    assert [event["position"] for event in taken] == [row for row in range(6) for _ in range(3)]
    committed = told.of("position_committed")
    assert [event["position"] for event in committed] == list(range(6))
    assert held(bank) == held(bank, "quality/attempts") == [1] * 6
    assert np.all(np.abs(held(bank, "green")).max(axis=2) > 0)
    # Nobody said how the clocks are.
    for event in committed:
        assert event["clock_ppm"] == pytest.approx(30.0, abs=0.5)
        assert event["start_offset_samples"] > 200  # 20 ms of pre-roll and 5-30 ms of latency at 10 kHz


def test_given_a_pause_then_status_tells_how_much_is_to_go_and_no_finish(lab, capsys):
    bank = lab / "plate.h5"
    told = []

    def status(*options):
        with contextlib.redirect_stdout(io.StringIO()) as answer:
            assert wavefocus("status", bank, *options) == 0
        told.append(answer.getvalue())

    def during():
        status("--json")
        give_order(bank, "pause")
        wait_until(lambda: not orders_path(bank).exists(), "the order is taken")

    def ask():
        status("--json")
        status()
        give_order(bank, "go-on")

    with contextlib.redirect_stdout(Listener(('"record": 2,', during), ('"state": "paused"', ask))):
        assert capture(lab, bank) == 0
    early, paused = (json.loads(answer) for answer in told[:2])
    assert (early["record"], early["state"]) == ({"position": 0, "number": 2, "of": 3}, "running")
    assert early["remaining_s"] == pytest.approx(PLANNED_S, rel=0.01)  # as planned
    assert (paused["state"], paused["done"], paused["record"]) == ("paused", 1, {"position": 0, "number": 3, "of": 3})
    assert paused["remaining_s"] > 4 * 3 * 2 * 0.4
    assert paused["owner"]["pid"] == os.getpid()
    assert paused["positions_per_hour"] > 0
    assert paused["wall_remaining_s"] > 0
    assert "5 positions to go" in told[2]
    assert "finished at" not in told[2]
