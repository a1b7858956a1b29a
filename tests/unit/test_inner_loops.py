"""The compiled loops do what numpy does, up to rounding that the proofs allow for."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import fft as scipy_fft

from rendering.drive.omission import TRANSFORM
from rendering.inner_loops import (
    VARIABLE,
    InnerLoops,
    RowTransform,
    Runs,
    TransformBack,
    WindowTransform,
    inner_loops,
    transformable,
)

UNIT = 2.0**-24


@pytest.fixture
def loops() -> InnerLoops:
    found = inner_loops()
    # `make test` brings a compiler.
    assert found is not None
    return found


lengths = st.sampled_from([2, 4, 6, 24, 30, 48, 72, 120, 150, 240, 360, 480, 600, 1000, 1944, 2592, 3600])


def addresses(arrays: np.ndarray) -> np.ndarray:
    return np.array([one.ctypes.data for one in arrays], dtype=np.uintp)


def allowed(length: int, norm: float) -> float:
    """What a transform may err by, as the bounds on renders have it."""
    return TRANSFORM * np.log2(length) * UNIT * norm


@given(
    length=lengths,
    heard=st.integers(1, 21),
    share=st.floats(0.01, 1.0),
    low=st.floats(0.0, 1.0),
    conjugate=st.booleans(),
    exponent=st.integers(-20, 20),
    seed=st.integers(0, 2**16),
)
def test_given_any_rows_then_their_transforms_are_within_the_bound(
    length, heard, share, low, conjugate, exponent, seed
):
    loops = inner_loops()
    rng = np.random.default_rng(seed)
    taps = max(1, int(rng.integers(1, length + 1)))
    used, bins = max(1, round(share * taps)), length // 2 + 1
    rows = rng.standard_normal((3, heard + 2, taps)).astype(np.float32)
    actuators = np.sort(rng.permutation(heard + 2)[:heard])
    first = min(round(low * bins), bins - 1)
    last = int(rng.integers(first + 1, bins + 1))
    transform = RowTransform(taps, used, actuators, length, first, last, conjugate=conjugate)
    kept = np.full((3, last - first, heard), np.nan, dtype=np.complex64)
    scales = np.full(3, np.ldexp(1.0, exponent), dtype=np.float32)
    squares = loops.transform(transform, list(rows), scales, addresses(kept))
    expected = scipy_fft.rfft(np.ldexp(rows[:, actuators, :used].astype(np.float64), exponent), length, axis=2)
    wanted = expected.conj() if conjugate else expected
    error = np.linalg.norm(kept - wanted[:, :, first:last].transpose(0, 2, 1), axis=1)
    norms = np.linalg.norm(expected, axis=2) + np.abs(expected).max(axis=2)
    assert (error <= allowed(length, np.sqrt(2.0)) * norms + 1e-30).all()
    exact = np.square(np.abs(expected)).sum(axis=1)
    assert squares.shape == (3, bins)
    slack = 2.0 * allowed(length, 1.0) * np.sqrt(exact * exact.sum(axis=1, keepdims=True)) + 1e-5 * exact
    assert (np.abs(squares - exact) <= slack + 1e-30).all()


@given(
    length=lengths,
    actuators=st.integers(1, 21),
    blocks=st.integers(1, 6),
    seed=st.integers(0, 2**16),
)
def test_given_any_rows_and_windows_then_blocks_are_their_sums_in_time(length, actuators, blocks, seed):
    loops = inner_loops()
    rng = np.random.default_rng(seed)
    bins = length // 2 + 1
    low = int(rng.integers(0, bins))
    high = int(rng.integers(low + 1, bins + 1))

    def complex_normal(*shape: int) -> np.ndarray:
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)

    spectra, turn = complex_normal(7, high - low, actuators), complex_normal(high - low)
    turn /= np.abs(turn)
    bounds = np.append(0, np.cumsum(rng.integers(0, 5, blocks)))
    of_row = rng.integers(0, 7, bounds[-1])
    windows = complex_normal(bounds[-1], high - low)
    out = np.full((blocks, actuators, length), np.nan, dtype=np.float32)
    back = TransformBack(actuators, length, low, high, turn)
    energies = loops.blocks(back, addresses(spectra)[of_row], windows, bounds, out)
    whole, coherent = np.zeros((blocks, bins, actuators), dtype=np.complex128), np.zeros(blocks)
    for block in range(blocks):
        for row in range(bounds[block], bounds[block + 1]):
            product = windows[row][:, None].astype(np.complex128) * spectra[of_row[row]] * turn[:, None]
            whole[block, low:high] += product
            coherent[block] += np.linalg.norm(product)
    expected = scipy_fft.irfft(whole.transpose(0, 2, 1), length, axis=2)
    errors = np.linalg.norm(out - expected, axis=(1, 2))
    rounding = (TRANSFORM * np.log2(length) + np.diff(bounds) + 20) * UNIT
    assert (errors <= rounding * coherent * np.sqrt(2.0 / length)).all()
    exact = np.square(out.astype(np.float64)).sum(axis=(1, 2))
    np.testing.assert_allclose(energies, exact, rtol=length * 2 * UNIT)
    silent = np.diff(bounds) == 0
    assert not out[silent].any()
    assert not energies[silent].any()


@given(length=st.sampled_from([24, 120, 360, 600, 2592]), count=st.integers(1, 20), seed=st.integers(0, 2**16))
def test_given_any_runs_then_windows_are_transformed_and_measured_within_the_bound(length, count, seed):
    loops = inner_loops()
    rng = np.random.default_rng(seed)
    bins = length // 2 + 1
    values = rng.standard_normal(50)
    begin, start, number, bounds, dense = [], [], [], [], np.zeros((count, length))
    for _ in range(count):
        bounds.append([len(begin), len(begin)])
        at = 0
        while at < length and rng.uniform() < 0.7:
            at += int(rng.integers(0, length // 2))
            samples = min(int(rng.integers(1, 20)), length - at)
            if samples > 0:
                begin.append(int(rng.integers(0, len(values) - samples)))
                start.append(at)
                number.append(samples)
                bounds[-1][1] += 1
                at += samples
    factor = rng.uniform(-3.0, 3.0, len(begin))
    for window, (first, last) in enumerate(bounds):
        for run in range(first, last):
            where = slice(start[run], start[run] + number[run])
            dense[window, where] = np.float32(values[begin[run] : begin[run] + number[run]] * factor[run])
    low = int(rng.integers(0, bins))
    high = int(rng.integers(low + 1, bins + 1))
    starts = np.unique(np.append(0, rng.integers(0, bins, 5)))
    band = slice(*sorted(rng.integers(0, bins + 1, 2).tolist()))
    runs = Runs(values, *(np.array(one, dtype=np.int64) for one in (begin, start, number)), factor)
    kept = np.full((count, high - low), np.nan, dtype=np.complex64)
    largest, energies = np.full((count, len(starts)), np.nan, dtype=np.float32), np.full((count, 3), np.nan)
    loops.windows(WindowTransform(runs, length, low, high, starts, band), np.array(bounds), kept, largest, energies)
    expected = scipy_fft.rfft(dense, axis=1)
    norms = np.linalg.norm(dense, axis=1)
    bound = allowed(length, np.sqrt(length / 2.0)) * norms
    assert (np.linalg.norm(kept - expected[:, low:high], axis=1) <= np.sqrt(2.0) * bound).all()
    peaks = np.maximum.reduceat(np.abs(expected), starts, axis=1)
    assert (np.abs(np.sqrt(largest) - peaks) <= 2.0 * bound[:, None] + 1e-6 * peaks).all()
    squares = np.square(np.abs(expected))
    np.testing.assert_allclose(energies[:, 0], norms**2, rtol=1e-12)
    scale = squares.sum(axis=1).max(initial=1.0)
    np.testing.assert_allclose(energies[:, 1], squares[:, band].sum(axis=1), rtol=1e-4, atol=1e-5 * scale)
    np.testing.assert_allclose(energies[:, 2], squares.sum(axis=1), rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize("taps", [1, 15, 16, 17, 100])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_a_look_at_rows_tells_their_largest_and_smallest_values_and_their_energies(loops, taps, share):
    rows = np.random.default_rng(taps).standard_normal((4, 3, taps)).astype(np.float32)
    rows[1, :, ::2] = 0.0
    used = round(share * taps)
    largest, smallest, energies = loops.look(list(rows), used)
    magnitudes = np.abs(rows)
    np.testing.assert_array_equal(largest, magnitudes.max(axis=(1, 2)))
    least = np.where(magnitudes > 0, magnitudes, np.inf).min(axis=(1, 2))
    np.testing.assert_array_equal(smallest, np.where(np.isfinite(least), least, np.nan))
    squares = np.square(rows.astype(np.float64))
    np.testing.assert_allclose(energies[:, 0], squares[:, :, :used].sum(axis=2), rtol=1e-14)
    np.testing.assert_allclose(energies[:, 1], squares[:, :, used:].sum(axis=2), rtol=1e-14)


def test_a_look_at_rows_tells_silence_denormals_and_what_is_not_finite(loops):
    rows = np.ones((5, 2, 40), dtype=np.float32)
    rows[0] = 0.0
    rows[1, 1, 39], rows[2, 0, 0], rows[3, 1, 16], rows[4, 0, 17] = np.nan, -np.inf, 1e-40, -0.0
    largest, smallest, energies = loops.look(list(rows), 40)
    assert largest[0] == 0.0
    assert np.isnan(smallest[0])
    assert not energies[0].any()
    assert np.isnan(largest[1])
    assert largest[2] == np.inf
    assert smallest[3] == np.float32(1e-40)
    assert smallest[4] == largest[4] == 1.0


@pytest.mark.parametrize("samples", [0, 1, 15, 16, 33, 1000])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scaled_signals_are_multiplied_in_double_precision_and_measured(loops, samples, dtype):
    rng = np.random.default_rng(samples)
    signals = rng.standard_normal((3, 1200)).astype(dtype)[:, 7 : 7 + samples]
    room = np.full((3, 2000), 5.0)
    energies = loops.scale(signals, 2.0**-31, room[:, 11 : 11 + samples])
    expected = signals.astype(np.float64) * 2.0**-31
    np.testing.assert_array_equal(room[:, 11 : 11 + samples], expected)
    assert (room[:, :11] == 5.0).all()
    assert (room[:, 11 + samples :] == 5.0).all()
    np.testing.assert_allclose(energies, np.square(expected).sum(axis=1), rtol=1e-14)


@given(bins=st.integers(1, 200), actuators=st.integers(1, 21), groups=st.integers(1, 6), seed=st.integers(0, 2**16))
def test_given_any_rows_in_double_precision_then_groups_of_them_are_summed(bins, actuators, groups, seed):
    rng = np.random.default_rng(seed)

    def complex_normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    spectra, turn = complex_normal(5, bins, actuators), complex_normal(bins)
    bounds = np.append(0, np.cumsum(rng.integers(0, 4, groups)))
    of_row, windows = rng.integers(0, 5, bounds[-1]), complex_normal(bounds[-1], bins)
    room = np.full((groups, bins + 3, actuators), 7j)
    out = room[:, 2:-1]
    inner_loops().sum(addresses(spectra)[of_row], windows, bounds, turn, out)
    for group, found in enumerate(out):
        some = range(bounds[group], bounds[group + 1])
        products = [(windows[n] * turn)[:, None] * spectra[of_row[n]] for n in some]
        np.testing.assert_allclose(
            found, np.sum(products, axis=0) if products else found * 0 + 7j, rtol=1e-12, atol=1e-12
        )
    assert (room[:, :2] == 7j).all()
    assert (room[:, -1] == 7j).all()


@pytest.mark.parametrize(("length", "possible"), [(2, True), (3600, True), (3601, False), (22, False), (2 * 49, False)])
def test_lengths_without_a_factor_that_is_not_known_can_be_transformed(length, possible):
    assert transformable(length) == possible


def test_given_that_numpy_is_asked_for_then_there_are_no_compiled_loops():
    told = subprocess.run(
        [sys.executable, "-c", "from rendering.inner_loops import inner_loops; print(inner_loops())"],
        env={**os.environ, VARIABLE: "numpy"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout.strip() == "None"
