"""Bins left out, and the bound on what that does."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rendering.drive.block_size import choose_fft_samples
from rendering.drive.omission import Economy, ErrorBudget, choose_bins, relative_bound, row_norms, scaled_norm
from rendering.field.product_bounds import SpectrumSizes


@given(bins=st.integers(1, 3000), ends=st.tuples(st.floats(0, 1), st.floats(0, 1)), single=st.booleans())
@settings(max_examples=60, deadline=None)
def test_segments_partition_the_bins_with_those_computed_as_one_of_them(bins, ends, single):
    low = int(min(ends) * (bins - 1))
    high = max(low + 1, int(max(ends) * bins))
    economy = Economy.of(bins, low, high, single=single)
    assert economy.starts[0] == 0
    assert (np.diff(economy.starts) > 0).all()
    assert low in economy.starts
    assert high == bins or high in economy.starts
    assert not ((economy.starts > low) & (economy.starts < high)).any()
    assert economy.segments <= 4 * np.log2(bins + 1) + 5


@given(
    seed=st.integers(0, 2**31),
    single=st.booleans(),
    ends=st.tuples(st.integers(0, 200), st.integers(1, 257)),
    fall=st.floats(0, 0.2),
)
@settings(max_examples=60, deadline=None)
def test_the_error_of_a_block_is_within_its_bound(seed, single, ends, fall):
    """Three windows over four actuators, against the same block with all bins in double precision."""
    rng = np.random.default_rng(seed)
    samples = 512
    low, high = ends[0], max(ends[0] + 1, ends[1])
    economy = Economy.of(samples // 2 + 1, low, high, single=single)
    shape = np.exp(-fall * np.abs(np.arange(samples // 2 + 1) - 60))
    green = np.fft.irfft(np.fft.rfft(rng.standard_normal((3, 4, samples))) * shape)
    green[..., 200:] = 0
    source = np.zeros((3, samples))
    source[:, :300] = rng.standard_normal((3, 300))
    full = np.fft.rfft(green)
    windows = np.fft.rfft(source)
    exact = np.fft.irfft(np.einsum("wk,wik->ik", windows, full), samples)
    from scipy.fft import irfft, rfft

    rough = rfft(green.astype(economy.real))
    rough_windows = windows.astype(economy.complex)
    kept = np.zeros((4, samples // 2 + 1), economy.complex)
    for u, g in zip(rough_windows, rough, strict=True):
        kept[:, low:high] += u[low:high] * g[:, low:high]
    largest = economy.largest(economy.squared(rough_windows))
    sizes = SpectrumSizes.of(economy.squared(rough).sum(axis=1), economy, 4)
    coherent = (sizes.norms * largest).sum(axis=0)
    budget = ErrorBudget(samples, 1)
    budget.add(0, economy.block_errors(coherent[None], samples, np.array([3])))
    error = np.linalg.norm(irfft(kept, samples) - exact)
    assert error <= budget.norm() + 1e-13 * np.linalg.norm(exact)
    assert budget.norm() <= 60 * np.sqrt(samples) * max(error, 1e-5 * np.linalg.norm(exact))


def test_bins_that_add_up_to_less_than_the_tolerance_are_dropped_at_both_ends():
    contribution = np.array([1e-9, 1e-9, 1.0, 0.0, 1.0, 1e-9, 1e-9, 1e-9, 1e-9, 1e-9])
    assert choose_bins(contribution, 1e-3) == (2, 5)
    assert choose_bins(contribution, 1e-6) == (0, 10)
    assert choose_bins(np.zeros(10), 0.1) == (0, 10)


@pytest.mark.parametrize("scale", [1.0, 1e-300, 1e300])
def test_norms_neither_over_nor_underflow(scale):
    values = np.array([[3.0, 4.0], [0.0, 0.0]]) * scale
    assert scaled_norm(values[0]) == pytest.approx(5 * scale, rel=1e-12)
    np.testing.assert_allclose(row_norms(values), [5 * scale, 0], rtol=1e-12)


def test_a_relative_bound_is_not_proved_where_the_error_may_be_all_there_is():
    assert relative_bound(0.0, np.array([0.0])) == 0.0
    assert relative_bound(1.0, np.array([1.0])) == float("inf")
    assert relative_bound(1.0, np.array([3.0, 4.0])) == pytest.approx(1 / 4)


@given(
    reach=st.integers(1, 5000),
    span=st.integers(1, 10**6),
    actuators=st.integers(1, 64),
    rows=st.integers(1, 300),
)
@settings(max_examples=60, deadline=None)
def test_a_transform_holds_a_block_and_its_reach(reach, span, actuators, rows):
    samples, hop = choose_fft_samples(reach, span, actuators, np.arange(rows), 1)
    assert hop >= 1
    assert samples >= reach + hop - 1


def test_rows_that_emit_briefly_get_shorter_transforms_than_rows_that_stay():
    brief, _ = choose_fft_samples(2000, 100_000, 20, np.arange(5000) % 1500, 1)
    long, _ = choose_fft_samples(2000, 100_000, 20, np.zeros(1, np.int64), 1)
    assert brief < long
