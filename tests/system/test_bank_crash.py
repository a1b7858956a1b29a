"""What survives when the writing process, or the power, goes at any instant."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from calibration.bank import open_bank
from calibration.bank_check import check_bank
from calibration.bank_creation import create_bank
from calibration.bank_header import BankHeader
from calibration.bank_ledger import PointRecord
from calibration.bank_writer import BankWriter
from calibration.durable import PositionedFile, PosixFile

POSITIONS, ACTUATORS, TAPS = 3, 2, 16


def header(positions: int = POSITIONS) -> BankHeader:
    grid = np.stack([np.arange(positions) * 4.0, np.zeros(positions)], axis=1)
    corner = np.full((ACTUATORS, 2), np.nan)
    return BankHeader(10_000.0, TAPS, (20.0, 500.0), grid, corner, "{}", "{}", "ab" * 32, "wavefocus test")


def green_of(position: int, attempt: int = 1) -> np.ndarray:
    return np.random.default_rng([position, attempt]).normal(size=(ACTUATORS, TAPS)).astype(np.float32)


def record_of(position: int, attempt: int = 1) -> PointRecord:
    figures = np.arange(ACTUATORS, dtype=np.float32) + position + attempt / 10
    return PointRecord(1, attempt, figures, -figures, figures / 100, figures * 2)


# Starts a process for each line it reads; that one measures every position many times over, says so after
# each, and is killed meanwhile.
CAMPAIGNS = """
import os, sys
import numpy as np
from calibration.bank_ledger import PointRecord
from calibration.bank_writer import BankWriter

def green_of(position, attempt):
    return np.random.default_rng([position, attempt]).normal(size=(2, 16)).astype(np.float32)

def say(*words):
    # One write a line: a process killed inside print could leave half of one.
    os.write(1, (" ".join(str(word) for word in words) + "\\n").encode())

def measure(path):
    with BankWriter.open(path) as writer:
        for attempt in range(1, 1000):
            for position in range(writer.header.positions):
                if writer.attempts[position] < attempt:
                    figures = np.zeros(2, np.float32)
                    record = PointRecord(1, attempt, figures, figures, figures, figures)
                    writer.commit(position, green_of(position, attempt), record)
                    say("kept", position, attempt)

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        say("pid", os.getpid(), 0)
        measure(sys.argv[1])
        os._exit(1)
    os.waitpid(child, 0)
    say("end", 0, 0)
