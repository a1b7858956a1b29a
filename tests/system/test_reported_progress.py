"""Reports to people and programs: dry run, status, progress, error against the truth."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.system.captures import Listener, capture
from wavefocus.__main__ import run
from wavefocus.campaign.control import give_order, orders_path

# Three records of two periods of 0.4 s with 0.12 s around them, and 0.05 s a position beside, the sentinel being the
# seventh; 0.52 s of the loopback alone with 0.12 s around them, at the beginning and with the sentinel.
PLANNED_S = 7 * (3 * (2 * 0.4 + 0.12) + 0.05) + 2 * (0.52 + 0.12)


def test_given_a_plan_then_people_and_programs_are_told_what_it_takes(lab, bank, capsys):
    assert run(["plan", str(lab / "run.toml"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["positions"] == 6
    assert facts["records"] == 18
    assert facts["duration_s"] == pytest.approx(PLANNED_S)
    # The plan allows HDF5 four front blocks of 1 MB, of which it needs one or two.
    assert facts["bank_bytes"] - 4.5e6 < bank.stat().st_size <= facts["bank_bytes"]
    assert len(facts["plan_sha256"]) == 64
    assert run(["plan", str(lab / "run.toml")]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "6, 3 actuators, 18 records" in told.out


@pytest.mark.parametrize(
    "command",
    [
        ["remeasure", "plate.h5"],
        ["extend", "plate.h5", "--run", "run.toml", "--bank", "new.h5"],
        ["capture", "run.toml", "--bank", "plate.h5", "--scene", "scene.toml"],
    ],
    ids=lambda command: command[0],
)
def test_given_nothing_to_measure_then_a_program_is_told_the_end_of_the_session(bank, capsys, monkeypatch, command):
    monkeypatch.chdir(bank.parent)
    assert run([*command, "--json"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    ended = json.loads(line)
    assert (ended["event"], ended["state"], ended["done"], ended["total"]) == ("session_ended", "finished", 6, 6)


@pytest.mark.may_skip("only Linux has a device that is always full")
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_given_a_log_that_cannot_be_written_then_the_campaign_goes_on_and_says_so(lab, capsys):
    (lab / "plate.events.jsonl").symlink_to("/dev/full")
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5")]) == 0
    told = capsys.readouterr().err
    assert told.count("plate.events.jsonl cannot be written any more") == 1
    assert "finished: 6 of 6 positions (6 valid)" in told


def test_a_short_campaign_then_what_is_left_is_right_from_its_first_position_on(lab, capsys):
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5"), "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    end_s = max(event["time_s"] for event in events)  # the sentinel, measured once more, included
    assert end_s == pytest.approx(PLANNED_S, rel=0.02)
    position_s = end_s / 7
    for event in events:
        if event["event"] == "progress":
            assert event["remaining_s"] == pytest.approx(end_s - event["time_s"], abs=0.2 * position_s)
    taken = [event for event in events if event["event"] == "record_taken"]
    assert [(event["record"], event["records"]) for event in taken] == [(1, 3), (2, 3), (3, 3)] * 6
    assert [event["position"] for event in taken] == [row for row in range(6) for _ in range(3)]


def test_given_a_pause_then_status_tells_how_much_is_to_go_and_no_finish(lab, capsys):
    bank = lab / "plate.h5"
    facts: list[dict[str, object]] = []
    told: list[str] = []

    def status(*options):
        command = [sys.executable, "-m", "wavefocus", "status", str(bank), *options]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    def ask():
        facts.append(json.loads(status("--json")))
        told.append(status())
        give_order(bank, "go-on")

    def during():
        facts.append(json.loads(status("--json")))
        give_order(bank, "pause")
        until_s = time.monotonic() + 60
        while orders_path(bank).exists() and time.monotonic() < until_s:
            time.sleep(0.01)

    listener = Listener(('"record": 2,', during), ('"state": "paused"', ask))
    with contextlib.redirect_stdout(listener):
        assert capture(lab, bank) == 0
    early, paused = facts
    assert (early["record"], early["state"]) == ({"position": 0, "number": 2, "of": 3}, "running")
    assert early["remaining_s"] == pytest.approx(PLANNED_S, rel=0.01)  # as planned
    assert (paused["state"], paused["done"], paused["record"]) == ("paused", 1, {"position": 0, "number": 3, "of": 3})
    assert float(str(paused["remaining_s"])) > 4 * 3 * 2 * 0.4
    assert paused["owner"]["pid"] == os.getpid()  # type: ignore[index]
    assert float(str(paused["positions_per_hour"])) > 0
    assert float(str(paused["wall_remaining_s"])) > 0
    assert "5 positions to go" in told[0]
    assert "finished at" not in told[0]
