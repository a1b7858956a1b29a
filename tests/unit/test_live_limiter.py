"""Limits of live drives: held at every sample, by one gain, which is 1 where nothing is near them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.drive.coil_limits import DriveLimits, levels_of
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0
FULL_SCALE_V = np.array([2.0, 1.5, 1.0])


def limited(drive_v, limits, look_ahead, sizes):
    """What comes out for blocks of these sizes, again and again, without the delay; and the least gain in dB."""
    limiter = LiveLimiter(limits, FULL_SCALE_V, RATE_HZ, look_ahead)
    pieces, least, at = [], 0.0, 0
    while at < drive_v.shape[1]:
        size = sizes[len(pieces) % len(sizes)]
        pieces.append(limiter.limit(drive_v[:, at : at + size]))
        least = min(least, limiter.gain_db)
        at += size
    pieces.append(limiter.flush())
    return np.concatenate(pieces, axis=1)[:, look_ahead:], min(least, limiter.gain_db)


@given(
    parts=st.lists(
        st.tuples(st.sampled_from(["sine", "noise", "step", "click"]), st.integers(1, 900), st.integers(-3, 9)),
        min_size=1, max_size=6,
    ),
    limits=st.sampled_from([DriveLimits(), DriveLimits(0.5), DriveLimits(1.2, 0.3), DriveLimits(None, 0.1)]),
    look_ahead=st.integers(1, 40),
    sizes=st.lists(st.integers(1, 300), min_size=1, max_size=4),
)  # fmt: skip
def test_any_drive_in_blocks_of_any_size_then_every_limit_holds_at_every_sample(parts, limits, look_ahead, sizes):
    random = np.random.default_rng(len(parts))
    made = {
        "sine": lambda length: np.sin(np.arange(length) * 0.3),
        "noise": random.standard_normal,
        "step": np.ones,
        "click": lambda length: np.eye(1, length)[0],
    }
    mono = np.concatenate([10.0**exponent * made[kind](length) for kind, length, exponent in parts])
    drive_v = mono * np.array([[1.0], [-0.7], [0.2]])
    out_v, least_db = limited(drive_v, limits, look_ahead, sizes)
    peak_v = np.minimum(FULL_SCALE_V, limits.peak_v or np.inf)
    assert out_v.shape == drive_v.shape
    assert (np.abs(out_v) <= peak_v[:, None]).all()
    silence = np.zeros((3, round(RATE_HZ)))
    if limits.rms_v is not None:
        padded = np.concatenate([silence, out_v, silence], axis=1)
        assert levels_of(padded, RATE_HZ).rms_v.max() <= limits.rms_v * (1 + 1e-9)
    # One gain for all, and the same however the drive is cut.
    np.testing.assert_allclose(out_v[0] * drive_v[1], out_v[1] * drive_v[0], rtol=1e-12)
    np.testing.assert_allclose(out_v, limited(drive_v, limits, look_ahead, [drive_v.shape[1]])[0], rtol=1e-12)
    assert (least_db < 0) == (out_v != drive_v).any()


def test_given_a_drive_up_to_a_decibel_below_its_limits_then_it_passes_unchanged():
    time_s = np.arange(4000) / RATE_HZ
    drive_v = np.tile(0.88 * np.sqrt(2) * 0.5 * np.sin(2 * np.pi * 50 * time_s), (3, 1))
    out_v, least_db = limited(drive_v, DriveLimits(0.7, 0.5), 20, [5])
    assert np.array_equal(out_v, drive_v)
    assert least_db == 0.0


def test_a_lasting_drive_beyond_its_rms_settles_a_decibel_below_the_limit():
    drive_v = np.tile(0.9 * np.sin(2 * np.pi * 50 * np.arange(8000) / RATE_HZ), (3, 1))
    out_v, _ = limited(drive_v, DriveLimits(None, 0.2), 20, [7])
    settled = out_v[0, 2000:7900].reshape(-1, 20).std(axis=1)
    assert settled.mean() == pytest.approx(0.2 / np.sqrt(1.25), rel=0.02)
    assert settled.max() < 1.01 * settled.min()


def test_a_peak_then_the_gain_falls_within_the_look_ahead_and_is_back_200_ms_later():
    drive_v = np.full((3, 1000), 0.1)
    drive_v[:, 500] = 10.0
    gain = limited(drive_v, DriveLimits(0.5), 20, [50])[0][0] / drive_v[0]
    assert np.flatnonzero(gain < 1.0)[0] >= 500 - 20
    assert np.flatnonzero(gain < 1.0)[-1] <= 500 + 0.2 * RATE_HZ + 20
    assert np.abs(np.diff(gain)).max() < 1 / 10
    assert gain[500] == pytest.approx(0.05)


def test_given_a_drive_that_is_not_finite_then_it_is_refused():
    with pytest.raises(InputError):
        LiveLimiter(DriveLimits(), FULL_SCALE_V, RATE_HZ, 20).limit(np.array([[0.0], [np.nan], [0.0]]))
