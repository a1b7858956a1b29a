"""A night without anybody: a queue at the emulated rig, with everything in it that a night brings."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import h5py
import pytest

from tests.lab_files import POSITIONS, write_positions
from tests.wire.emulated import emulated_instruments, free_port, rig_text
from wavefocus.acquisition.run_queue import read_queue
from wavefocus.campaign.control import read_heartbeat
from wavefocus.storage.ledger.owner import bank_owner

pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(900),
    pytest.mark.skipif(os.name != "posix", reason="a computer that sleeps is a SIGSTOP"),
]

RUN = """
rig = "rig.toml"

[grid]
positions_file = "positions.csv"

[sweep]
duration_s = 0.25

[capture]
averages = 1
decay_s = 0.2
taps = 2000

[quality]
second_look = "never"
"""
SCENE = """
[[source]]
speed_mm_s = 100.0
step_mm = 4.0
path = {{ kind = "line", start_mm = [0, {y_mm}], end_mm = [8, {y_mm}] }}
signal = {{ kind = "sine", frequency_hz = 200.0, duration_s = 0.05 }}
emission = "per_point"

[output]
limit_v = 1.0
"""
# The third move of the night finds the mirror unplugged: somebody trips over a cable and puts it back. Later the clock
# of the audio interface stops for some seconds.
NIGHT = """fault_plan = [
    { role = "mirror", kind = "unplugged", operation = "move", at_call = 3, seconds = 3 },
    { role = "player", kind = "frozen", at_s = 40, seconds = 12 },
]

[messages]
alive_file = "alive"
"""
SCENES = ("lower", "upper")
ASLEEP_S, AWAY_S = 20.0, 6.0


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(rig_text(tmp_path, f"localhost:{free_port()}") + NIGHT, encoding="utf-8")
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    for name, y_mm in (("lower", 0), ("upper", 4)):
        (tmp_path / f"{name}.toml").write_text(SCENE.format(y_mm=y_mm), encoding="utf-8")
    write_positions(tmp_path, POSITIONS)
    return tmp_path


def test_given_replug_stopped_clock_kill_sleep_and_failed_run_then_the_queue_ends_with_two_verified_scenes(
    lab: Path,
) -> None:
    for words in (
        ["capture", "run.toml", "--bank", "plate.h5"],
        ["resume", "never-made.h5"],
        *(["verify", f"{one}.toml", "--bank", "plate.h5", "--rig", "rig.toml", "--out", one] for one in SCENES),
    ):
        command = [sys.executable, "-m", "wavefocus", "queue", "add", "night.json", *words]
        subprocess.run(command, cwd=lab, check=True, capture_output=True)
    bank = lab / "plate.h5"
    with emulated_instruments(lab / "rig.toml") as emulated, night(lab, emulated.environment) as queue:
        # Killed in mid-record, at a time that nothing chose; and the mirror is away when the run begins again.
        first = await_owner(queue, bank, done=1)
        os.kill(first, signal.SIGKILL)
        emulated.say("unplug mirror")
        time.sleep(AWAY_S)
        emulated.say("plug mirror")
        # Another process goes on with it; then time stands still for all of the program, as in a computer that sleeps.
        second = await_owner(queue, bank, done=3, other_than=first)
        asleep = [(os.kill, queue.pid), (os.killpg, second)]
        stop(asleep, signal.SIGSTOP)
        time.sleep(ASLEEP_S)
        stop(asleep, signal.SIGCONT)
        assert queue.wait() == 1  # one run has failed
    states = [(entry.words[0], str(entry.state), entry.code) for entry in read_queue(lab / "night.json")]
    assert states == [("capture", "done", 0), ("resume", "failed", 2), ("verify", "done", 0), ("verify", "done", 0)]
    with h5py.File(bank) as file:
        assert list(file["status"]) == [1] * len(POSITIONS)
    events = [json.loads(line) for line in (lab / "plate.events.jsonl").read_text(encoding="utf-8").splitlines()]
    back = {event["role"] for event in events if event["event"] == "reconnect_tried" and event["connected"]}
    assert {"mirror", "player"} <= back
    assert sum(event["event"] == "session_started" for event in events) == 2
    for name in SCENES:
        assert (lab / name / "report.html").exists()
    assert (lab / "alive").exists()


@contextmanager
def night(lab: Path, environment: Mapping[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "wavefocus", "queue", "run", "night.json"]
    with subprocess.Popen(command, cwd=lab, env=dict(environment)) as queue:
        try:
            yield queue
        finally:
            queue.kill()


def await_owner(queue: subprocess.Popen[bytes], bank: Path, done: int, other_than: int = 0) -> int:
    """The process that measures, once it has measured so many positions."""
    while True:
        assert queue.poll() is None
        owner = bank_owner(bank) if bank.exists() else None
        beat = read_heartbeat(bank)
        if owner is not None and owner.pid and owner.pid != other_than and beat is not None and beat.done >= done:
            return owner.pid
        time.sleep(0.1)


def stop(processes: list[tuple[Callable[[int, int], None], int]], number: signal.Signals) -> None:
    for send, process in processes:
        send(process, number)
