"""The mirror map from marks: recovered, refined, and refused where it cannot be told."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.calibration.mirror_map import MirrorMap, fit_mirror_map
from wavefocus.storage.errors import InputError

MARKS = np.array([[0, 0], [80, 45], [-80, 45], [-80, -45], [80, -45], [100, 0], [-100, 0], [0, 60.0]])
MAP = MirrorMap(((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0)))

small = st.floats(-1, 1)


def angles(mirror_map, marks):
    return np.column_stack(mirror_map.angles_mrad(*marks.T))


def error_mm(found, true, marks=MARKS):
    """Where the beam falls that the found map sends to each mark, from the mark."""
    return np.hypot(*(np.column_stack(true.surface_mm(*found.angles_mrad(*marks.T))) - marks).T)


@given(st.tuples(*[small] * 8), st.booleans())
def test_given_marks_without_error_then_the_map_is_found_whatever_it_is(entries, flipped):
    a, b, c, d, e, f, g, h = entries
    sign = -1 if flipped else 1
    true = MirrorMap(
        (
            (sign * (1e-3 + 3e-4 * a), 3e-4 * b, 0.05 * c),
            (3e-4 * d, 1e-3 + 3e-4 * e, 0.05 * f),
            (5e-4 * g, 5e-4 * h, 1.0),
        )
    )
    fit = fit_mirror_map(MARKS, angles(true, MARKS))
    assert fit.residual_mm.max() < 1e-6
    assert error_mm(fit.mirror_map, true).max() < 1e-6


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
def test_given_marks_met_with_an_error_then_the_map_errs_no_more_than_they_do(seed, sigma_mm):
    rng = np.random.default_rng(seed)
    met = MARKS + rng.normal(0, sigma_mm, MARKS.shape)
    fit = fit_mirror_map(MARKS, angles(MAP, met))
    # 16 equations for 8 unknowns: half of the errors' energy is left over, and half goes into the map.
    assert fit.rms_mm < 3 * sigma_mm
    assert np.sqrt(np.mean(error_mm(fit.mirror_map, MAP) ** 2)) < 4 * sigma_mm


def test_given_one_mark_off_then_refinement_beats_the_direct_solution_on_the_surface():
    met = MARKS.copy()
    met[6] += (3.0, -2.0)
    fit = fit_mirror_map(MARKS, angles(MAP, met))
    for move in np.vstack([np.eye(8), -np.eye(8)]):
        matrix = np.array(fit.mirror_map.matrix)
        matrix.flat[:8] *= 1 + 1e-4 * move
        near = MirrorMap(tuple(tuple(row) for row in matrix.tolist()))
        missed = np.column_stack(near.surface_mm(*angles(MAP, met).T)) - MARKS
        assert np.sum(missed**2) >= np.sum(fit.residual_mm**2) - 1e-9


@pytest.mark.parametrize(
    ("marks", "told"),
    [
        (MARKS[:3], "needs at least 4"),
        (np.array([[-80, 0], [-30, 0], [30, 0], [80, 0.0]]), "on a line"),
        (np.array([[-80, 0], [0, 0], [80, 0], [0, 50.0]]), "on a line, or all but one"),
        (np.array([[-80, 20], [-40, 20.3], [0, 19.8], [40, 20.1], [80, 20.0]]), "on a line"),
        (np.zeros((4, 3)), "shapes"),
    ],
)
def test_given_marks_that_decide_nothing_then_they_are_refused(marks, told):
    with pytest.raises(InputError, match=told):
        fit_mirror_map(marks, angles(MAP, marks[:, :2]) if marks.shape[1] == 2 else marks)


def test_given_a_place_that_is_none_then_it_is_refused():
    with pytest.raises(InputError, match="not finite"):
        fit_mirror_map(np.where(MARKS == 45, np.nan, MARKS), angles(MAP, MARKS))


def test_given_two_marks_confused_then_they_are_refused_or_stick_out():
    met = angles(MAP, MARKS)
    met[[1, 3]] = met[[3, 1]]
    try:
        worst_mm = fit_mirror_map(MARKS, met).residual_mm.max()
    except InputError:
        return
    assert worst_mm > 20
