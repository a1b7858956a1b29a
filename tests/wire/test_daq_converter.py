"""Counts: whatever a converter and its calibration are like, samples come out as whole steps within the range."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.drivers.daq.ni.ni_task import count_scale

ranges_v = st.sampled_from([0.2, 1.0, 1.25, 5.0, 10.0, 20.0])
calibrations = st.tuples(
    st.sampled_from([12, 13, 14, 16]),
    st.floats(-20, 20),  # offset in steps
    st.floats(0.97, 1.06),  # step over its nominal value
    st.integers(0, 4),  # bits by which codes are shifted in their word
)


def quantised(scale, volts):
    out = np.empty(volts.shape, dtype=np.float32)
    return scale.quantise(volts.copy(), out), out


@given(ranges_v, calibrations, st.integers(0, 2**32 - 1))
def test_a_calibrated_converter_then_its_codes_come_back_as_counts_without_noise(range_v, calibration, seed):
    bits, offset, gain, shift = calibration
    step_v = 2 * range_v / 2**bits * gain
    codes = np.random.default_rng(seed).integers(-(2 ** (bits - 2)), 2 ** (bits - 2), 1000)
    coefficients = [offset * step_v, step_v / 2**shift, 0.0, 0.0]
    volts = coefficients[0] + coefficients[1] * (codes * 2**shift)
    scale = count_scale(range_v, bits, coefficients)
    assert scale.step_v == pytest.approx(step_v, rel=1e-12)
    over_range, out = quantised(scale, volts)
    assert not over_range
    counts = np.rint(out.astype(np.float64) / scale.step_v)
    difference = counts - codes
    # The same everywhere, but where the offset is half a step and rounding decides.
    assert difference.max() - difference.min() <= (1 if abs(offset % 1 - 0.5) < 1e-6 else 0)
    assert np.abs(out - volts).max() <= 0.51 * scale.step_v


@pytest.mark.parametrize(
    "coefficients", [None, [], [0.0], [0.0, 0.0], [0.0, -1e-3], [0.0, 5.0], [0.0, 4.2e-4, 0.0]], ids=str
)
def test_given_no_sensible_calibration_then_the_step_is_the_nominal_one(coefficients):
    scale = count_scale(10.0, 16, coefficients)
    assert scale.step_v == 10.0 / 32768
    assert (scale.lowest, scale.highest) == (-32768, 32767)
