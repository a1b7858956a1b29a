"""What a coil may get, peak and rms over a second: drives scaled and never clipped, live drives held by one gain."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.drive.coil_limits import DriveLimits, Limiting, levels_of, limit_drive
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.rendering.report.render_report import RenderReport
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0
FULL_SCALE_V = np.array([2.0, 1.5, 1.0])


def sines(seconds, *amplitudes):
    return np.array(amplitudes)[:, None] * np.sin(2 * np.pi * 50.0 * np.arange(round(seconds * RATE_HZ)) / RATE_HZ)


@given(st.integers(1, 400), st.integers(1, 90), st.booleans(), st.integers(0, 2**32))
def test_given_any_drive_then_its_levels_are_those_of_direct_evaluation(samples, window, repeated, seed):
    drive_v = np.random.default_rng(seed).standard_normal((2, samples)) * np.array([[1e-6], [1e5]])
    found = levels_of(drive_v, window, repeated=repeated).rms_v  # the window is a second
    length = window if repeated else min(window, samples)
    long = np.tile(drive_v, 1 + -(-window // samples)) if repeated else drive_v
    starts = range(samples) if repeated else range(samples - length + 1)
    direct = [max(np.sqrt(np.mean(row[start : start + length] ** 2)) for start in starts) for row in long]
    assert found == pytest.approx(direct, rel=1e-9)


def test_given_limits_then_the_strictest_scales_all_actuators_alike():
    asked_v = sines(2.0, 1.0, 4.0, 2.0)
    asked_v[2, 10] = 4.05  # short and loud
    for limits, decided_by, actuator, scale in (
        (DriveLimits(peak_v=1.0), "limit_v", 2, 1 / 4.05),
        (DriveLimits(rms_v=1.0), "limit_rms_v", 1, np.sqrt(2) / 4),
        (DriveLimits(peak_v=1.0, rms_v=0.5), "limit_rms_v", 1, np.sqrt(2) / 8),
        (DriveLimits(peak_v=4.1, rms_v=3.0), None, None, 1.0),
        (DriveLimits(), None, None, 1.0),
    ):
        drive_v = asked_v.copy()
        told = limit_drive(drive_v, RATE_HZ, limits)
        assert (told.decided_by, told.actuator) == (decided_by, actuator)
        assert actuator is None or f"actuator {actuator} decides" in str(told)
        assert told.scale == pytest.approx(scale)
        assert np.allclose(drive_v, told.scale * asked_v, rtol=1e-15)
        assert np.abs(drive_v).max() <= (limits.peak_v or np.inf)
        assert levels_of(drive_v, RATE_HZ).rms_v.max() <= (limits.rms_v or np.inf)


def test_a_limit_that_is_none_is_refused_and_the_range_of_actuators_is_stated():
    for limit in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="limit_rms_v"):
            limit_drive(sines(0.1, 1.0), RATE_HZ, DriveLimits(rms_v=limit))
    for relative, range_db in ([1.0, 0.0, 0.1, 1e-3], 60.0), (np.zeros(3), 0.0):
        report = RenderReport((), Limiting(), np.array(relative), (), 0.0)
        assert report.dynamic_range_db == pytest.approx(range_db)


def limited(drive_v, limits, look_ahead, sizes):
    """What comes out for blocks of these sizes, again and again, without the delay; and the least gain in dB."""
    limiter = LiveLimiter(limits, FULL_SCALE_V, RATE_HZ, look_ahead)
    pieces, least, at = [], 0.0, 0
    while at < drive_v.shape[1]:
        size = sizes[len(pieces) % len(sizes)]
        pieces.append(limiter.limit(drive_v[:, at : at + size]))
        least = min(least, limiter.gain_db)
        at += size
    pieces.append(limiter.limit(np.zeros((len(drive_v), look_ahead))))
    return np.concatenate(pieces, axis=1)[:, look_ahead:], min(least, limiter.gain_db)


MADE = {
    "sine": lambda length: np.sin(np.arange(length) * 0.3),
    "noise": np.random.default_rng(1).standard_normal,
    "step": np.ones,
    "click": lambda length: np.eye(1, length)[0],
}


@given(
    parts=st.lists(
        st.tuples(st.sampled_from([*MADE]), st.integers(1, 900), st.integers(-3, 9)), min_size=1, max_size=6
    ),
    limits=st.sampled_from([DriveLimits(), DriveLimits(0.5), DriveLimits(1.2, 0.3), DriveLimits(None, 0.1)]),
    look_ahead=st.integers(1, 40),
    sizes=st.lists(st.integers(1, 300), min_size=1, max_size=4),
)  # fmt: skip
def test_any_live_drive_in_blocks_of_any_size_then_every_limit_holds_at_every_sample(parts, limits, look_ahead, sizes):
    drive_v = np.concatenate([10.0**exponent * MADE[kind](length) for kind, length, exponent in parts])
    drive_v = drive_v * np.array([[1.0], [-0.7], [0.2]])
    out_v, least_db = limited(drive_v, limits, look_ahead, sizes)
    assert out_v.shape == drive_v.shape
    assert (np.abs(out_v) <= np.minimum(FULL_SCALE_V, limits.peak_v or np.inf)[:, None]).all()
    padded = np.pad(out_v, [(0, 0), (round(RATE_HZ), round(RATE_HZ))])
    assert levels_of(padded, RATE_HZ).rms_v.max() <= (limits.rms_v or np.inf) * (1 + 1e-9)
    # One gain for all, and the same however the drive is cut.
    np.testing.assert_allclose(out_v[0] * drive_v[1], out_v[1] * drive_v[0], rtol=1e-12)
    np.testing.assert_allclose(out_v, limited(drive_v, limits, look_ahead, [drive_v.shape[1]])[0], rtol=1e-12)
    assert (least_db < 0) == (out_v != drive_v).any()


def test_live_drives_below_their_limits_pass_and_lasting_ones_settle_a_decibel_below():
    drive_v = sines(4.0, *[0.88 * np.sqrt(2) * 0.5] * 3)
    out_v, least_db = limited(drive_v, DriveLimits(0.7, 0.5), 20, [5])
    assert np.array_equal(out_v, drive_v)
    assert least_db == 0.0
    out_v, _ = limited(sines(8.0, *[0.9] * 3), DriveLimits(None, 0.2), 20, [7])
    settled = out_v[0, 2000:7900].reshape(-1, 20).std(axis=1)
    assert settled.mean() == pytest.approx(0.2 / np.sqrt(1.25), rel=0.02)
    assert settled.max() < 1.01 * settled.min()


def test_live_peak_then_gain_falls_in_the_look_ahead_and_no_number_is_refused():
    drive_v = np.full((3, 1000), 0.1)
    drive_v[:, 500] = 10.0
    gain = limited(drive_v, DriveLimits(0.5), 20, [50])[0][0] / drive_v[0]
    assert np.flatnonzero(gain < 1.0)[0] >= 500 - 20
    assert np.flatnonzero(gain < 1.0)[-1] <= 500 + 0.2 * RATE_HZ + 20
    assert np.abs(np.diff(gain)).max() < 1 / 10
    assert gain[500] == pytest.approx(0.05)
    with pytest.raises(InputError):
        LiveLimiter(DriveLimits(), FULL_SCALE_V, RATE_HZ, 20).limit(np.array([[0.0], [np.nan], [0.0]]))
