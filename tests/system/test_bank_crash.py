"""What survives when the process that writes a bank goes at any instant."""

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

from calibration.check import check_bank
from storage.bank.header import BankHeader
from storage.bank.ledger import PointRecord
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter, create_bank
from storage.ledger.owner import owner_path

ROOT = Path(__file__).parents[2]
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
from storage.bank.ledger import PointRecord
from storage.bank.writer import BankWriter

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
KILLS = 8


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
    assert max(acknowledged.values()) > 1

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


# HDF5 on a disk that fails loses what it could not write, or takes the process along: it must not be on the disk.
MAKE = """
import resource, sys
from storage.bank.writer import create_bank
from storage.errors import InputError
from tests.system.test_bank_crash import header
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
try:
    create_bank(sys.argv[1], header(4))
except InputError as error:
    print(error)
# What measures coverage writes its files at the end.
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit on the size of files")
@pytest.mark.parametrize("limit", [0, 20_000, 130_000])
def test_a_disk_that_takes_no_more_while_a_bank_is_made_then_it_is_told_and_nothing_is_left(
    tmp_path: Path, limit: int
) -> None:
    command = [sys.executable, "-c", MAKE, str(tmp_path / "bank.h5"), str(limit)]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.startswith(f"{tmp_path / 'bank.h5'} ")
    assert "File too large" in told.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit on the size of files")
def test_a_disk_without_room_for_the_owners_name_then_the_bank_is_measured_all_the_same(tmp_path: Path) -> None:
    path = tmp_path / "bank.h5"
    create_bank(path, header(4))
    owner_path(path).mkdir()  # a name that cannot be written, whoever asks
    with BankWriter.open(path) as writer:
        writer.commit(0, green_of(0), record_of(0))
        owner_path(path).rmdir()
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 0, 0, 0]
