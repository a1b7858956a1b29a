"""Drives within what a coil may get: peak and rms over a second, scaled and never clipped."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.drive.coil_limits import DriveLimits, dynamic_range_db, levels_of, limit_drive
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0


def sines(seconds, *amplitudes):
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.array(amplitudes)[:, None] * np.sin(2 * np.pi * 50.0 * time_s)


@given(st.integers(1, 400), st.integers(1, 90), st.booleans(), st.integers(0, 2**32))
def test_given_any_drive_then_the_levels_of_is_that_of_direct_evaluation(samples, window, repeated, seed):
    drive_v = np.random.default_rng(seed).standard_normal((2, samples)) * np.array([[1e-6], [1e5]])
    found = levels_of(drive_v, RATE_HZ, window / RATE_HZ, repeated=repeated).rms_v
    length = window if repeated else min(window, samples)
    long = np.tile(drive_v, 1 + -(-window // samples)) if repeated else drive_v
    starts = range(samples) if repeated else range(samples - length + 1)
    direct = [max(np.sqrt(np.mean(row[start : start + length] ** 2)) for start in starts) for row in long]
    assert found == pytest.approx(direct, rel=1e-9)


@pytest.mark.parametrize(
    ("limits", "decided_by", "actuator", "scale"),
    [
        (DriveLimits(peak_v=1.0), "limit_v", 1, 0.25),
        (DriveLimits(rms_v=1.0), "limit_rms_v", 1, np.sqrt(2) / 4),
        (DriveLimits(peak_v=1.0, rms_v=0.5), "limit_rms_v", 1, np.sqrt(2) / 8),
        (DriveLimits(peak_v=4.1, rms_v=3.0), None, None, 1.0),
        (DriveLimits(), None, None, 1.0),
    ],
)
def test_given_limits_then_the_strictest_scales_all_actuators_alike(limits, decided_by, actuator, scale):
    drive_v, asked_v = sines(2.0, 1.0, 4.0, 2.0), sines(2.0, 1.0, 4.0, 2.0)
    told = limit_drive(drive_v, RATE_HZ, limits)
    assert (told.decided_by, told.actuator) == (decided_by, actuator)
    assert told.scale == pytest.approx(scale)
    assert np.allclose(drive_v, told.scale * asked_v, rtol=1e-15)
    if limits.peak_v is not None:
        assert np.abs(drive_v).max() <= limits.peak_v
    if limits.rms_v is not None:
        assert levels_of(drive_v, RATE_HZ).rms_v.max() <= limits.rms_v


def test_of_one_short_loud_actuator_its_power_and_not_its_peak_decides():
    drive_v = sines(3.0, 0.0, 1.0)
    drive_v[0, 10] = 1.5
    told = limit_drive(drive_v, RATE_HZ, DriveLimits(peak_v=2.0, rms_v=0.5))
    assert (told.decided_by, told.actuator) == ("limit_rms_v", 1)
    assert "actuator 1 decides" in str(told)


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, np.inf])
def test_given_no_limit_that_can_be_met_then_it_is_refused(limit):
    with pytest.raises(InputError, match="limit_rms_v"):
        limit_drive(sines(0.1, 1.0), RATE_HZ, DriveLimits(rms_v=limit))


def test_given_actuators_that_differ_then_the_dynamic_range_is_that_of_those_driven():
    assert dynamic_range_db(np.array([1.0, 0.0, 0.1, 1e-3])) == pytest.approx(60.0)
    assert dynamic_range_db(np.zeros(3)) == 0.0
