"""The journal of a scan: what was kept is there again, what is not whole does not count."""

import numpy as np
import pytest

from tests.lab_files import flip
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.storage.scan_journal import ScanJournal, ScannedPosition

SAMPLES = 40


def scanned(row):
    response = np.random.default_rng(row).standard_normal(SAMPLES).astype(np.float32)
    return ScannedPosition(row, 1, 2, 1e-4 * row, 1.00003, 0.99, response)


@pytest.fixture
def path(tmp_path):
    """A journal of three positions."""
    with ScanJournal(tmp_path / "scan.unfinished", "one", SAMPLES) as journal:
        for row in (4, 0, 7):
            journal.append(scanned(row))
    return tmp_path / "scan.unfinished"


def rows(path):
    with ScanJournal(path, "one", SAMPLES) as journal:
        return [one.row for one in journal.entries()]


def test_given_a_kill_at_any_byte_then_whole_entries_count_and_the_next_one_is_kept(path):
    with ScanJournal(path, "one", SAMPLES) as journal:
        for found, row in zip(journal.entries(), (4, 0, 7), strict=True):
            wanted = scanned(row)
            assert (found.row, found.status, found.attempts) == (row, 1, 2)
            assert (found.noise_rms, found.clock_ratio, found.playback_gain) == (wanted.noise_rms, 1.00003, 0.99)
            np.testing.assert_array_equal(found.response, wanted.response)
    whole = path.read_bytes()
    entry = (len(whole) - 4096) // 3
    for size in (0, 10, 4096, 4096 + entry - 1, 4096 + entry, len(whole) - 1, len(whole)):
        path.write_bytes(whole[:size])
        there = [4, 0, 7][: max(0, size - 4096) // entry]
        assert rows(path) == there
        with ScanJournal(path, "one", SAMPLES) as journal:
            journal.append(scanned(9))
        assert rows(path) == [*there, 9]
    for head in (bytes(4096), bytes(512) + whole[512:4096], whole[:512] + bytes(3584)):  # by a power cut
        path.write_bytes(head)
        assert rows(path) == []
        assert path.read_bytes() == whole[:4096]


def test_given_a_flipped_bit_then_what_follows_is_scanned_again(path):
    flip(path, -(path.stat().st_size - 4096) // 2)
    assert rows(path) == [4]


def test_another_scan_process_or_program_is_refused_and_a_scan_may_be_replaced(path):
    with ScanJournal(path, "one", SAMPLES), pytest.raises(BankBusyError):
        ScanJournal(path, "one", SAMPLES)
    with pytest.raises(InputError, match="another drive"):
        ScanJournal(path, "other", SAMPLES)
    with pytest.raises(InputError, match="another drive"):
        ScanJournal(path, "one", SAMPLES + 1)
    with ScanJournal(path, "other", SAMPLES, replace=True) as journal:
        assert len(journal) == 0
    with pytest.raises(InputError, match="another drive"):
        rows(path)
    path.write_bytes(b"x" * 9000)
    with pytest.raises(InputError, match="not what a scan left"):
        ScanJournal(path, "one", SAMPLES, replace=True)
    assert path.read_bytes() == b"x" * 9000
