"""Actuators against each other: sign, level, and words for what is wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.acquisition.calibrate_channels import compare_actuators

RATE_HZ = 10_000.0


def responses(factors, seed=0):
    """Bursts alike, each a little different, as at one distance on a plate with an edge."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(1500) / RATE_HZ
    common = np.exp(-60 * time_s) * np.sin(2 * np.pi * 180 * time_s)
    own = rng.normal(0, 0.05, (len(factors), 1500)) * np.exp(-60 * time_s)
    return np.array(factors)[:, None] * (common + own)


@given(st.lists(st.sampled_from([0.8, 1.0, 1.2, -1.0, 0.3, 0.0]), min_size=3, max_size=24), st.integers(0, 99))
def test_given_sound_ones_in_the_majority_then_each_gets_its_word(factors, seed):
    factors = factors + [1.0] * (len(factors) + 1)
    snr_db = np.where(np.array(factors) == 0, -10.0, 40.0)
    found = compare_actuators(responses(factors, seed), snr_db, RATE_HZ)
    words = {0.8: "good", 1.0: "good", 1.2: "good", -1.0: "reversed", 0.3: "weak", 0.0: "dead"}
    assert found.verdict == tuple(words[factor] for factor in factors)
    assert found.polarity == tuple(-1 if factor < 0 else 1 for factor in factors)
    assert np.isfinite(found.level_db).all()


def test_given_levels_then_they_are_told_against_the_median():
    found = compare_actuators(responses([1, 1, 2, 1, 0.5]), np.full(5, 50.0), RATE_HZ)
    assert found.level_db == pytest.approx([0, 0, 6.02, 0, -6.02], abs=0.3)


def test_given_all_reversed_then_none_is():
    found = compare_actuators(responses([-1, -1, -1]), np.full(3, 50.0), RATE_HZ)
    assert found.verdict == ("good",) * 3


def test_given_another_shape_then_it_is_unlike_the_others():
    green = responses([1, 1, 1, 1, 1])
    green[2] = np.random.default_rng(3).normal(0, 0.15, 1500)
    assert compare_actuators(green, np.full(5, 50.0), RATE_HZ).verdict[2] == "unlike"


def test_given_a_magnet_a_few_millimetres_off_then_its_sign_is_still_told():
    green = responses([1, 1, -1, 1, 1])
    green[2] = np.roll(green[2], 9)
    assert compare_actuators(green, np.full(5, 50.0), RATE_HZ).verdict == ("good", "good", "reversed", "good", "good")


def test_given_nothing_heard_at_all_then_all_are_dead():
    found = compare_actuators(np.zeros((3, 100)), np.full(3, -300.0), RATE_HZ)
    assert found.verdict == ("dead",) * 3
    assert np.isfinite(found.level_db).all()
