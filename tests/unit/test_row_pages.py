"""Sums of windows times rows, wherever the rows lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rendering.drive.omission import Economy
from rendering.drive.row_pages import RowPage, RowsView

BINS, ACTUATORS, PLACES = 9, 3, 12


def make_pages(economy: Economy, seed: int) -> list[RowPage]:
    rng = np.random.default_rng(seed)
    pages = [RowPage(PLACES, ACTUATORS, economy) for _ in range(3)]
    for page in pages:
        page.spectra[:] = rng.standard_normal(page.spectra.shape) + 1j * rng.standard_normal(page.spectra.shape)
        for sizes in (page.sizes.norms, page.sizes.peaks, page.sizes.cut_off):
            sizes[:] = rng.uniform(size=sizes.shape)
    return pages


@settings(max_examples=60, deadline=None)
@given(
    rows=st.lists(
        st.tuples(st.integers(0, 4), st.integers(0, 2), st.integers(0, PLACES - 1)),
        min_size=1,
        max_size=40,
        unique=True,
    ),
    seed=st.integers(0, 2**16),
)
def test_the_sum_of_each_group_is_that_of_its_windows_times_its_rows(rows, seed):
    pages = make_pages(Economy.of(BINS), seed)
    groups, page, place = np.array(rows).T
    rng = np.random.default_rng(seed + 1)
    windows = rng.standard_normal((len(rows), BINS)) + 1j * rng.standard_normal((len(rows), BINS))
    turn = np.exp(2j * np.pi * rng.uniform(size=BINS))
    found = np.full((5, BINS, ACTUATORS), 7j)
    RowsView(pages, page, place).sums(windows, turn, groups, found)
    for group, product in enumerate(found):
        some = np.flatnonzero(groups == group)
        expected = (
            sum((windows[n] * turn)[:, None] * pages[page[n]].spectra[place[n]] for n in some) if len(some) else 7j
        )
        np.testing.assert_allclose(product, np.broadcast_to(expected, product.shape), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("place", [[2, 3, 4, 5, 6], [0, 1, 4, 5], [11, 7, 0, 4], [6]])
def test_rows_that_are_not_asked_for_count_nothing(place):
    pages = make_pages(Economy.of(BINS), 1)
    windows = np.ones((len(place), BINS), dtype=complex)
    view = RowsView(pages, np.ones(len(place), dtype=np.int64), np.array(place))
    (product,) = found = np.empty((1, BINS, ACTUATORS), dtype=complex)
    view.sums(windows, np.ones(BINS), np.zeros(len(place), dtype=np.int64), found)
    np.testing.assert_allclose(product, pages[1].spectra[place].sum(axis=0), rtol=1e-12, atol=1e-12)


def test_sizes_and_magnitudes_are_those_of_the_rows_in_the_order_asked_for():
    economy = Economy.of(BINS, 2, 5, single=True)
    pages = make_pages(economy, 3)
    page, place = np.array([2, 0, 2, 1]), np.array([5, 7, 0, 3])
    view = RowsView(pages, page, place)
    rows = list(zip(page, place, strict=True))
    sizes = view.sizes()
    np.testing.assert_array_equal(sizes.norms, [pages[p].sizes.norms[n] for p, n in rows])
    np.testing.assert_array_equal(sizes.peaks, [pages[p].sizes.peaks[n] for p, n in rows])
    np.testing.assert_array_equal(sizes.cut_off, [pages[p].sizes.cut_off[n] for p, n in rows])
    expected = [np.linalg.norm(pages[p].spectra[n], axis=1) for p, n in rows]
    np.testing.assert_allclose(view.magnitudes(), expected, rtol=1e-6)


def test_a_page_counts_its_free_places():
    page = RowPage(PLACES, ACTUATORS, Economy.of(BINS))
    page.taken = 5
    assert page.free == PLACES - 5
