from __future__ import annotations

from inspect import signature
from typing import get_args

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import hankel2

from tests.unit.wave_travel import impulse_travel
from wavefocus.config.plate import PlateKeys
from wavefocus.mocks.plates import PLATES
from wavefocus.mocks.plates.infinite import PlateTable
from wavefocus.mocks.plates.soft import (
    SOFT_PLATE,
    SPRINGPOT_PLATE,
    DampedWave,
    SpringpotWave,
    mean_hankel,
)
from wavefocus.mocks.virtual.settings import MirrorGeometry
from wavefocus.mocks.virtual.synthesis import chain_response

STEP_HZ = 5.0
FREQUENCY_HZ = STEP_HZ * np.arange(1001)
TABLE = PlateTable(SOFT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128))


def test_given_the_soft_plate_then_an_impulse_travels_as_the_paper_measured():
    """Group velocity and attenuation of band-limited impulses, section IV.A."""
    travel = impulse_travel(SOFT_PLATE, (50.0, 450.0))
    assert travel.group_velocity_m_s == pytest.approx(4.8, rel=1e-9)
    assert travel.attenuation_db_per_cm == pytest.approx(3.8, rel=1e-9)


def test_with_the_springpot_an_impulse_travels_as_the_paper_measured():
    travel = impulse_travel(SPRINGPOT_PLATE, (50.0, 450.0))
    assert travel.group_velocity_m_s == pytest.approx(4.8, rel=1e-6)
    assert travel.attenuation_db_per_cm == pytest.approx(3.8, rel=1e-6)
    loss = -SPRINGPOT_PLATE.wavenumber([50.0, 250.0, 450.0]).imag * 20 / np.log(10) / 100
    assert loss == pytest.approx([2.0, 7.7, 12.5], abs=0.1)


def test_given_a_springpot_without_loss_then_it_is_the_wave_without_damping():
    elastic, plain = SpringpotWave(4.8, 0.0), DampedWave(4.8, 0.0)
    frequency_hz = np.array([0.0, 30.0, 250.0, 900.0])
    for radius_mm in (1.0, 10.0, 90.0):
        expected = plain.velocity(frequency_hz, radius_mm)
        assert elastic.kernels(frequency_hz, radius_mm, 2.5)[0] == pytest.approx(expected, rel=1e-12)


def test_springpot_then_its_response_is_causal_and_table_is_within_1e_minus_7():
    # Its tail falls as a power of time, so it needs 20 s not to wrap.
    frequency_hz = np.fft.rfftfreq(200_000, 1e-4)
    kernel = SPRINGPOT_PLATE.kernels(frequency_hz, 40.0, 2.5)[0] * np.exp(-((frequency_hz / 800.0) ** 2))
    response = np.fft.irfft(kernel)
    assert np.square(response[-1000:]).sum() < 1e-8 * np.square(response).sum()
    table = PlateTable(SPRINGPOT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128))
    expected = SPRINGPOT_PLATE.kernels(FREQUENCY_HZ, 33.0, 2.5)[0]
    assert np.abs(table.evaluate(np.array([33.0]))[0] - expected).max() < 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize("wave", [lambda: SpringpotWave(0.0, 0.1), lambda: SpringpotWave(4.8, -0.1)])
def test_given_a_springpot_that_cannot_be_then_it_is_refused(wave):
    with pytest.raises(ValueError, match="must be"):
        wave()


def test_given_a_simulated_impulse_then_its_energy_travels_at_the_group_velocity():
    # The same definition by a time-domain route: waveforms at two places, centroids of their energy.
    frequency_hz = np.fft.rfftfreq(20_000, 1e-4)
    band = (frequency_hz >= 50) & (frequency_hz <= 450)
    time_s = 1e-4 * np.arange(20_000)
    centroids, energies = [], []
    for distance_m in (0.010, 0.050):
        lag = np.exp(-1j * SOFT_PLATE.wavenumber(frequency_hz) * distance_m - 2j * np.pi * frequency_hz)
        energy = np.fft.irfft(np.where(band, lag, 0)) ** 2
        energies.append(energy.sum())
        centroids.append(np.average(time_s, weights=energy))
    assert 0.040 / (centroids[1] - centroids[0]) == pytest.approx(4.8, rel=2e-3)
    assert 10 * np.log10(energies[0] / energies[1]) / 4.0 == pytest.approx(3.8, rel=2e-3)


def test_given_single_frequencies_then_the_loss_is_that_of_the_notes():
    # notes/plates.md: 3.3 / 3.8 / 3.8 dB/cm at 50 / 250 / 450 Hz
    loss = -SOFT_PLATE.wavenumber([50.0, 250.0, 450.0]).imag * 20 / np.log(10) / 100
    assert loss == pytest.approx([3.3, 3.8, 3.8], abs=0.1)


def test_given_a_point_far_from_the_disc_then_the_wave_goes_outward_and_decays():
    radius_mm = np.linspace(20, 120, 201)
    wave = SOFT_PLATE.velocity(250.0, radius_mm)
    assert np.all(np.diff(np.unwrap(np.angle(wave))) < 0)
    assert np.all(np.diff(np.abs(wave)) < 0)


