"""Samples of windows are those of their events, however the events follow each other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rendering.drive.windows import LONG_RUN, Events, Windows

HOP, BLOCKS, LENGTH = 400, 2, 500


def weigh(rows: np.ndarray, by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 1.0 + rows, np.zeros(len(rows), dtype=bool)


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("same", [False, True])
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), longest=st.sampled_from([1, 3, LONG_RUN, 4 * LONG_RUN]))
def test_each_window_holds_what_its_row_emits_in_its_block(real, same, seed, longest):
    rng = np.random.default_rng(seed)
    length = rng.integers(1, longest + 1, 2 * HOP * BLOCKS)
    length = length[: np.searchsorted(np.cumsum(length), HOP * BLOCKS) + 1]
    sample = np.cumsum(length) - length
    length[-1] = HOP * BLOCKS - sample[-1]
    rows = rng.integers(0, 5, (len(length), 2))
    if same:
        # Both nodes of an event are one row: what they emit adds up.
        rows[:, 1] = rows[:, 0]
    weights = rng.uniform(0.1, 1.0, rows.shape)
    values = rng.uniform(0.1, 1.0, HOP * BLOCKS)
    windows = Windows(Events(rows, weights, rows[:, 0], sample, length, values), HOP, BLOCKS, weigh)
    expected = np.zeros((BLOCKS, 5, LENGTH))
    for (one, other), (weight, further), begin, count in zip(rows, weights, sample, length, strict=True):
        for row, share in ((one, weight), (other, further)):
            for at in range(begin, begin + count):
                expected[at // HOP, row, at % HOP] += share * values[at] * (1.0 + row)
    found = windows.samples(np.arange(len(windows)), LENGTH, real)
    assert found.dtype == real
    for number, (block, row) in enumerate(zip(windows.block, windows.rows, strict=True)):
        np.testing.assert_allclose(found[number], expected[block, row], rtol=1e-5 if real == np.float32 else 1e-13)
        expected[block, row] = 0.0
    assert not expected.any()
    some = np.arange(0, len(windows), 2)
    np.testing.assert_array_equal(windows.samples(some, LENGTH, real), found[some])
