"""The emulated mirror: what it tells of its motion fits together."""

from __future__ import annotations

import math
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.mocks.virtual.mirror import MirrorMotion

SECOND_NS = 1_000_000_000


def test_given_a_move_then_it_is_under_way_for_ramp_and_settling():
    motion = MirrorMotion((0.0, 0.0), 10.0, 1.0, 10.0)
    motion.start(5.0, -2.0)
    assert motion.busy()
    assert 14.9 * SECOND_NS < motion.settled_at_ns() - time.monotonic_ns() <= 15 * SECOND_NS
    x, y = motion.where_mrad()
    assert 0 <= x < 5
    assert y == pytest.approx(-0.4 * x)


def test_given_a_limit_then_it_reaches_so_far_and_what_rounding_adds():
    motion = MirrorMotion((0.0, 0.0), 0.0, math.inf, 10.0)
    assert motion.reaches(10.05, 0.0)
    assert not motion.reaches(0.0, 10.5)
    assert not motion.reaches(math.nan, 0.0)


@settings(max_examples=50)
@given(
    moves=st.lists(st.tuples(st.floats(-10, 10), st.floats(-10, 10)), max_size=6),
    settle_s=st.sampled_from([0.0, 1e-4, 10.0]),
    slew_mrad_s=st.sampled_from([1.0, 1e5, math.inf]),
    before_s=st.floats(0, 0.01),
)
def test_given_any_moves_then_aims_cover_the_time_in_order_and_end_as_the_mirror_is(
    moves, settle_s, slew_mrad_s, before_s
):
    motion = MirrorMotion((0.0, 0.0), settle_s, slew_mrad_s, 10.0)
    for move in moves:
        motion.start(*move)
    stop_ns = time.monotonic_ns()
    start_ns = stop_ns - round(before_s * SECOND_NS) - 1
    aims = motion.aims(start_ns, stop_ns)
    instants = [instant for instant, _ in aims]
    assert instants[0] == start_ns
    assert instants == sorted(set(instants))
    assert instants[-1] < stop_ns
    last = moves[-1] if moves else (0.0, 0.0)
    assert aims[-1][1] == (None if motion.settled_at_ns() >= stop_ns else last)
