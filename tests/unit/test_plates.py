from inspect import signature
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import hankel2

from tests.unit.wave_travel import impulse_travel
from wavefocus.config.emulation import PlateKeys
from wavefocus.mocks.plates import PLATES
from wavefocus.mocks.plates.infinite import PlateTable
from wavefocus.mocks.plates.soft import SOFT_PLATE, SPRINGPOT_PLATE, mean_hankel
from wavefocus.mocks.virtual.settings import MirrorGeometry

STEP_HZ = 5.0
FREQUENCY_HZ = STEP_HZ * np.arange(1001)
TABLE = PlateTable(SOFT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128))


@pytest.mark.parametrize("wave", [SOFT_PLATE, SPRINGPOT_PLATE], ids=["viscous", "springpot"])
def test_on_the_soft_plate_an_impulse_travels_as_the_paper_measured(wave):
    """Group velocity and attenuation of band-limited impulses, section IV.A."""
    travel = impulse_travel(wave, (50.0, 450.0))
    assert travel.group_velocity_m_s == pytest.approx(4.8, rel=1e-6)
    assert travel.attenuation_db_per_cm == pytest.approx(3.8, rel=1e-6)
    if wave is SPRINGPOT_PLATE:
        loss = -wave.wavenumber([50.0, 250.0, 450.0]).imag * 20 / np.log(10) / 100
        assert loss == pytest.approx([2.0, 7.7, 12.5], abs=0.1)


def test_springpot_then_its_response_is_causal_and_table_is_within_1e_minus_7():
    # Its tail falls as a power of time, so it needs 20 s not to wrap.
    frequency_hz = np.fft.rfftfreq(200_000, 1e-4)
    kernel = SPRINGPOT_PLATE.kernels(frequency_hz, 40.0, 2.5)[0] * np.exp(-((frequency_hz / 800.0) ** 2))
    response = np.fft.irfft(kernel)
    assert np.square(response[-1000:]).sum() < 1e-8 * np.square(response).sum()
    table = PlateTable(SPRINGPOT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128))
    expected = SPRINGPOT_PLATE.kernels(FREQUENCY_HZ, 33.0, 2.5)[0]
    assert np.abs(table.evaluate(np.array([33.0]))[0] - expected).max() < 1e-7 * np.abs(expected).max()


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


@given(st.floats(0.0, 400.0))
def test_given_any_distance_then_the_table_is_within_1e_minus_7(radius_mm):
    direct = SOFT_PLATE.velocity(FREQUENCY_HZ[1:], radius_mm)
    error = TABLE.evaluate(np.array([radius_mm]))[0, 1:] - direct
    assert np.max(np.abs(error) / np.abs(direct)) < 1e-8


@given(st.floats(-120, 120), st.floats(-70, 70), st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_given_any_mirror_then_its_angles_lead_back_to_the_spot(x_mm, y_mm, bent):
    a, b, c, d, e, f = bent
    mirror = MirrorGeometry(((1 + a, b, 12.0), (c, 1 + d, -7.0), (e, f, 900.0)))
    assert mirror.spot_mm(*mirror.angles_mrad(x_mm, y_mm)) == pytest.approx((x_mm, y_mm), abs=1e-9)


def test_files_name_the_registered_plates_and_only_their_keys():
    names = {name for name in PLATES.all() if "," not in name}
    assert set(get_args(PlateKeys.model_fields["plate"].annotation)) == names
    for key, field in PlateKeys.model_fields.items():
        if isinstance(field.json_schema_extra, dict) and key not in ("edge", "mode_tolerance"):  # see make_plate
            assert key in signature(PLATES.all()[field.json_schema_extra["plate"]].__init__).parameters
