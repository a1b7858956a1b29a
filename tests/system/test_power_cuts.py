"""Power cuts replayed from a log of writes: what survives, and that the replay sees what a lesser writer loses."""

from contextlib import suppress

import h5py
import numpy as np
import pytest

from tests.lab_files import green_of, raw_header, record_of, write_bank
from tests.system.crash.power_cuts import INODE, Disk, LoggedFile, WithoutFirstBarrier, evenly, images
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import owner_path
from wavefocus.storage.raw.writer import RawWriter, create_raw, open_raw

POSITIONS, ACTUATORS, TAPS = 3, 2, 16
TRIED = 40
# One position twice, so that the journal is used.
TURNS = ((2, 1), (0, 1), (2, 2), (1, 1))


def volts(position, take):
    """Reference and response of a record, (2, 1, samples)."""
    counts = np.random.default_rng([position, take]).integers(-2000, 2000, size=(2, 1, 700))
    return (counts / 1024).astype(np.float32)


def new_file(path):
    """Create a file, of recordings where its name says so; returns its kind of writer and what a turn puts into it."""
    if ".raw" in path.name:
        create_raw(path, raw_header(POSITIONS, 1, 700))
        return RawWriter, volts
    write_bank(path, np.zeros((POSITIONS, ACTUATORS, TAPS)), rows=())
    return BankWriter, green_of


def measure(writer):
    """Measure what is left of the turns, and record them all; (length of the log, position, attempt) of each."""
    done = []
    for position, attempt in TURNS:
        if isinstance(writer, RawWriter):
            writer.commit(position, *volts(position, attempt))
        elif writer.attempts[position] < attempt:
            writer.commit(position, green_of(position, attempt), record_of(position, attempt))
        else:
            continue
        done.append((len(LoggedFile.log), position, attempt))
    return done


def cuts(path, open_file=LoggedFile):
    """Measure a new file; some (positions and attempts acknowledged, bytes) that a power cut leaves of it.

    `make soak` tries thousands.
    """
    kind, _ = new_file(path)
    before = path.read_bytes()
    with kind.open(path, open_file=open_file) as writer:
        LoggedFile.log.clear()
        acknowledged = measure(writer)
    found = list(images(Disk({path: before}, {path: INODE}), list(LoggedFile.log), np.random.default_rng(1), 3))
    assert len(found) > TRIED
    return [
        (
            {position: attempt for length, position, attempt in acknowledged if length <= image.step},
            image.files[str(path)],
        )
        for image in evenly(found, len(found), TRIED)
    ]


def kept(path, position):
    """What a reader finds of a position, None where there is nothing."""
    if ".raw" in path.name:
        with open_raw(path) as raw:
            found = raw.read(position)
        return None if found is None else np.stack([found.reference_v, found.response_v])
    with open_bank(path) as bank, suppress(InputError):
        return bank.green(position) if bank.status[position] else None


def lost(path, promised, of=green_of):
    """Positions of which neither what was acknowledged is there nor the newer attempt that was on its way."""
    return [
        position
        for position, attempt in promised.items()
        if not any(np.array_equal(kept(path, position), of(position, newer)) for newer in range(attempt, 3))
    ]


@pytest.mark.parametrize("name", ["bank.h5", "night.raw.h5"])
def test_a_power_cut_at_any_write_of_a_file_loses_nothing_and_ends_identical(tmp_path, name):
    path = tmp_path / name
    found, finished = cuts(path), path.read_bytes()
    kind, of = new_file(tmp_path / f"other {name}")
    for promised, image in found:
        path.write_bytes(image)
        assert lost(path, promised, of) == []
        with kind.open(path, open_file=LoggedFile) as writer:
            for position in np.flatnonzero(writer.status).tolist() if kind is BankWriter else ():
                assert np.array_equal(writer.green(position), green_of(position, int(writer.attempts[position])))
            measure(writer)
        assert path.read_bytes() == finished


@pytest.mark.nightly
def test_without_the_first_barrier_the_checksum_alone_finds_wrong_positions(tmp_path):
    path = tmp_path / "bank.h5"
    wrong_by_ledger = wrong_by_checksum = 0
    for _, image in cuts(path, WithoutFirstBarrier):
        path.write_bytes(image)
        with open_bank(path) as bank, h5py.File(path, "r") as file:
            for position in np.flatnonzero(bank.status).tolist():
                right = green_of(position, int(bank.quality["attempts"][position]))
                wrong_by_ledger += not np.array_equal(file["green"][position], right)
                found = kept(path, position)  # None where it says that it is damaged, and is measured again
                wrong_by_checksum += not (found is None or np.array_equal(found, right))
    assert wrong_by_ledger > 0
    assert wrong_by_checksum == 0


def test_disk_without_room_for_owners_name_then_bank_is_measured_all_same(tmp_path):
    path = tmp_path / "bank.h5"
    new_file(path)
    owner_path(path).mkdir()  # a name that cannot be written, whoever asks
    with BankWriter.open(path) as writer:
        writer.commit(0, green_of(0), record_of(0))
        owner_path(path).rmdir()
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 0, 0]
