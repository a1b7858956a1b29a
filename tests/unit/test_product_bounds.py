"""Bounds on what errs in products of spectra, against what does err."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import fft as scipy_fft

from rendering.drive.drive_blocks import DriveBlocks
from rendering.drive.drive_cut import CutDrive
from rendering.drive.omission import Economy
from rendering.drive.row_transforms import RowTransforms
from rendering.drive.upsampling import choose_factor
from rendering.field.product_bounds import SpectrumSizes, drive_units, joint_squares, product_errors


def signals(rng, kind, shape):
    """Signals whose spectra are as unlike as can be: flat, a single peak, few peaks, steep."""
    samples = shape[-1]
    if kind == "noise":
        return rng.standard_normal(shape)
    if kind == "click":
        values = np.zeros(shape)
        values[..., rng.integers(samples)] = rng.standard_normal(shape[:-1])
        return values
    time = np.arange(samples)
    if kind == "tone":
        turns = rng.integers(1, max(2, samples // 2)) / samples
        wave = np.cos(2 * np.pi * turns * time + rng.uniform(0, 6))
        return rng.standard_normal((*shape[:-1], 1)) * wave
    return rng.standard_normal(shape) * np.exp(-time * rng.uniform(0.001, 0.1))


def sizes_of(spectra, economy):
    return SpectrumSizes.of(joint_squares(spectra), economy, spectra.shape[-2])


KINDS = st.sampled_from(["noise", "click", "tone", "decay"])


@given(seed=st.integers(0, 2**31), drive=KINDS, row=KINDS, actuators=st.integers(1, 6), low=st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_what_is_left_out_of_a_block_is_within_its_bound(seed, drive, row, actuators, low):
    rng, length = np.random.default_rng(seed), 240
    economy = Economy.of(length // 2 + 1, low, int(rng.integers(low + 1, length // 2 + 2)))
    greens = scipy_fft.rfft(signals(rng, row, (3, actuators, 100)), length, axis=2)
    blocks = scipy_fft.rfft(signals(rng, drive, (2, actuators, 141)), length, axis=2)
    bounds = product_errors(economy, length, actuators, sizes_of(greens, economy), sizes_of(blocks, economy))
    products = np.einsum("rak,bak->rbk", greens, blocks)
    products[:, :, economy.low : economy.high] = 0
    errors = np.linalg.norm(scipy_fft.irfft(products, length, axis=2), axis=2)
    assert (errors <= bounds * (1 + 1e-9)).all()


@given(seed=st.integers(0, 2**31), kind=KINDS, actuators=st.integers(1, 20), scale=st.sampled_from([1.0, 1e-18]))
@settings(max_examples=40, deadline=None)
def test_sizes_in_single_precision_are_no_smaller_than_they_are(seed, kind, actuators, scale):
    rng = np.random.default_rng(seed)
    spectra = scipy_fft.rfft(scale * signals(rng, kind, (2, actuators, 900)), axis=2).astype(np.complex64)
    economy = Economy.of(451, 20, 130, single=True)
    found = sizes_of(spectra, economy)
    exact = np.sqrt(np.square(np.abs(spectra.astype(np.complex128))).sum(axis=1))
    ends = [*economy.starts[1:].tolist(), 451]
    for segment, (first, last) in enumerate(zip(economy.starts.tolist(), ends, strict=True)):
        assert (found.norms[:, segment] >= np.linalg.norm(exact[:, first:last], axis=1)).all()
        assert (found.largest[:, segment] >= exact[:, first:last].max(axis=1)).all()
    assert (found.norms[:, -1] >= np.linalg.norm(exact, axis=1)).all()
    np.testing.assert_allclose(found.largest[:, -1], exact.max(axis=1), rtol=0.01, atol=1e-17)


@given(seed=st.integers(0, 2**31), kind=KINDS, length=st.sampled_from([96, 1000, 8640, 30720]))
@settings(max_examples=40, deadline=None)
def test_a_transform_in_single_precision_errs_by_less_than_said(seed, kind, length):
    values = signals(np.random.default_rng(seed), kind, (2, length))
    exact = scipy_fft.rfft(values, axis=1)
    error = scipy_fft.rfft(values.astype(np.float32), axis=1) - exact
    economy = Economy.of(length // 2 + 1, single=True)
    assert (np.linalg.norm(error, axis=1) <= drive_units(length, economy) * np.linalg.norm(exact, axis=1)).all()


@given(
    seed=st.integers(0, 2**31),
    drive=KINDS,
    row=KINDS,
    actuators=st.integers(1, 9),
    samples=st.sampled_from([30, 700, 2500]),
    share=st.sampled_from([0.1, 0.35, 1.0]),
    exponent=st.sampled_from([0, 15, -400]),
    double=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_convolved_rows_are_within_their_bounds(seed, drive, row, actuators, samples, share, exponent, double):
    rng, taps, length = np.random.default_rng(seed), 101, 480
    volts, greens = signals(rng, drive, (actuators, samples)), signals(rng, row, (3, actuators, taps))
    expected = np.array([sum(np.convolve(g, v) for g, v in zip(green, volts, strict=True)) for green in greens])
    high = int(share * (length // 2 + 1))
    economy = Economy.of(length // 2 + 1, 0, high, single=True)
    factor = choose_factor(length, high)
    rows = RowTransforms.empty(3, actuators, economy)
    spectra = scipy_fft.rfft(greens.astype(np.float32), length, axis=2)
    rows.kept[:] = spectra[:, :, :high].transpose(0, 2, 1)
    sizes = sizes_of(spectra, economy)
    rows.sizes.norms[:], rows.sizes.largest[:] = sizes.norms, sizes.largest
    cut = CutDrive(volts * 2.0**exponent, exponent)
    blocks = DriveBlocks(cut, taps, length, 336, economy, 40, factor, bounded=True, double=double)
    found, errors, energies = blocks.convolve(rows, np.ones(3))
    assert (np.linalg.norm(found - expected, axis=1) <= errors + 1e-12).all()
    np.testing.assert_allclose(energies, np.square(found.astype(float)).sum(axis=1), rtol=1e-4)
    # Bounds of what is computed whole are those of rounding: some parts in ten thousand of what is put in.
    put_in = np.linalg.norm(greens, axis=2) @ np.linalg.norm(volts, axis=1)
    assert share < 1.0 or (errors <= 3e-3 * np.sqrt(length) * put_in + 1e-12).all()


def test_blocks_tell_a_drive_that_is_not_of_size_one():
    rng = np.random.default_rng(0)
    economy = Economy.of(241, 0, 80, single=True)
    volts = rng.standard_normal((2, 900)) / 30.0

    def plain(values):
        return DriveBlocks(CutDrive(values, 0), 101, 480, 336, economy, 40, bounded=True, double=False).plain

    assert plain(volts)
    for bad in (1e9, 1e60, np.inf, np.nan):
        volts[1, 37] = bad
        assert not plain(volts)


@pytest.mark.parametrize("actuators", [1, 3, 4, 7, 12])
@pytest.mark.parametrize("blocks", [1, 2, 3])
def test_every_actuator_of_every_block_is_transformed(actuators, blocks):
    rng = np.random.default_rng(0)
    volts = rng.standard_normal((actuators, 336 * blocks))
    greens = rng.standard_normal((1, actuators, 101))
    economy = Economy.of(241, single=True)
    rows = RowTransforms.empty(1, actuators, economy)
    rows.kept[:] = scipy_fft.rfft(greens, 480, axis=2).transpose(0, 2, 1)
    found, _, _ = DriveBlocks(CutDrive(volts, 0), 101, 480, 336, economy, double=False).convolve(rows, np.ones(1))
    expected = sum(np.convolve(g, v) for g, v in zip(greens[0], volts, strict=True))
    np.testing.assert_allclose(found[0], expected, atol=1e-5 * np.abs(expected).max())
