"""Spectra of rows are those of the bank's rows, whatever was asked for before."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
import pytest

from rendering.drive import row_spectra
from rendering.drive.omission import SQUARES_SLACK, Economy
from rendering.drive.row_spectra import RowSpectra
from rendering.drive.truncation import RowCut
from rendering.greens.bank_rows import BankRows
from rendering.greens.source import GreenArray
from rendering.scene.model import Regularisation
from storage.errors import InputError

POSITIONS, ACTUATORS, TAPS, FFT = 60, 3, 50, 64
BINS = FFT // 2 + 1
POSITION_MM = np.stack([4.0 * np.arange(POSITIONS), np.zeros(POSITIONS)], axis=1)
ROW_BYTES = ACTUATORS * BINS * 16


@pytest.fixture
def workers() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


def make_bank(status: np.ndarray | None = None, dtype: type[np.floating] = np.float64) -> GreenArray:
    values = np.random.default_rng(5).uniform(-1.0, 1.0, (POSITIONS, ACTUATORS, TAPS))
    values[:, 0, 0] = 0.9
    return GreenArray(values.astype(dtype), POSITION_MM, 1000.0, status=status)


def make_spectra(workers: Executor, bank: GreenArray, economy: Economy, **more) -> RowSpectra:
    rows = BankRows(bank, Regularisation())
    return RowSpectra(rows, RowCut.nothing(TAPS, ACTUATORS), FFT, economy, workers, **more)


def expected_spectra(bank: GreenArray, row: int) -> np.ndarray:
    return np.conj(np.fft.rfft(bank.values[row], FFT, axis=1))


def assert_prepared(spectra: RowSpectra, bank: GreenArray, rows: list[int], *, rtol: float = 1e-12) -> None:
    spectra.prepare(rows)
    economy = spectra.economy
    view = spectra.view(rows)
    ones = np.ones((len(rows), economy.kept), dtype=economy.complex)
    found = np.empty((len(rows), economy.kept, ACTUATORS), dtype=economy.complex)
    view.sums(ones, ones[0], np.arange(len(rows)), found)
    for row, product in zip(rows, found, strict=True):
        whole = expected_spectra(bank, row)
        np.testing.assert_allclose(product.T, whole[:, economy.low : economy.high], rtol=rtol, atol=rtol * 50)
    if not economy.exact:
        spectra_of_rows = np.array([expected_spectra(bank, row) for row in rows])
        joint, slack = np.linalg.norm(spectra_of_rows, axis=1), 1.01 * (SQUARES_SLACK - 1.0)
        segments = np.sqrt(np.add.reduceat(np.square(joint), economy.starts, axis=1))
        sizes = view.sizes()
        np.testing.assert_allclose(sizes.norms[:, :-1], segments, rtol=slack)
        np.testing.assert_allclose(sizes.norms[:, -1], np.linalg.norm(joint, axis=1), rtol=slack)
        np.testing.assert_allclose(sizes.peaks, joint.max(axis=1), rtol=slack)


def test_rows_come_back_whatever_was_asked_for_before(workers):
    bank = make_bank()
    spectra = make_spectra(workers, bank, Economy.of(BINS))
    for rows in ([3, 1, 2], [2, 40, 3], list(range(30)), [59, 0, 41, 1]):
        assert_prepared(spectra, bank, rows)


@pytest.mark.parametrize("expected_rows", [0, 7, 1000])
def test_a_full_cache_lets_the_rows_go_that_were_not_used_for_longest(workers, monkeypatch, expected_rows):
    monkeypatch.setattr(row_spectra, "CACHE_BYTES", 24 * ROW_BYTES)
    monkeypatch.setattr(row_spectra, "PAGE_BYTES", 5 * ROW_BYTES)
    bank = make_bank()
    spectra = make_spectra(workers, bank, Economy.of(BINS), expected_rows=expected_rows)
    assert spectra.most_rows == 24
    rng = np.random.default_rng(expected_rows)
    for _ in range(30):
        rows = rng.choice(POSITIONS, size=int(rng.integers(1, 25)), replace=False).tolist()
        assert_prepared(spectra, bank, rows)


def test_a_view_stays_as_it_is_when_its_rows_have_gone(workers, monkeypatch):
    monkeypatch.setattr(row_spectra, "CACHE_BYTES", 16 * ROW_BYTES)
    bank = make_bank()
    spectra = make_spectra(workers, bank, Economy.of(BINS))
    spectra.prepare([7])
    view = spectra.view([7])
    for first in range(10, 58, 16):
        spectra.prepare(range(first, first + 16))
    (product,) = found = np.empty((1, BINS, ACTUATORS), dtype=complex)
    view.sums(np.ones((1, BINS), dtype=complex), np.ones(BINS), np.zeros(1, dtype=np.int64), found)
    np.testing.assert_allclose(product.T, expected_spectra(bank, 7), rtol=1e-12, atol=1e-12)


def test_rows_looked_at_before_are_taken_from_there(workers):
    bank = make_bank()
    looked_at = make_spectra(workers, bank, Economy.of(BINS, single=True))
    looked_at.prepare([4, 20, 5])
    spectra = make_spectra(workers, bank, Economy.of(BINS, 3, 17, single=True), looked_at=looked_at)
    assert_prepared(spectra, bank, [19, 5, 4, 6, 20], rtol=1e-5)


def test_a_row_that_may_not_be_used_leaves_nothing_half_done(workers):
    status = np.ones(POSITIONS, dtype=np.uint8)
    status[6] = 0
    bank = make_bank(status)
    spectra = make_spectra(workers, bank, Economy.of(BINS))
    with pytest.raises(InputError, match="position 6"):
        spectra.prepare([5, 6, 7])
    assert_prepared(spectra, bank, [5, 7])


SINGLE = Economy.of(BINS, 3, 25, single=True)


def test_given_rows_in_single_precision_then_they_come_back_whatever_was_asked_for_before(workers, monkeypatch):
    monkeypatch.setattr(row_spectra, "CACHE_BYTES", 24 * ACTUATORS * SINGLE.kept * 8)
    bank = make_bank(dtype=np.float32)
    spectra = make_spectra(workers, bank, SINGLE)
    for rows in ([3, 1, 2], [2, 40, 3], list(range(20)), list(range(40, 60)), [59, 0, 41, 1], list(range(24))):
        assert_prepared(spectra, bank, rows, rtol=2e-6)


def test_given_more_rows_than_are_transformed_at_a_time_then_all_of_them_are_there(workers, monkeypatch):
    monkeypatch.setattr(row_spectra, "CHUNK", 3)
    monkeypatch.setattr(row_spectra, "CHUNKS_AHEAD", 2)
    bank = make_bank(dtype=np.float32)
    assert_prepared(make_spectra(workers, bank, SINGLE), bank, list(range(POSITIONS)), rtol=2e-6)


def test_given_rows_that_the_compiled_loops_cannot_read_then_they_come_back_among_the_others(workers):
    bank = make_bank(dtype=np.float32)
    bank.values[7, 1, 20] = 1e-41
    assert_prepared(make_spectra(workers, bank, SINGLE), bank, list(range(12)), rtol=2e-6)


def test_given_rows_looked_at_in_all_bins_then_those_kept_are_theirs(workers):
    bank = make_bank(dtype=np.float32)
    looked_at = make_spectra(workers, bank, Economy.of(BINS, single=True))
    assert_prepared(looked_at, bank, [4, 9], rtol=2e-6)
    looked_at.prepare([5, 6])
    assert_prepared(make_spectra(workers, bank, SINGLE, looked_at=looked_at), bank, [3, 4, 5, 6, 7, 9], rtol=2e-6)


def test_given_a_cut_then_taps_and_actuators_that_are_not_used_are_told(workers):
    bank = make_bank(dtype=np.float32)
    cut = RowCut(30, np.array([0, 2]), ACTUATORS, whole=False)
    spectra = RowSpectra(BankRows(bank, Regularisation()), cut, FFT, SINGLE, workers)
    spectra.prepare([11, 12])
    sizes = spectra.view([11, 12]).sizes()
    for row, cut_off in zip([11, 12], sizes.cut_off, strict=True):
        rest = bank.values[row].astype(np.float64)
        rest[[0, 2], :30] = 0.0
        # Rows are scaled by powers of two, here by none: their largest value is 0.9 or more.
        np.testing.assert_allclose(cut_off, np.linalg.norm(rest), rtol=1e-6)
    joint = np.linalg.norm(np.fft.rfft(bank.values[11][[0, 2], :30].astype(np.float64), FFT, axis=1), axis=0)
    np.testing.assert_allclose(sizes.peaks[0], joint.max(), rtol=1.01 * (SQUARES_SLACK - 1.0))


def test_given_that_spectra_are_let_go_while_they_are_made_then_nothing_else_is_written_to(workers):
    bank = make_bank(dtype=np.float32)
    for _ in range(50):
        # Gone at once, with all its pages, whose memory the next one may get.
        make_spectra(workers, bank, Economy.of(BINS, single=True)).prepare(list(range(POSITIONS)))
        assert_prepared(make_spectra(workers, bank, SINGLE), bank, list(range(10)), rtol=2e-6)
