"""Trajectories: linear between knots, still before and after them, the same whichever other knots there are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.scene.trajectory import Trajectory
from wavefocus.storage.errors import InputError

PLACES = st.floats(-1e3, 1e3)
KNOTS = st.lists(st.tuples(st.integers(1, 400), PLACES, PLACES, PLACES), min_size=2, max_size=8)


def through(knots: list[tuple[int, float, float, float]]) -> Trajectory:
    """Knots whose first number is the time since the one before."""
    table = np.array(knots, dtype=np.float64)
    return Trajectory(np.cumsum(table[:, 0]).astype(np.int64), table[:, 1:3], table[:, 3])


@given(KNOTS)
def test_given_knots_then_places_are_linear_between_them_and_exact_at_them(knots):
    trajectory = through(knots)
    first, last = int(trajectory.sample[0]), int(trajectory.sample[-1])
    sample = np.arange(first - 5, last + 6)
    at_mm, amplitude = trajectory.at(sample)
    for found, wanted in ((at_mm[:, 0], trajectory.at_mm[:, 0]), (amplitude, trajectory.amplitude)):
        np.testing.assert_allclose(found, np.interp(sample, trajectory.sample, wanted), rtol=0, atol=1e-9)
        assert (found[trajectory.sample - first + 5] == wanted).all()


@given(KNOTS)
def test_knots_that_are_dropped_or_added_then_places_between_others_are_same_bits(knots):
    whole = through(knots)
    rest = Trajectory(whole.sample[1:], whole.at_mm[1:], whole.amplitude[1:])
    sample = np.arange(int(rest.sample[0]), int(rest.sample[-1]) + 1)
    for some, other in zip(whole.at(sample), rest.at(sample), strict=True):
        assert some.tobytes() == other.tobytes()


@pytest.mark.parametrize(
    ("sample", "x_mm", "amplitude"),
    [
        ([], [], []),
        ([0, 1], [0.0], [1.0, 1.0]),
        ([0, 1], [0.0, 1.0], [1.0]),
        ([1, 1], [0.0, 1.0], [1.0, 1.0]),
        ([2, 1], [0.0, 1.0], [1.0, 1.0]),
        ([0, 2**53 + 1], [0.0, 1.0], [1.0, 1.0]),
        ([0, 1], [0.0, np.nan], [1.0, 1.0]),
        ([0, 1], [0.0, 1e300], [1.0, 1.0]),
        ([0, 1], [0.0, 1.0], [1.0, np.inf]),
    ],
)
def test_given_knots_that_make_no_course_then_they_are_refused(sample, x_mm, amplitude):
    at_mm = np.stack([np.array(x_mm), np.zeros(len(x_mm))], axis=1)
    with pytest.raises(InputError):
        Trajectory(np.array(sample, dtype=np.int64), at_mm, np.array(amplitude))
