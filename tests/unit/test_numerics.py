"""Small numerical tools against plain evaluations of their definitions."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal

from wavefocus.calibration.numerics import (
    evenly_spread,
    fourier_sum,
    on_a_line,
    parabola_vertex,
    transform_at,
)


@pytest.mark.parametrize(("at", "curve"), [(0.3, -2.0), (-0.49, -0.01), (0.0, -1e6)])
def test_given_three_values_of_a_parabola_then_its_top_is_found(at, curve):
    values = [curve * (place - at) ** 2 + 7.0 for place in (-1, 0, 1)]
    assert parabola_vertex(*values) == pytest.approx(at, abs=1e-9)
    columns = [np.array([value, value]) for value in values]
    np.testing.assert_allclose(parabola_vertex(*columns), at, atol=1e-9)


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 2.0)])
def test_given_values_without_a_top_then_the_middle_one_stands(values):
    assert parabola_vertex(*values) == 0.0


@pytest.mark.parametrize(("count", "most", "last"), [(1, 5, 0), (5, 9, 4), (100, 7, 99), (7, 1, 0)])
def test_given_a_count_then_indices_are_different_ascending_and_reach_the_ends(count, most, last):
    chosen = evenly_spread(count, most)
    assert chosen[0] == 0
    assert chosen[-1] == last
    assert len(chosen) == min(count, most)
    assert (np.diff(chosen) > 0).all()


def test_given_a_signal_then_its_sum_at_evenly_spaced_frequencies_is_that_of_scipy():
    signal = np.random.default_rng(0).standard_normal((2, 300))
    turn = 2 * np.pi / 517.3
    expected = scipy.signal.zoom_fft(signal, [9 * turn, 109 * turn], 100, fs=2 * np.pi)
    np.testing.assert_allclose(fourier_sum(signal, turn, 9, 100), expected, atol=1e-10)


@pytest.mark.parametrize(("dtype", "error"), [(np.float32, 1e-6), (np.float64, 1e-13)])
@pytest.mark.parametrize("frequency_hz", [np.array([3.0, 41.7]), np.array([3.0 + 1.5j, 41.7 - 2j])])
def test_given_rows_then_their_transform_is_the_sum_of_its_definition(dtype, error, frequency_hz):
    rows = np.random.default_rng(0).standard_normal((2, 3, 200)).astype(dtype)
    # exp(-2 pi j f n / rate), the growing part with the sign of the imaginary part
    kernel = np.exp(-2j * np.pi * np.outer(np.arange(200), frequency_hz) / 1000.0)
    found = transform_at(rows, frequency_hz, 1000.0)
    assert found.dtype == np.result_type(dtype, np.complex64)
    np.testing.assert_allclose(found, rows.astype(float) @ kernel, rtol=0, atol=error * 200 * 10)


def test_given_points_then_only_those_on_a_line_are_on_one():
    along = np.arange(10.0)[:, None] * [0.6, 0.8] + [5.0, -3.0]
    assert on_a_line(along)
    assert on_a_line(along[:1])
    assert not on_a_line(along + [[0.0, 0.01 * (n % 2)] for n in range(10)], share=1e-4)
