"""Banks and raw files that are deleted, renamed, replaced, truncated or overwritten while they are measured."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from storage.bank.header import BankHeader
from storage.bank.ledger import PointRecord
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter, create_bank
from storage.errors import FileLostError
from storage.raw.header import RawHeader
from storage.raw.reading import open_raw
from storage.raw.schedule import Schedule
from storage.raw.writer import RawWriter, create_raw

POSITION_MM = np.stack([np.arange(4) * 4.0, np.zeros(4)], axis=1)


def a_bank(path: Path) -> BankWriter:
    header = BankHeader(
        10_000.0, 16, (20.0, 500.0), POSITION_MM, np.zeros((2, 2)), "{}", "{}", "ab" * 32, "wavefocus test"
    )
    create_bank(path, header)
    return BankWriter.open(path)


def commit(writer: BankWriter, position: int) -> None:
    figures = np.ones(2, np.float32)
    writer.commit(position, green_of(position), PointRecord(1, 1, figures, figures, figures, figures))


def green_of(position: int) -> np.ndarray:
    return np.random.default_rng(position).normal(size=(2, 16)).astype(np.float32)


def delete(path: Path) -> None:
    path.unlink()


def replace(path: Path) -> None:
    other = path.with_name("other.h5")
    shutil.copy(path, other)
    other.replace(path)


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size - 4096)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def overwrite(path: Path) -> None:
    with path.open("r+b") as file:
        file.write(bytes(8192))


def delete_beside(path: Path) -> None:
    shutil.rmtree(path.parent)
    path.parent.mkdir()


LOSSES: list[tuple[Callable[[Path], None], set[int]]] = [
    (delete, {0, 1, 2}),
    (replace, {0, 1, 2}),
    (overwrite, {0, 1, 2}),
    (empty, {2}),  # only what is being written is still there
    (delete_beside, {0, 1, 2}),
]


@pytest.mark.parametrize(("lose", "kept"), LOSSES, ids=lambda value: getattr(value, "__name__", ""))
def test_a_bank_lost_while_it_is_measured_then_ends_the_session_and_is_kept_under_another_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lose: Callable[[Path], None], kept: set[int]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "data" / "night.h5"
    path.parent.mkdir()
    with a_bank(path) as writer:
        commit(writer, 0)
        commit(writer, 1)
        lose(path)
        with pytest.raises(FileLostError) as lost:
            commit(writer, 2)
    (rescue,) = tmp_path.rglob("night.rescue.h5")
    assert str(rescue) in str(lost.value)
    with open_bank(rescue) as bank:
        assert set(np.flatnonzero(bank.status)) == kept
        assert all(np.array_equal(bank.green(row), green_of(row)) for row in kept)
    with BankWriter.open(rescue, plan_sha256="ab" * 32) as writer:  # and is gone on with
        commit(writer, 3)


def test_a_bank_truncated_at_its_end_then_keeps_the_rows_before(tmp_path: Path) -> None:
    path = tmp_path / "night.h5"
    with a_bank(path) as writer:
        commit(writer, 0)
        truncate(path)
        with pytest.raises(FileLostError):
            commit(writer, 1)
    with open_bank(tmp_path / "night.rescue.h5") as bank:
        assert 1 in np.flatnonzero(bank.status)


def test_a_bank_lost_after_its_last_commit_then_is_found_on_closing(tmp_path: Path) -> None:
    path = tmp_path / "night.h5"
    writer = a_bank(path)
    commit(writer, 0)
    path.unlink()
    with pytest.raises(FileLostError):
        writer.close()
    with open_bank(tmp_path / "night.rescue.h5") as bank:
        assert np.array_equal(bank.green(0), green_of(0))


def test_a_second_loss_then_leaves_the_first_rescue_file(tmp_path: Path) -> None:
    path = tmp_path / "night.h5"
    for _ in range(2):
        with a_bank(path) as writer:
            path.unlink()
            with pytest.raises(FileLostError):
                commit(writer, 0)
    assert {one.name for one in tmp_path.glob("*.rescue*.h5")} == {"night.rescue.h5", "night.rescue2.h5"}


def test_a_renamed_bank_then_gets_its_name_back_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "night.h5"
    with a_bank(path) as writer:
        commit(writer, 0)
        path.rename(tmp_path / "kept.h5")
        commit(writer, 1)
        assert writer.renamed
    with open_bank(path) as bank:
        assert list(bank.status) == [1, 1, 0, 0]
    assert path.samefile(tmp_path / "kept.h5")


@pytest.mark.parametrize("lose", [delete, replace, overwrite])
def test_a_raw_file_lost_while_it_is_recorded_then_is_kept_under_another_name(
    tmp_path: Path, lose: Callable[[Path], None]
) -> None:
    path = tmp_path / "night.raw.h5"
    schedule = Schedule(np.zeros((1, 1), np.int32), np.zeros((1, 1)), np.ones((1, 1)), 0.0)
    header = RawHeader(
        10_000.0, 64, 16, (20.0, 500.0), schedule, POSITION_MM, np.zeros((1, 2)), 1.0, volts_per_count=(1e-3, 1e-3)
    )
    create_raw(path, header)
    volts = np.full((1, 64), 0.5, np.float32)
    with RawWriter.open(path) as writer:
        writer.commit(0, volts, volts)
        lose(path)
        with pytest.raises(FileLostError):
            writer.commit(1, volts, volts)
    with open_raw(tmp_path / "night.raw.rescue.h5") as raw:
        assert [row for row in range(4) if raw.read(row) is not None] == [0, 1]
