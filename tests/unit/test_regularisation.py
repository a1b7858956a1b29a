"""Saturation and normalisation, eqs. (14) and (15)."""

import numpy as np
import pytest

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.greens.regularisation import focus_gain_map, rms_map, saturation_threshold
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.storage.errors import InputError

POSITION_MM = np.stack([4.0 * np.arange(6), np.zeros(6)], axis=1)


def make_bank(scale=1.0, **options):
    values = scale * np.random.default_rng(1).standard_normal((6, 3, 40)) * np.array([1, 3, 0.1])[:, None]
    return GreenArray(values, POSITION_MM, 1000.0, **options)


def test_the_rms_map_is_equation_14_at_every_position_and_actuator():
    bank = make_bank()
    np.testing.assert_allclose(rms_map(bank), np.sqrt(np.mean(bank.values**2, axis=2)), rtol=1e-14)


def test_a_fraction_is_taken_of_the_median_over_measured_positions_alone():
    bank = make_bank(status=np.array([1, 1, 0, 8, 4, 17], np.uint8))
    expected = 0.5 * np.median(np.sqrt(np.mean(bank.values[[0, 1, 4]] ** 2, axis=2)))
    assert saturation_threshold(Regularisation(saturation=0.5), bank) == pytest.approx(expected, rel=1e-14)
    assert saturation_threshold(Regularisation(saturation_absolute=2.5), bank) == 2.5
    assert saturation_threshold(Regularisation(), bank) == np.inf


def test_a_fraction_of_a_silent_bank_is_refused():
    bank = GreenArray(np.zeros((6, 3, 4)), POSITION_MM, 1000.0)
    with pytest.raises(InputError, match="median is 0"):
        saturation_threshold(Regularisation(saturation=0.5), bank)


@pytest.mark.parametrize("saturation", [None, 0.4])
def test_the_focus_gain_map_is_equation_15_and_nan_where_nothing_was_measured(saturation):
    bank = make_bank(status=np.array([1, 1, 1, 0, 1, 1], np.uint8))
    power = np.sum(bank.values**2, axis=2)
    rms = np.sqrt(power / 40)
    measured = np.arange(6) != 3
    threshold = np.inf if saturation is None else saturation * np.median(rms[measured])
    expected = 1 / np.sum(np.where(rms < threshold, 1, threshold / rms) * power, axis=1)
    found = focus_gain_map(bank, saturation)
    assert np.isnan(found[3])
    np.testing.assert_allclose(found[measured], expected[measured], rtol=1e-13)


def test_a_focus_gain_that_float64_cannot_hold_is_refused():
    with pytest.raises(InputError, match="give the bank a unit in which its values are nearer to 1"):
        focus_gain_map(make_bank(scale=1e-200))
