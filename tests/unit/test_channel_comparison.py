"""One signal on both inputs: how much later, how strong, and which one is missing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.comparison import ChannelComparer, ResponseMissingError
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.mocks.virtual.signals import PlayedSignal

RATE_HZ = 10_000.0
SWEEP = PlayedExcitation(RATE_HZ, 200.0, 4000.0, 0.5, 0.05, 1.0, 1)
COMPARER = ChannelComparer(SWEEP.signal_v(), RATE_HZ)
NOISE_V = 1e-4


SIGNAL = PlayedSignal(SWEEP.signal_v(), full_scale_v=2.0)


def heard(offset: float, ratio: float, gain: float, seed: int, samples: int = 7000) -> np.ndarray:
    """The sweep at an instant between samples, on another clock, with noise."""
    wave = SIGNAL.delayed(16_384, ratio, SIGNAL.volts.size, offset, samples).astype(np.float64)
    return gain * wave + np.random.default_rng(seed).normal(0, NOISE_V, samples)


@hypothesis_settings(max_examples=25, deadline=None)
@given(st.floats(-2e-4, 2e-4), st.floats(-100, 100), st.floats(0.5, 2), st.booleans(), st.integers(0, 1000))
def test_given_a_delay_then_it_is_found_to_a_few_nanoseconds_with_gain_and_sign(
    late_s: float, ppm: float, gain: float, crossed: bool, seed: int
) -> None:
    ratio, sign = 1 + 1e-6 * ppm, -1 if crossed else 1
    reference = heard(300.3, ratio, 1.0, seed)
    response = heard(300.3 + late_s * RATE_HZ, ratio, sign * gain, seed + 1)
    found = COMPARER.compare(reference, response)
    assert found.late_s == pytest.approx(late_s, abs=2e-8)
    assert found.response.gain == pytest.approx(sign * gain, rel=1e-3)
    assert found.reference.gain == pytest.approx(1.0, rel=1e-3)


def test_given_silence_on_the_response_then_it_is_the_response_that_is_missing() -> None:
    noise = np.random.default_rng(0).normal(0, NOISE_V, 7000)
    with pytest.raises(ResponseMissingError, match="response channel"):
        COMPARER.compare(heard(300.0, 1.0, 1.0, 1), noise)


def test_given_silence_on_the_reference_then_it_is_the_reference_that_is_missing() -> None:
    with pytest.raises(ReferenceMissingError, match="reference channel") as told:
        COMPARER.compare(np.zeros(7000), heard(300.0, 1.0, 1.0, 1))
    assert not isinstance(told.value, ResponseMissingError)
