"""Single mutations of files: `check` finds each that changes a value, and none ends in a traceback."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import write_bank
from tests.unit.mutations import mutations, snapshot, stored_bytes
from wavefocus.calibration.check import check_file
from wavefocus.storage.drive_file import Drive, write_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, write_field
from wavefocus.storage.raw.header import RawHeader, Schedule
from wavefocus.storage.raw.writer import RawWriter, create_raw

POSITION_MM = np.stack([np.arange(5) * 4.0, np.zeros(5)], axis=1)
RNG = np.random.default_rng(0)


def a_bank(path: Path) -> None:
    green = RNG.normal(size=(5, 3, 100)) * np.exp(-np.arange(100) / 7)
    write_bank(path, green, POSITION_MM, rows=range(4))  # the last one is not measured


def a_raw_file(path: Path) -> None:
    schedule = Schedule(np.arange(3, dtype=np.int32)[:, None], np.zeros((3, 1)), np.ones((3, 1)), 0.0)
    header = RawHeader(
        10_000.0, 400, 100, (20.0, 500.0), schedule, POSITION_MM, np.zeros((3, 2)), 1.0, volts_per_count=(1e-3, 1e-3),
        plan_sha256="ab" * 32,
    )  # fmt: skip
    create_raw(path, header)
    with RawWriter.open(path) as writer:
        for position in range(4):
            volts = RNG.integers(-999, 999, (2, 3, 400)).astype(np.float32) * np.float32(1e-3)
            writer.commit(position, volts[0], volts[1])


def a_drive(path: Path) -> None:
    foci = np.arange(7)
    write_drive(path, Drive(RNG.normal(size=(3, 300)), 1e4, -0.01, "sampled", 0.5, 1e-6, foci, foci % 5, foci * 0))


def a_field(path: Path) -> None:
    write_field(path, Field(RNG.normal(size=(5, 400)), np.arange(5), 1e4, -0.01, "m/s"))


MAKERS = {"bank": a_bank, "raw": a_raw_file, "drive": a_drive, "field": a_field}


@pytest.mark.parametrize("kind", MAKERS)
def test_a_sound_file_then_has_no_findings(tmp_path: Path, kind: str) -> None:
    MAKERS[kind](tmp_path / "file.h5")
    assert check_file(tmp_path / "file.h5") == []


@pytest.mark.parametrize("kind", MAKERS)
def test_single_mutations_then_are_found_where_they_change_a_value(tmp_path: Path, kind: str) -> None:
    assert missed(tmp_path / "file.h5", kind, 30, seed=1) == []


@pytest.mark.nightly
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", MAKERS)
def test_a_thousand_single_mutations_then_are_found_where_they_change_a_value(tmp_path: Path, kind: str) -> None:
    assert missed(tmp_path / "file.h5", kind, 1000, seed=2) == []


def missed(path: Path, kind: str, count: int, seed: int) -> list[str]:
    """Mutations that change what h5py reads and that the check does not find."""
    MAKERS[kind](path)
    content, before = path.read_bytes(), snapshot(path)
    found = []
    for what, changed in mutations(content, stored_bytes(path), count, seed):
        path.write_bytes(changed)
        try:
            sound = not any(one.severity == "error" for one in check_file(path))
        except InputError:
            continue
        if sound and snapshot(path) != before:
            found.append(what)
    return found
