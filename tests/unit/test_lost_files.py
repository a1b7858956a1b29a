"""Banks and raw files that are deleted, renamed, replaced, truncated or overwritten while they are measured."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import green_of, raw_header, record_of, write_bank
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import FileLostError
from wavefocus.storage.raw.writer import RawWriter, create_raw, open_raw

VOLTS = np.full((1, 64), 0.5, np.float32)


def a_writer(path):
    """A new file, of raw recordings where its name says so."""
    if ".raw" in path.name:
        create_raw(path, raw_header(4, 1, 64))
        return RawWriter.open(path)
    write_bank(path, np.zeros((4, 2, 16)), rows=())
    return BankWriter.open(path)


def commit(writer, position):
    if isinstance(writer, RawWriter):
        writer.commit(position, VOLTS, VOLTS)
    else:
        writer.commit(position, green_of(position), record_of(position))


def kept_in(path):
    """Positions that a file holds, as they were committed."""
    if ".raw" in path.name:
        with open_raw(path) as raw:
            return {row for row in range(4) if (found := raw.read(row)) and np.array_equal(found.response_v, VOLTS)}
    with open_bank(path) as bank:
        return {row for row in np.flatnonzero(bank.status).tolist() if np.array_equal(bank.green(row), green_of(row))}


def overwrite(path):
    with path.open("r+b") as file:
        file.write(bytes(8192))


def delete_folder(path):
    shutil.rmtree(path.parent)
    path.parent.mkdir()


LOSSES = {
    "deleted": Path.unlink, "overwritten": overwrite, "folder deleted": delete_folder,
    "emptied": lambda path: os.truncate(path, 0),
    "replaced": lambda path: shutil.copy(path, path.with_name("other.h5")).replace(path),
}  # fmt: skip


@pytest.mark.parametrize(("name", "loss"), [("night", loss) for loss in LOSSES] + [("night.raw", "emptied")])
def test_a_file_lost_while_it_is_measured_ends_the_session_and_is_rescued(tmp_path, monkeypatch, name, loss):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "data" / f"{name}.h5"
    path.parent.mkdir()
    with a_writer(path) as writer:
        commit(writer, 0)
        commit(writer, 1)
        LOSSES[loss](path)
        with pytest.raises(FileLostError) as lost:
            commit(writer, 2)
    (rescue,) = tmp_path.rglob(f"{name}.rescue.h5")
    assert str(rescue) in str(lost.value)
    kept = {2} if loss == "emptied" else {0, 1, 2}  # only what is being written is still there
    assert kept_in(rescue) == kept
    with type(writer).open(rescue, plan_sha256="ab" * 32) as again:  # and is gone on with
        commit(again, 3)
    assert kept_in(rescue) == kept | {3}


def test_a_bank_truncated_or_lost_after_its_last_commit_has_a_rescue_file_each_time(tmp_path):
    path = tmp_path / "night.h5"
    with a_writer(path) as writer:
        commit(writer, 0)
        os.truncate(path, path.stat().st_size - 4096)
        with pytest.raises(FileLostError):
            commit(writer, 1)
    assert 1 in kept_in(tmp_path / "night.rescue.h5")
    path.unlink()
    writer = a_writer(path)
    commit(writer, 0)
    path.unlink()
    with pytest.raises(FileLostError):
        writer.close()
    assert kept_in(tmp_path / "night.rescue2.h5") == {0}
    assert {one.name for one in tmp_path.glob("*.rescue*.h5")} == {"night.rescue.h5", "night.rescue2.h5"}


def test_a_renamed_bank_then_gets_its_name_back_and_goes_on(tmp_path):
    path = tmp_path / "night.h5"
    with a_writer(path) as writer:
        commit(writer, 0)
        path.rename(tmp_path / "kept.h5")
        commit(writer, 1)
        assert writer.renamed
    assert kept_in(path) == {0, 1}
    assert path.samefile(tmp_path / "kept.h5")
