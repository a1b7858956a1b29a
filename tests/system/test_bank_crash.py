"""What survives when the process that writes a bank goes at any instant."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.ledger.owner import owner_path

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


# HDF5 on a disk that fails loses what it could not write, or takes the process along: it must not be on the disk.
MAKE = """
import resource, sys
from wavefocus.storage.bank.writer import create_bank
from wavefocus.storage.errors import InputError
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
def test_a_disk_that_fills_while_a_bank_is_made_is_told_and_nothing_is_left(tmp_path: Path, limit: int) -> None:
    command = [sys.executable, "-c", MAKE, str(tmp_path / "bank.h5"), str(limit)]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout.startswith(f"{tmp_path / 'bank.h5'} ")
    assert "File too large" in told.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit on the size of files")
def test_disk_without_room_for_owners_name_then_bank_is_measured_all_same(tmp_path: Path) -> None:
    path = tmp_path / "bank.h5"
    create_bank(path, header(4))
    owner_path(path).mkdir()  # a name that cannot be written, whoever asks
    with BankWriter.open(path) as writer:
        writer.commit(0, green_of(0), record_of(0))
        owner_path(path).rmdir()
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 0, 0, 0]
