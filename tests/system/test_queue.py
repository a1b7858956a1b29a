"""A queue of runs through the command: order, failures, edits, kills, a full disk, two queues at one rig."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.system.captures import held
from wavefocus.__main__ import run
from wavefocus.campaign.control import read_heartbeat
from wavefocus.storage.ledger.owner import bank_owner

RUNNER = [sys.executable, "-m", "wavefocus", "queue", "run"]
posix = pytest.mark.skipif(os.name != "posix", reason="POSIX signals")


@pytest.fixture
def queue(lab: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The name of a queue in a lab, which is the present folder."""
    monkeypatch.chdir(lab)
    return Path("night.json")


def listed(queue: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    capsys.readouterr()
    assert run(["queue", "list", str(queue), "--json"]) == 0
    found: dict[str, object] = json.loads(capsys.readouterr().out)
    return found


def add(queue: Path, *words: str) -> int:
    return run(["queue", "add", str(queue), *words])


def events(lines: str) -> list[tuple[object, ...]]:
    found = [json.loads(line) for line in lines.splitlines()]
    return [(one["event"], one.get("number"), one.get("state"), one.get("code")) for one in found]


def test_given_a_run_that_fails_then_the_queue_carries_out_the_others_and_ends_in_1(
    queue: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert add(queue, "resume", "never-made.h5") == 0
    assert add(queue, "capture", "run.toml", "--bank", "plate.h5") == 0
    assert add(queue, "verify", "scene.toml", "--bank", "plate.h5", "--rig", "rig.toml", "--out", "verify") == 0
    with Path("scene.toml").open("a", encoding="utf-8") as scene:
        scene.write("# changed\n")
    before = listed(queue, capsys)
    assert [bool(one["changed"]) for one in before["runs"]] == [False, False, True]
    expected = [one["expected_s"] for one in before["runs"]]
    assert expected[0] is None
    assert all(seconds > 0 for seconds in expected[1:])

    assert run(["queue", "run", str(queue), "--json"]) == 1
    lines = capsys.readouterr().out
    assert events(lines) == [
        ("run_started", 1, None, None),
        ("run_ended", 1, "failed", 2),
        ("run_started", 2, None, None),
        ("run_ended", 2, "done", 0),
        ("run_started", 3, None, None),
        ("run_ended", 3, "done", 0),
        ("queue_ended", None, None, None),
    ]
    started = [json.loads(line) for line in lines.splitlines() if "run_started" in line]
    assert [Path(name).name for one in started for name in one["changed"]] == ["scene.toml"]
    assert held(Path("plate.h5")) == [1] * 6
    assert json.loads(Path("verify/verify.json").read_text(encoding="utf-8"))["passed"] is True
    after = listed(queue, capsys)
    assert [one["state"] for one in after["runs"]] == ["failed", "done", "done"]
    assert all(one["finish_at"] for one in after["runs"])

    # Nothing is left to do; a run that is moved waits again.
    assert run(["queue", "run", str(queue)]) == 0
    assert run(["queue", "move", str(queue), "1", "1"]) == 0
    assert [one["state"] for one in listed(queue, capsys)["runs"]] == ["done", "done", "waiting"]


@pytest.mark.parametrize(
    "words",
    [
        ["play", "drive.h5", "--rig", "rig.toml"],
        ["gui"],
        ["capture", "run.toml"],
        ["capture", "none.toml", "--bank", "plate.h5"],
        ["capture", "run.toml", "--bank", "plate.h5", "--banc", "x"],
        ["verify", "rig.toml", "--bank", "plate.h5", "--rig", "rig.toml", "--out", "verify"],
        [],
    ],
)
def test_given_a_run_that_cannot_be_then_it_is_not_added(queue: Path, words: list[str]) -> None:
    assert add(queue, *words) == 2
    assert not queue.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["list", "none.json"],
        ["run", "none.json"],
        ["list", "run.toml"],
        ["run", "plate.h5"],
        ["move", "night.json", "9", "1"],
        ["move", "night.json", "1", "3"],
        ["remove", "night.json", "1", "9"],
        ["move", "night.json", "one", "1"],
        ["add", "run.toml", "capture", "run.toml", "--bank", "plate.h5"],
    ],
)
def test_given_a_wrong_queue_or_run_then_exit_2_and_nothing_changes(
    queue: Path, bank: Path, arguments: list[str]
) -> None:
    assert add(queue, "resume", "plate.h5") == 0
    before = {path: path.read_bytes() for path in Path().iterdir() if path.is_file()}
    assert run(["queue", *arguments]) == 2
    assert {path: path.read_bytes() for path in Path().iterdir() if path.is_file()} == before


