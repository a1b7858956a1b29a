"""Figures of wave fields against fields whose figures are known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.field import metrics

SPACING_MM = 4.0
AXIS_MM = np.arange(-40.0, 40.1, SPACING_MM)
GRID_MM = np.stack(np.meshgrid(AXIS_MM, AXIS_MM), axis=-1).reshape(-1, 2)
offsets_mm = st.floats(-2.0, 2.0)


def gaussian(centre_mm, fwhm_mm):
    distance = np.hypot(*(GRID_MM - centre_mm).T)
    return np.asarray(np.exp(-4.0 * math.log(2.0) * (distance / fwhm_mm) ** 2))


@given(x=offsets_mm, y=offsets_mm, fwhm=st.floats(9.0, 14.0), sign=st.sampled_from([-1e-3, 1.0, 1e4]))
def test_given_a_gaussian_spot_between_positions_then_its_width_and_place_are_found(x, y, fwhm, sign):
    field = sign * gaussian((x, y), fwhm)
    peak = metrics.focus_peak(GRID_MM, field, (0.0, 0.0), 15.0)
    assert peak is not None
    assert math.dist(peak.at_mm, (x, y)) < 0.01
    width = metrics.focal_width_mm(GRID_MM, field, peak.row, SPACING_MM)
    # 4.3 % is the worst of all places and widths: a spot of 9 mm between four positions.
    assert width == pytest.approx(fwhm, rel=0.045)


def test_given_two_spots_then_the_one_within_the_radius_is_found_and_measured_alone():
    field = gaussian((-10.0, 0.0), 9.0) - 5.0 * gaussian((25.0, 0.0), 12.0)
    peak = metrics.focus_peak(GRID_MM, field, (-9.0, 1.0), 10.0)
    assert peak is not None
    assert math.dist(peak.at_mm, (-10.0, 0.0)) < 0.6
    assert metrics.focal_width_mm(GRID_MM, field, peak.row, SPACING_MM) == pytest.approx(9.0, rel=0.04)


def test_given_a_spot_at_the_rim_or_too_few_positions_then_it_has_no_width():
    field = gaussian((40.0, 0.0), 10.0)
    assert metrics.focal_width_mm(GRID_MM, field, int(np.argmax(field)), SPACING_MM) is None
    few = [200, 201, 220, 221, 222, 240, 241]
    assert metrics.focal_width_mm(GRID_MM[few], gaussian((0.0, 0.0), 10.0)[few], 0, SPACING_MM) is None


def test_fields_that_differ_by_tenth_then_error_is_tenth_and_correlation_one():
    field = np.random.default_rng(1).standard_normal((5, 200)).astype(np.float32)
    assert metrics.normalised_error(field, np.float32(0.9) * field) == pytest.approx(0.1, rel=1e-5)
    assert metrics.correlation(field, -0.9 * field) == pytest.approx(-1.0)


def test_given_silence_then_the_figures_say_so_and_do_not_divide_by_it():
    silence, field = np.zeros((2, 3)), np.ones((2, 3))
    assert metrics.normalised_error(silence, silence) == 0.0
    assert metrics.normalised_error(silence, field) == math.inf
    assert math.isnan(metrics.correlation(silence, field))
    assert metrics.level_db(0.0) == -math.inf


def test_given_gains_of_1_to_10_with_unmeasured_positions_then_the_range_is_20_db():
    assert metrics.range_db(np.array([1.0, 10.0, np.nan, np.inf, 0.0, 3.0])) == pytest.approx(20.0)
    assert math.isnan(metrics.range_db(np.array([np.nan, 2.0])))


def test_side_spot_of_tenth_then_artefact_level_is_minus_20_db_unless_it_is_focus():
    field = gaussian((0.0, 0.0), 9.0) - 0.1 * gaussian((32.0, 0.0), 9.0)
    spot = metrics.focus_spot(GRID_MM, field, (0.0, 0.0), 15.0, SPACING_MM)
    assert spot is not None
    assert spot.artefact_db == pytest.approx(-20.0, abs=0.1)
    assert (spot.value, spot.off_mm) == (pytest.approx(1.0), pytest.approx(0.0, abs=0.01))
    assert spot.width_mm == pytest.approx(9.0, rel=0.045)
    other_mm = np.array([[32.0, 0.0]])
    assert metrics.artefact_level_db(GRID_MM, field, (0.0, 0.0), 15.0, other_mm) < -50.0
    assert math.isnan(metrics.artefact_level_db(GRID_MM, field, (0.0, 0.0), 500.0))
    assert metrics.focus_spot(GRID_MM, field, (200.0, 0.0), 15.0, SPACING_MM) is None
