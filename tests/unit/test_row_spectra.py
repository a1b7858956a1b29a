"""Spectra of rows are those of the bank's rows, whatever was asked for before."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
import pytest

from calibration.errors import InputError
from rendering import row_spectra
from rendering.bank_rows import BankRows
from rendering.green_source import GreenArray
from rendering.omission import SQUARES_SLACK, Economy
from rendering.row_cut import RowCut
from rendering.row_spectra import RowSpectra
from rendering.scene import Regularisation

POSITIONS, ACTUATORS, TAPS, FFT = 60, 3, 50, 64
BINS = FFT // 2 + 1
POSITION_MM = np.stack([4.0 * np.arange(POSITIONS), np.zeros(POSITIONS)], axis=1)
ROW_BYTES = ACTUATORS * BINS * 16


@pytest.fixture
def workers() -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


def make_bank(status: np.ndarray | None = None) -> GreenArray:
    values = np.random.default_rng(5).uniform(-1.0, 1.0, (POSITIONS, ACTUATORS, TAPS))
    values[:, 0, 0] = 0.9
    return GreenArray(values, POSITION_MM, 1000.0, status=status)


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
