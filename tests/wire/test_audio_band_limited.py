"""Signals at the interface's rate: to -100 dB, sample 0 in its place, and made once."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.drivers.audio.resampling import (
    HALF_STEP,
    converted,
    converted_frames,
    lead_samples,
    rate_ratio,
)

RATES_HZ = [(10_000, 48_000), (12_500, 44_100), (48_000, 96_000), (44_100, 48_000), (96_000, 48_000), (50_000, 44_100)]


def faded_tone(frequency_hz, rate_hz, seconds=0.2, delay_s=0.0):
    """A tone under a bell that is below -200 dB at either end, as a function of time."""
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz - delay_s
    bell = np.exp(-(((time_s - seconds / 2) / (seconds / 16)) ** 2))
    return bell * np.sin(2 * np.pi * frequency_hz * (time_s - seconds / 2) + 0.3)


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES_HZ)
@pytest.mark.parametrize("share", [0.003, 0.1, 0.5, 0.8, 0.89])
def test_a_tone_in_the_band_then_it_is_the_same_tone_at_the_other_rate_to_100_db(from_hz, to_hz, share):
    frequency_hz = share * min(from_hz, to_hz) / 2
    ratio = rate_ratio(from_hz, to_hz)
    made, lead = converted(faded_tone(frequency_hz, from_hz), ratio), lead_samples(ratio)
    meant = faded_tone(frequency_hz, to_hz)
    body = made[lead : lead + meant.size]
    assert np.abs(body - meant).max() < 1e-5 * np.abs(meant).max()
    assert np.abs(np.concatenate([made[:lead], made[lead + meant.size :]])).max() < 1e-5


@given(st.integers(0, 40), st.sampled_from(RATES_HZ))
def test_given_a_pulse_then_it_peaks_where_its_sample_was(place, rates_hz):
    ratio = rate_ratio(*rates_hz)
    pulse = np.zeros(41)
    pulse[place] = 1.0
    made = converted(pulse, ratio)
    assert abs(np.argmax(np.abs(made)) - lead_samples(ratio) - place * float(ratio)) <= 0.5


RATIO = Fraction(24, 5)


def test_given_a_faded_signal_then_nothing_audible_begins_before_it():
    frames, first = converted_frames(faded_tone(200, 10_000), RATIO)
    assert first == 0
    assert frames.size == 9600


def test_given_a_signal_that_begins_at_once_then_what_rings_before_it_is_played_too():
    frames, first = converted_frames(np.cos(np.arange(1000) / 5) / 2.0, RATIO)
    assert -lead_samples(RATIO) <= first < -100
    dropped = converted(np.cos(np.arange(1000) / 5), RATIO)[: lead_samples(RATIO) + first] / 2.0
    assert np.abs(dropped).max(initial=0) <= HALF_STEP
    assert abs(frames[-first] - 0.5) < 0.2