@pytest.mark.parametrize("radius_mm", [0.0, 1.0, 2.4, 2.6, 8.0])
def test_given_any_distance_then_the_mean_is_that_of_the_disc(radius_mm):
    k = SOFT_PLATE.wavenumber(250.0)
    # Quadrature over the disc in polar coordinates about the observer, where r dr tames the logarithm.
    angle = (np.arange(20_000) + 0.5) * 2 * np.pi / 20_000
    a = 2.5
    root = np.sqrt(np.maximum(a**2 - (radius_mm * np.sin(angle)) ** 2, 0.0))
    hit = (np.abs(radius_mm * np.sin(angle)) < a) & (radius_mm * np.cos(angle) + root > 0)
    near = np.maximum(radius_mm * np.cos(angle) - root, 0.0)[hit]
    far = (radius_mm * np.cos(angle) + root)[hit]
    integral = (_ring(k, far) - _ring(k, near)).sum() * 2 * np.pi / 20_000
    expected = integral / (np.pi * (a / 1e3) ** 2)
    assert mean_hankel(k, radius_mm / 1e3, a / 1e3) == pytest.approx(expected, rel=2e-4)


def _ring(k, s_mm):
    """Integral of H0(2)(k s) s from 0 to s."""
    z = k * np.maximum(s_mm, 1e-9) / 1e3
    return (z * hankel2(1, z) - 2j / np.pi) / k**2


@settings(max_examples=60, deadline=None)
@given(st.floats(0.0, 400.0))
def test_given_any_distance_then_the_table_is_within_1e_minus_7(radius_mm):
    direct = SOFT_PLATE.velocity(FREQUENCY_HZ[1:], radius_mm)
    error = TABLE.evaluate(np.array([radius_mm]))[0, 1:] - direct
    assert np.max(np.abs(error) / np.abs(direct)) < 1e-8


def test_given_single_precision_then_the_table_keeps_100_db():
    table = PlateTable(SOFT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128), single=True)
    radius_mm = np.linspace(2.5, 300, 57)
    direct = SOFT_PLATE.velocity(FREQUENCY_HZ, radius_mm[:, None])
    error = table.evaluate(radius_mm) - direct
    assert table.evaluate(radius_mm).dtype == np.complex64
    assert np.max(np.abs(error)[:, 1:] / np.abs(direct)[:, 1:]) < 1e-5


def test_given_no_frequency_then_nothing_moves():
    assert SOFT_PLATE.velocity(0.0, 10.0) == 0
    assert chain_response(np.array([0.0])) == pytest.approx(0)


@pytest.mark.parametrize(("speed_m_s", "damping_per_s"), [(0.0, 1.0), (-4.8, 1.0), (np.nan, 1.0)])
def test_given_a_speed_that_is_not_positive_then_it_is_named(speed_m_s, damping_per_s):
    with pytest.raises(ValueError, match="speed_m_s"):
        DampedWave(speed_m_s, damping_per_s)


def test_given_a_damping_that_feeds_the_wave_then_it_is_refused():
    with pytest.raises(ValueError, match=r"damping_per_s is -1.*grow"):
        DampedWave(4.8, -1.0)


def test_given_a_growing_wave_or_a_negative_radius_then_it_is_refused():
    with pytest.raises(ValueError, match=r"imaginary part of 1.*grow"):
        mean_hankel(100 + 1j, 0.01, 0.0025)
    with pytest.raises(ValueError, match=r"radius is -0\.01 m"):
        mean_hankel(100 - 1j, -0.01, 0.0025)


def test_given_a_source_without_size_then_it_is_refused():
    with pytest.raises(ValueError, match="source radius is 0"):
        mean_hankel(100 - 1j, 0.01, 0.0)


def test_given_the_straight_mirror_then_a_slope_is_a_thousandth_of_the_place():
    assert MirrorGeometry().spot_mm(100.0, -50.0) == pytest.approx((1000 * np.tan(0.1), 1000 * np.tan(-0.05)))


@given(st.floats(-120, 120), st.floats(-70, 70), st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_given_any_mirror_then_its_angles_lead_back_to_the_spot(x_mm, y_mm, bent):
    a, b, c, d, e, f = bent
    mirror = MirrorGeometry(((1 + a, b, 12.0), (c, 1 + d, -7.0), (e, f, 900.0)))
    assert mirror.spot_mm(*mirror.angles_mrad(x_mm, y_mm)) == pytest.approx((x_mm, y_mm), abs=1e-9)


def test_given_the_chain_then_its_filters_are_the_textbook_s():
    frequency_hz = np.linspace(0.0, 5000.0, 201)
    laplace = 2j * np.pi * frequency_hz
    expected = 14.0 / (14.0 + 5e-3 * laplace)
    for zeros, poles, gain in (
        scipy.signal.butter(2, 2 * np.pi * 20.0, "high", analog=True, output="zpk"),
        scipy.signal.bessel(4, 2 * np.pi * 1200.0, "low", analog=True, output="zpk", norm="mag"),
    ):
        expected = expected * gain
        for zero in zeros:
            expected = expected * (laplace - zero)
        for pole in poles:
            expected = expected / (laplace - pole)
    assert np.allclose(chain_response(frequency_hz), expected, rtol=1e-10, atol=0)


def test_files_name_the_registered_plates_and_only_their_keys():
    names = {name for name in PLATES.all() if "," not in name}
    assert set(get_args(PlateKeys.model_fields["plate"].annotation)) == names
    for key, field in PlateKeys.model_fields.items():
        if isinstance(field.json_schema_extra, dict) and key not in ("edge", "mode_tolerance"):  # see make_plate
            assert key in signature(PLATES.all()[field.json_schema_extra["plate"]].__init__).parameters
