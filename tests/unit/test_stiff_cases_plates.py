"""Rows of the table of stiff and extreme cases that the plates themselves can meet."""

import numpy as np
import pytest

from wavefocus.benchmarks.plate import ExactPlate, ThinPlate, TimeStepper, explicit_limit_s
from wavefocus.mocks.plates.soft import SOFT_PLATE, mean_hankel

GLASS = ThinPlate(0.24, 0.16, 1.566)
"""Glass of 1 mm: 70 GPa, 0.22, 2500 kg/m^3."""


def test_rows_28_and_30_a_position_on_an_actuator_has_the_disc_s_finite_response():
    """H0 itself is infinite at r = 0; its mean over the magnet is not, and does not jump on the way there."""
    frequency_hz = np.array([20.0, 250.0, 500.0])
    on = SOFT_PLATE.velocity(frequency_hz, 0.0)
    assert np.isfinite(on).all()
    near = SOFT_PLATE.velocity(frequency_hz, 1e-6)
    np.testing.assert_allclose(near, on, rtol=1e-9)
    k, a = SOFT_PLATE.wavenumber(250.0), 0.0025
    edge = [mean_hankel(k, a * (1.0 + side * 1e-9), a) for side in (-1, 1)]
    assert edge[0] == pytest.approx(edge[1], rel=1e-6)


def test_row_29_a_growing_wave_is_refused():
    k = SOFT_PLATE.wavenumber(250.0)
    assert np.isfinite(mean_hankel(k, 0.01, 0.0025))
    with pytest.raises(ValueError, match=r"imaginary part of 4\d\.\d+ rad/m; it must not be positive, .* grow"):
        mean_hankel(np.conj(k), 0.01, 0.0025)


def test_row_31_time_stepping_beyond_its_limit_is_refused_and_within_it_true():
    limit_s = explicit_limit_s(GLASS, 0.008)
    assert limit_s == pytest.approx(10.2e-6, rel=0.01)  # notes/plates.md
    assert explicit_limit_s(GLASS, 0.004) == pytest.approx(2.55e-6, rel=0.01)
    with pytest.raises(ValueError, match=rf"at most spacing\^2 / \(4 kappa\) = {limit_s:.4g} s"):
        TimeStepper(GLASS, 0.008, 1.01 * limit_s, beta=0.0)
    plate = TimeStepper(GLASS, 0.008, limit_s, beta=0.0)
    rough = np.random.default_rng(0).standard_normal(len(plate.points_m))
    assert np.abs(plate.released(rough, 2000)).max() < 1e4 * np.abs(rough).max()
    found_hz = ringing_hz(TimeStepper(GLASS, 0.008, 0.9 * limit_s, beta=0.0), 1, 1, 4000)
    assert found_hz == pytest.approx(float(GLASS.mode_hz(1, 1)), rel=2e-3)


@pytest.mark.parametrize("mode", [(3, 2), (5, 3)])
def test_row_32_newmark_is_stable_and_its_dispersion_is_reported(mode, record_property):
    """0.1 ms is 10 times the explicit limit; modes ring too low by what `frequency_error` says."""
    true_hz = grid_mode_hz(0.008, *mode)
    for step_s in (1e-4, 2e-5):
        plate = TimeStepper(GLASS, 0.008, step_s, beta=0.25)
        found_hz = ringing_hz(plate, *mode, 600)
        told = float(plate.frequency_error(true_hz))
        assert told < 0
        assert found_hz / true_hz - 1.0 == pytest.approx(told, rel=0.05)
    # notes/plates.md, for 0.1 ms.
    told = TimeStepper(GLASS, 0.02, 1e-4, beta=0.25).frequency_error([250.0, 500.0])
    record_property("measured", f"{100 * told[1]:.2g} % at 500 Hz, reported")
    np.testing.assert_allclose(told, [-0.002, -0.008], atol=3e-4)


def test_modal_exponentials_stay_on_the_closed_form_at_a_quality_of_ten_thousand(record_property):
    points_m, sources_m = np.array([[0.07, 0.05], [0.2, 0.1]]), np.array([[0.1, 0.06]])
    rate_hz, band_hz, steps = 10_000.0, (0.0, 4000.0), 20_000
    impulse = np.zeros((1, steps))
    impulse[0, 0] = 1.0
    stepped = ExactPlate(GLASS, points_m, sources_m, 1 / rate_hz, quality=1e4, band_hz=band_hz).driven(impulse)
    exact = GLASS.impulse_velocity(points_m, sources_m, steps, rate_hz, quality=1e4, band_hz=band_hz)[:, 0]
    error = np.abs(stepped - exact).max() / np.abs(exact).max()
    record_property("measured", f"{error:.1g}")
    assert error < 1e-10


def grid_mode_hz(spacing_m, across, along):
    """Frequency of a mode on a square grid, exact in time: sin(kh / 2) stands for kh / 2, along x and along y."""
    wavenumbers = np.pi * np.array([across / GLASS.length_m, along / GLASS.width_m])
    return GLASS.kappa_m2_s * np.square(2.0 / spacing_m * np.sin(wavenumbers * spacing_m / 2.0)).sum() / (2.0 * np.pi)


def ringing_hz(plate, across, along, steps):
    """Frequency at which a mode rings that is let go: its phase at the last zero crossing over the time."""
    shape = GLASS.shape(across, along, plate.points_m)
    along_shape = plate.released(shape, steps) @ shape / (shape @ shape)
    crossings = np.flatnonzero(np.diff(np.sign(along_shape)) != 0)
    first, last = (c + along_shape[c] / (along_shape[c] - along_shape[c + 1]) for c in (crossings[0], crossings[-1]))
    return 0.5 * (len(crossings) - 1) / ((last - first) * plate.step_s)