@posix
def test_given_a_link_or_a_folder_that_is_gone_then_it_is_said_and_nothing_is_lost(
    queue: Path, bank: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    link, folder = Path("link.json"), Path("gone").absolute()
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert add(Path("../night.json"), "check", "../plate.h5") == 0
    monkeypatch.chdir(folder.parent)
    link.symlink_to(queue)
    for arguments in (["run", "link.json"], ["add", "link.json", "check", "plate.h5"], ["move", "link.json", "1", "1"]):
        assert run(["queue", *arguments]) == (0 if arguments[0] == "move" else 2)
    assert link.is_symlink()
    folder.rmdir()
    capsys.readouterr()
    assert run(["queue", "run", str(queue)]) == 1
    assert str(folder) in capsys.readouterr().err
    assert listed(queue, capsys)["runs"][0]["state"] == "failed"


@pytest.fixture
def night(lab: Path) -> Iterator[subprocess.Popen[str]]:
    """A queue of one campaign that takes a minute, under way."""
    text = (lab / "run.toml").read_text(encoding="utf-8")
    text = text.replace('positions_file = "positions.csv"', "spacing_mm = 2.0")
    (lab / "long.toml").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "wavefocus", "queue", "add", "night.json"]
    subprocess.run([*command, "capture", "long.toml", "--bank", "long.h5"], cwd=lab, check=True)
    with subprocess.Popen([*RUNNER, "night.json"], cwd=lab, stderr=subprocess.DEVNULL, text=True) as runner:
        try:
            while (beat := read_heartbeat(lab / "long.h5")) is None or beat.done < 1:
                assert runner.poll() is None
                time.sleep(0.1)
            yield runner
        finally:
            runner.kill()


def await_release(bank: Path) -> None:
    while bank_owner(bank) is not None:
        time.sleep(0.1)


@posix
def test_given_two_queues_at_one_rig_then_the_second_ends_in_75_and_names_host_and_process(
    lab: Path, night: subprocess.Popen[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lab)
    assert add(Path("other.json"), "capture", "run.toml", "--bank", "plate.h5") == 0
    for name in ("night.json", "other.json"):
        capsys.readouterr()
        assert run(["queue", "run", name]) == 75
        said = capsys.readouterr().err
        assert str(night.pid) in said
        assert socket.gethostname() in said
    assert not Path("plate.h5").exists()
    owner = listed(Path("night.json"), capsys)["owner"]
    assert owner == {"host": socket.gethostname(), "pid": night.pid}
    # A run may be added and removed meanwhile, but not the one that is running.
    assert add(Path("night.json"), "resume", "long.h5") == 0
    assert run(["queue", "remove", "night.json", "1"]) == 2
    assert run(["queue", "remove", "night.json", "2"]) == 0
    # Killed: its run ends by itself after the position, and the rig is free.
    night.kill()
    await_release(lab / "long.h5")
    assert run(["queue", "run", "other.json"]) == 0
    capsys.readouterr()


@posix
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_given_a_queue_is_stopped_then_its_run_is_stopped_and_waits_again(
    lab: Path, night: subprocess.Popen[str], number: signal.Signals
) -> None:
    night.send_signal(number)
    assert night.wait() == 130
    assert bank_owner(lab / "long.h5") is None
    (entry,) = json.loads((lab / "night.json").read_text(encoding="utf-8"))["runs"]
    assert (entry["state"], entry["code"]) == ("waiting", None)


@posix
def test_given_a_full_disk_then_the_older_queue_stays_and_the_error_is_one_line(queue: Path) -> None:
    assert add(queue, "capture", "run.toml", "--bank", "plate.h5") == 0
    before = queue.read_bytes()
    script = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (700, 700)); import signal;"
    script += "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); from wavefocus.__main__ import run;"
    script += "sys.exit(run(['queue', 'add', 'night.json', 'resume', 'plate.h5']))"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert len(ended.stderr.splitlines()) == 1
    assert queue.read_bytes() == before


@posix
@pytest.mark.long
@pytest.mark.timeout(900)
def test_given_40_kills_of_queue_and_runs_then_five_banks_are_those_of_an_undisturbed_queue(
    queue: Path, measured: Path
) -> None:
    names = [f"plate-{number}.h5" for number in range(5)]
    for name in names:
        assert add(queue, "capture", "run.toml", "--bank", name) == 0
    choice = random.Random(1)
    kills = 0
    runner = subprocess.Popen([*RUNNER, str(queue)], stderr=subprocess.DEVNULL)
    while kills < 40:
        time.sleep(choice.uniform(0.2, 2.0))
        owners = [bank_owner(Path(name)) for name in names if Path(name).exists()]
        children = [owner.pid for owner in owners if owner is not None and owner.pid]
        if runner.poll() is not None:  # all are done: measured anew
            assert runner.returncode == 0
            for name in names:
                for beside in Path().glob(f"{Path(name).stem}.*"):
                    beside.unlink()
            for number in range(1, 6):
                assert run(["queue", "move", str(queue), str(number), "1"]) == 0
        elif children and choice.random() < 0.5:
            with suppress(ProcessLookupError):
                os.kill(children[0], signal.SIGKILL)
            kills += 1
            continue
        else:
            runner.kill()
            kills += 1
        runner.wait()
        runner = subprocess.Popen([*RUNNER, str(queue)], stderr=subprocess.DEVNULL)
    assert runner.wait() == 0
    for name in names:
        assert Path(name).read_bytes() == measured.read_bytes(), name