"""
KILLS = 20


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")
def test_a_process_killed_at_random_moments_then_loses_nothing_it_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "bank.h5"
    create_bank(path, header(4))
    chance = random.Random(4)
    acknowledged: dict[int, int] = {}
    command = [sys.executable, "-c", CAMPAIGNS, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as parent:
        assert parent.stdin is not None
        assert parent.stdout is not None
        for _ in range(KILLS):
            parent.stdin.write("measure\n")
            awaited, pid = chance.randrange(4), 0
            for line in parent.stdout:
                word, position, attempt = line.split()
                if word == "pid":
                    pid = int(position)
                elif word == "kept":
                    acknowledged[int(position)] = int(attempt)
                    awaited -= 1
                if awaited == 0 and word in ("pid", "kept"):
                    time.sleep(chance.uniform(0, 0.01))
                    os.kill(pid, signal.SIGKILL)
                if word == "end":
                    break
            assert_nothing_lost(path, acknowledged)
    assert len(acknowledged) == 4
    assert max(acknowledged.values()) > 2

    create_bank(tmp_path / "uninterrupted.h5", header(4))
    for bank in (path, tmp_path / "uninterrupted.h5"):
        with BankWriter.open(bank) as writer:
            for position in range(4):
                writer.commit(position, green_of(position, 1000), record_of(position, 1000))
    assert path.read_bytes() == (tmp_path / "uninterrupted.h5").read_bytes()


def assert_nothing_lost(path: Path, acknowledged: dict[int, int]) -> None:
    with h5py.File(path, "r") as file:
        assert file["green"].shape == (4, ACTUATORS, TAPS)
    with open_bank(path) as bank:
        assert bank.verify() == ()
        for position, attempt in acknowledged.items():
            found = int(bank.quality["attempts"][position])
            assert found >= attempt  # more when the kill came between a commit and its acknowledgement
            assert np.array_equal(bank.green(position), green_of(position, found))
    assert [finding for finding in check_bank(path) if finding.severity == "error"] == []


class LoggedFile(PosixFile):
    """A file that notes what is written and synced."""

    log: list[tuple[int, bytes] | None]

    def write(self, offset: int, data: bytes | memoryview) -> None:
        LoggedFile.log.append((offset, bytes(data)))
        super().write(offset, data)

    def sync(self) -> None:
        LoggedFile.log.append(None)
        super().sync()


def play(writer: BankWriter, log: list[tuple[int, bytes] | None]) -> list[tuple[int, int, int]]:
    """Measure, one position twice; return (length of the log, position, attempt) at each acknowledgement."""
    done = []
    for position, attempt in ((2, 1), (0, 1), (2, 2), (1, 1)):
        if writer.attempts[position] < attempt:
            writer.commit(position, green_of(position, attempt), record_of(position, attempt))
            done.append((len(log), position, attempt))
    return done


def images(start: bytes, log: list[tuple[int, bytes] | None]) -> list[tuple[int, bytes]]:
    """Every state a power cut can leave: what was synced, a subset of what was not, the last write torn."""
    rng = np.random.default_rng(1)
    found: list[tuple[int, bytes]] = []
    synced, flying = bytearray(start), list[tuple[int, bytes]]()
    for step, entry in enumerate(log):
        if entry is None:
            for offset, data in flying:
                synced[offset : offset + len(data)] = data
            flying.clear()
            found.append((step + 1, bytes(synced)))
            continue
        for chosen in {(), tuple(range(len(flying)))}:
            for kept in {min(size, len(entry[1])) for size in (0, 512, 4096, 4608)}:
                for garbage in (False, True):
                    image = bytearray(synced)
                    for offset, data in (flying[index] for index in chosen):
                        image[offset : offset + len(data)] = data
                    offset, data = entry
                    image[offset : offset + kept] = data[:kept]
                    if garbage and kept < len(data):
                        size = min(512, len(data) - kept)
                        image[offset + kept : offset + kept + size] = rng.bytes(size)
                    found.append((step, bytes(image)))
        flying.append(entry)
    return found


def test_a_power_cut_at_any_write_then_loses_nothing_acknowledged_and_ends_identical(tmp_path: Path) -> None:
    base = tmp_path / "bank.h5"
    create_bank(base, header(3))
    start = base.read_bytes()
    LoggedFile.log = []

    with BankWriter.open(base, open_file=LoggedFile) as writer:
        LoggedFile.log.clear()
        acknowledged = play(writer, LoggedFile.log)
    finished = base.read_bytes()
    cuts = list(dict.fromkeys(images(start, LoggedFile.log)))
    assert len(cuts) > 150

    cut = tmp_path / "cut.h5"
    for step, image in cuts:
        cut.write_bytes(image)
        promised = {position: attempt for length, position, attempt in acknowledged if length <= step}
        with h5py.File(cut, "r") as file:
            assert file["green"].shape == (3, 2, 16)
        with open_bank(cut) as bank:
            for position, attempt in promised.items():
                assert_holds(bank.green(position), position, attempt)
        with BankWriter.open(cut, open_file=unsynced) as writer:
            for position, attempt in promised.items():
                assert writer.attempts[position] >= attempt
                assert_holds(writer.green(position), position, attempt)
            for position in np.flatnonzero(writer.status).tolist():
                assert np.array_equal(writer.green(position), green_of(position, int(writer.attempts[position])))
            play(writer, [])
        assert cut.read_bytes() == finished


def assert_holds(found: np.ndarray, position: int, attempt: int) -> None:
    """Hold what was acknowledged, or the newer attempt that was on its way."""
    assert any(np.array_equal(found, green_of(position, newer)) for newer in range(attempt, 3))


class UnsyncedFile(PosixFile):
    """Skips the waiting for the disk, which this test does not need."""

    def sync(self) -> None:
        return


def unsynced(path: Path, *, write: bool = False) -> PositionedFile:
    return UnsyncedFile(path, write=write)
