"""Power cuts replayed from a log of writes: what survives, and that the replay sees what lesser writers lose."""

import h5py
import numpy as np
import pytest

from tests.lab_files import green_of, raw_header, record_of
from tests.system.crash.power_cuts import (
    INODE,
    Disk,
    LoggedFile,
    WithoutFirstBarrier,
    WithoutSecondBarrier,
    evenly,
    images,
)
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import owner_path
from wavefocus.storage.raw.writer import RawWriter, create_raw, open_raw

POSITIONS, ACTUATORS, TAPS = 3, 2, 16
TRIED = 40
# One position twice, so that the journal is used.
TURNS = ((2, 1), (0, 1), (2, 2), (1, 1))


def header():
    grid = np.stack([np.arange(POSITIONS) * 4.0, np.zeros(POSITIONS)], axis=1)
    corner = np.full((ACTUATORS, 2), np.nan)
    return BankHeader(10_000.0, TAPS, (20.0, 500.0), grid, corner, "{}", "{}", "ab" * 32, "wavefocus test")


@pytest.fixture(autouse=True)
def _fresh_log():
    LoggedFile.log.clear()


def cuts(path, before, log):
    """Some (calls that had returned, bytes of the file) that a power cut can leave; `make soak` tries thousands."""
    found = list(images(Disk({path: before}, {path: INODE}), log, np.random.default_rng(1), 3))
    assert len(found) > TRIED
    return ((image.step, image.files[str(path)]) for image in evenly(found, len(found), TRIED))


def measure(writer):
    """Measure what is left of the turns; return (length of the log, position, attempt) at each acknowledgement."""
    done = []
    for position, attempt in TURNS:
        if writer.attempts[position] < attempt:
            writer.commit(position, green_of(position, attempt), record_of(position, attempt))
            done.append((len(LoggedFile.log), position, attempt))
    return done


def logged_bank(path, open_file):
    """Measure a bank from its beginning; return that, the log and what was acknowledged when."""
    create_bank(path, header())
    before = path.read_bytes()
    with BankWriter.open(path, open_file=open_file) as writer:
        LoggedFile.log.clear()
        acknowledged = measure(writer)
    return before, list(LoggedFile.log), acknowledged


def promised_at(acknowledged, step):
    return {position: attempt for length, position, attempt in acknowledged if length <= step}


def holds(found, position, attempt):
    """What was acknowledged, or the newer attempt that was on its way."""
    return any(np.array_equal(found, green_of(position, newer)) for newer in range(attempt, 3))


def lost_in_bank(path, promised):
    """Positions that were acknowledged and are not in the bank as a reader finds it."""
    lost = 0
    with open_bank(path) as bank:
        for position, attempt in promised.items():
            try:
                lost += not (bank.status[position] and holds(bank.green(position), position, attempt))
            except InputError:
                lost += 1
    return lost


def test_a_power_cut_at_any_write_of_a_bank_loses_nothing_and_ends_identical(tmp_path):
    before, log, acknowledged = logged_bank(tmp_path / "bank.h5", LoggedFile)
    finished = (tmp_path / "bank.h5").read_bytes()
    cut = tmp_path / "bank.h5"
    for step, image in cuts(cut, before, log):
        cut.write_bytes(image)
        promised = promised_at(acknowledged, step)
        assert lost_in_bank(cut, promised) == 0
        with BankWriter.open(cut, open_file=LoggedFile) as writer:
            for position in np.flatnonzero(writer.status).tolist():
                assert np.array_equal(writer.green(position), green_of(position, int(writer.attempts[position])))
            measure(writer)
        assert cut.read_bytes() == finished


@pytest.mark.nightly
def test_writer_without_second_barrier_then_replay_sees_acknowledged_positions_lost(tmp_path):
    path = tmp_path / "bank.h5"
    before, log, acknowledged = logged_bank(path, WithoutSecondBarrier)
    lost = 0
    for step, image in cuts(path, before, log):
        path.write_bytes(image)
        lost += lost_in_bank(path, promised_at(acknowledged, step))
    assert lost > 0


@pytest.mark.nightly
def test_without_the_first_barrier_the_checksum_alone_finds_wrong_positions(tmp_path):
    path = tmp_path / "bank.h5"
    before, log, _ = logged_bank(path, WithoutFirstBarrier)
    wrong_by_ledger = wrong_by_checksum = 0
    for _, image in cuts(path, before, log):
        path.write_bytes(image)
        with open_bank(path) as bank, h5py.File(path, "r") as file:
            for position in np.flatnonzero(bank.status).tolist():
                attempt = int(bank.quality["attempts"][position])
                wrong_by_ledger += not np.array_equal(file["green"][position], green_of(position, attempt))
                try:
                    wrong_by_checksum += not np.array_equal(bank.green(position), green_of(position, attempt))
                except InputError:
                    continue  # it says that it is damaged, and is measured again
    assert wrong_by_ledger > 0
    assert wrong_by_checksum == 0


def raw_of(position, take):
    counts = np.random.default_rng([position, take]).integers(-2000, 2000, size=(2, 1, 700))
    return (counts / 1024).astype(np.float32)


def record(writer):
    """Record all turns; return (length of the log, position, take) at each acknowledgement."""
    done = []
    for position, take in TURNS:
        reference_v, response_v = raw_of(position, take)
        writer.commit(position, reference_v, response_v)
        done.append((len(LoggedFile.log), position, take))
    return done


def test_a_power_cut_at_any_write_of_recordings_loses_none_and_ends_identical(tmp_path):
    path = tmp_path / "night.raw.h5"
    create_raw(path, raw_header(POSITIONS, 1, 700))
    before = path.read_bytes()
    with RawWriter.open(path, open_file=LoggedFile) as writer:
        LoggedFile.log.clear()
        acknowledged = record(writer)
    log, finished = list(LoggedFile.log), path.read_bytes()
    for step, image in cuts(path, before, log):
        path.write_bytes(image)
        with open_raw(path) as kept:
            for position, take in promised_at(acknowledged, step).items():
                found = kept.read(position)
                assert found is not None
                both = np.stack([found.reference_v, found.response_v])
                assert any(np.array_equal(both, raw_of(position, newer)) for newer in range(take, 3))
        with RawWriter.open(path, open_file=LoggedFile) as writer:
            record(writer)
        assert path.read_bytes() == finished


def test_disk_without_room_for_owners_name_then_bank_is_measured_all_same(tmp_path):
    path = tmp_path / "bank.h5"
    create_bank(path, header())
    owner_path(path).mkdir()  # a name that cannot be written, whoever asks
    with BankWriter.open(path) as writer:
        writer.commit(0, green_of(0), record_of(0))
        owner_path(path).rmdir()
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 0, 0]
