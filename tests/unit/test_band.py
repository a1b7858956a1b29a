"""Single precision, and the bound on what that does."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.rendering.band import (
    Band,
    norm_of,
    relative_bound,
    row_norms,
    tolerance_of,
)
from wavefocus.rendering.drive.accumulate import choose_fft_samples
from wavefocus.storage.errors import InputError


@given(seed=st.integers(0, 2**31), fall=st.floats(0, 0.2))
@settings(max_examples=60, deadline=None)
def test_the_error_of_a_block_in_single_precision_is_within_its_bound(seed, fall):
    """Three windows over four actuators, against the same block in double precision."""
    rng = np.random.default_rng(seed)
    samples = 512
    band = Band.whole(samples, single=True)
    shape = np.exp(-fall * np.abs(np.arange(samples // 2 + 1) - 60))
    green = np.fft.irfft(np.fft.rfft(rng.standard_normal((3, 4, samples))) * shape)
    green[..., 200:] = 0
    windows = np.fft.rfft(rng.standard_normal((3, 300)), samples)
    exact = np.fft.irfft(np.einsum("wk,wik->ik", windows, np.fft.rfft(green)), samples)
    rough = scipy.fft.rfft(green.astype(band.real))
    total = np.einsum("wk,wik->ik", windows.astype(band.complex), rough)
    coherent = sum(np.abs(u).max() * np.linalg.norm(g) for u, g in zip(windows, rough, strict=True))
    bound = band.rounding_error(float(coherent), 3)
    error = np.linalg.norm(scipy.fft.irfft(total, samples) - exact)
    assert error <= bound + 1e-13 * np.linalg.norm(exact)
    assert bound <= 1e-3 * np.sqrt(samples) * np.linalg.norm(exact)


@pytest.mark.parametrize("size", [1.0, 1e-300, 1e300])
def test_norms_neither_over_nor_underflow(size):
    values = np.array([[3.0, 4.0], [0.0, 0.0]]) * size
    assert norm_of(values) == pytest.approx(5 * size, rel=1e-12)
    np.testing.assert_allclose(row_norms(values), [5 * size, 0], rtol=1e-12)


def test_a_relative_bound_is_not_proved_where_the_error_may_be_all_there_is():
    assert relative_bound(0.0, 0.0) == 0.0
    assert relative_bound(1.0, 1.0) == float("inf")
    assert relative_bound(1.0, 5.0) == pytest.approx(1 / 4)


@pytest.mark.parametrize("tolerance_db", [0.0, 3.0, float("nan"), float("-inf")])
def test_a_tolerance_that_is_not_below_zero_is_refused(tolerance_db):
    with pytest.raises(InputError, match="tolerance_db"):
        tolerance_of(tolerance_db)


@given(reach=st.integers(1, 5000), span=st.integers(1, 10**6), actuators=st.integers(1, 64), rows=st.integers(1, 300))
@settings(max_examples=60, deadline=None)
def test_a_transform_holds_what_an_event_reaches(reach, span, actuators, rows):
    assert choose_fft_samples(reach, span, actuators, [(np.arange(rows), 1)]) >= reach


def test_rows_that_emit_briefly_get_shorter_transforms_than_rows_that_stay():
    brief = choose_fft_samples(2000, 100_000, 20, [(np.arange(5000) % 1500, 1)])
    assert brief < choose_fft_samples(2000, 100_000, 20, [(np.zeros(1, np.int64), 1)])
