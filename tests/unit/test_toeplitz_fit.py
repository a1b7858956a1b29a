"""Conjugate gradients against direct solvers, and against the truth at sizes that no matrix reaches."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from wavefocus.calibration.estimator.causal_fit import (
    CausalFit,
    ToeplitzFit,
    circulant_inverse,
    conjugate_gradients,
    toeplitz_product,
)
from wavefocus.calibration.numerics import fourier_sum

PERIOD = 3000
BINS = np.arange(30, 700)
OMEGA = 2 * np.pi * BINS / PERIOD
FLAT = np.ones(BINS.size)


def spectra(green, bins=BINS, period=PERIOD, ratio=1.0):
    return np.stack([fourier_sum(one, 2 * np.pi * ratio / period, int(bins[0]), bins.size) for one in green])


def responses(rows, taps, seed=0):
    draw = np.random.default_rng(seed)
    return draw.standard_normal((rows, taps)) * np.exp(-np.arange(taps) / (taps / 5))


def noisy(clean, power, period, snr_db, seed=1):
    """White noise on the response, as the fit weighs it."""
    weight = np.sqrt(2 * power / period)
    draw = np.random.default_rng(seed)
    noise = draw.standard_normal(clean.shape) + 1j * draw.standard_normal(clean.shape)
    level = np.sqrt((np.abs(clean * weight) ** 2).mean(axis=1, keepdims=True) / 2) * 10 ** (-snr_db / 20)
    return (clean + level * noise / weight).astype(np.complex64)


def error_db(found, truth, ratio=1.0, **where):
    wrong, right = spectra(found - truth, ratio=ratio, **where), spectra(truth, ratio=ratio, **where)
    return 10 * np.log10((np.abs(wrong) ** 2).sum(axis=1) / (np.abs(right) ** 2).sum(axis=1))


def test_given_a_toeplitz_matrix_then_conjugate_gradients_agree_with_levinson():
    taps = 300
    kernel = (np.cos(np.outer(np.arange(taps), OMEGA)) @ FLAT) * 2 / PERIOD
    wanted = toeplitz_product(kernel)(responses(1, taps)[0])
    ridge = 1e-4
    direct = scipy.linalg.solve_toeplitz(kernel + ridge * (np.arange(taps) == 0), wanted)
    found = conjugate_gradients(
        toeplitz_product(kernel), wanted, ridge, circulant_inverse(kernel, ridge), np.zeros(taps)
    )
    assert np.abs(found - direct).max() < 1e-3 * np.abs(direct).max()


@pytest.mark.parametrize("ppm", [0.0, 200.0])
def test_given_a_small_size_then_it_is_as_near_to_the_truth_as_the_dense_fit(ppm):
    taps, ratio = 400, 1 + 1e-6 * ppm
    truth = responses(6, taps)
    data = noisy(spectra(truth, ratio=ratio), FLAT, PERIOD, 40.0)
    skew = np.full(len(truth), ratio - 1)
    dense = CausalFit(OMEGA, FLAT, PERIOD, taps, 1e-6, 500.0)
    free = ToeplitzFit(OMEGA, FLAT, PERIOD, taps, 1e-6)
    with_matrix, without = dense.solve(data, skew), free.solve(data, skew)
    assert np.median(error_db(without.green, truth, ratio) - error_db(with_matrix.green, truth, ratio)) < 0.3
    assert without.left == pytest.approx(with_matrix.left, rel=0.05)
    assert free.rank == pytest.approx(dense.rank, rel=0.1)


@pytest.mark.parametrize(("sweep", "limit_db"), [("linear", 0.3), ("exponential", 1.0)])
def test_48_khz_and_12000_taps_then_the_noise_s_limit_is_reached_without_a_matrix(sweep, limit_db):
    period, taps, ratio = 156_960, 12_000, 1 + 37e-6
    bins = np.arange(66, 65_400)
    power = np.ones(bins.size) if sweep == "linear" else bins.mean() / bins
    truth = responses(1, taps)
    clean = spectra(truth, bins, period, ratio)
    fit = ToeplitzFit(2 * np.pi * bins / period, power, period, taps, 1e-6)
    found = fit.solve(noisy(clean, power, period, 40.0), np.array([ratio - 1]))
    # White noise with the share of the spectrum that is left by taps out of a period, each bin by its power.
    share = taps / period * np.mean((np.abs(clean) ** 2 * power).mean() / power) / (np.abs(clean) ** 2).mean()
    expected = -40.0 + 10 * np.log10(share)
    assert error_db(found.green, truth, ratio, bins=bins, period=period)[0] < expected + limit_db


def test_given_no_noise_then_the_filter_comes_back():
    taps = 400
    truth = responses(2, taps)
    found = ToeplitzFit(OMEGA, FLAT, PERIOD, taps, 1e-6).solve(spectra(truth).astype(np.complex64), np.zeros(2))
    assert error_db(found.green, truth).max() < -70


def test_given_noise_alone_then_little_comes_of_it():
    draw = np.random.default_rng(3)
    noise = (draw.standard_normal((1, BINS.size)) + 1j * draw.standard_normal((1, BINS.size))).astype(np.complex64)
    found = ToeplitzFit(OMEGA, FLAT, PERIOD, 400, 1e-6).solve(noise, np.zeros(1))
    assert found.left[0] == pytest.approx(found.whole[0] * (1 - 400 / PERIOD), rel=0.2)
    assert np.isfinite(found.green).all()
