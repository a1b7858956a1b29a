"""Inverse filtering: what the control points hear, and what is said of its condition."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from tests.unit.plate_banks import BAND_HZ, RATE_HZ, SQUARE_MM, TAPS, plate_bank
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.inverse_filter import inverse_filter
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.metrics import band_limited
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point
from wavefocus.rendering.scene.signals import Impulse, Noise
from wavefocus.storage.errors import InputError

LEAD = TAPS - 1


@functools.lru_cache
def bank():
    return plate_bank()


def point(at_mm, signal=None, start_s=0.0, amplitude=1.0):
    return Source(Point(at_mm), signal or Impulse(), start_s, amplitude=amplitude)


def scene(*sources, **options):
    return Scene("s", sources, Regularisation(normalise=options.pop("normalise", True)), Output(**options))


def heard_at(drive, points_mm):
    rows = [int(np.argmin(np.hypot(*(SQUARE_MM - at).T))) for at in points_mm]
    return predict(drive, bank(), rows).field


def test_an_impulse_makes_a_response_of_its_amplitude_at_its_point_and_instant():
    drive, report = inverse_filter(scene(point((4.0, -8.0), start_s=0.05, amplitude=-2.5)), bank())
    response = heard_at(drive, [(4.0, -8.0)])[0]
    sample = LEAD + round(0.05 * RATE_HZ)
    assert response[sample] == pytest.approx(-2.5, rel=1e-3)
    assert np.argmax(np.abs(response)) == sample
    assert report.cut_share < 0.02


def test_much_regularisation_is_time_reversal():
    """lambda far above the transfer functions leaves F = H* D / lambda."""
    source = scene(point((4.0, 4.0)), point((-12.0, 8.0)), normalise=False)
    inverse, _ = inverse_filter(source, bank(), regularisation_db=-1e-9)
    reversed_, _ = render_with_report(source, bank())
    limited = band_limited(reversed_.drive_v, RATE_HZ, BAND_HZ)
    assert inverse.drive_v.shape == reversed_.drive_v.shape
    assert inverse.start_s == reversed_.start_s
    few, many = (
        np.corrcoef(inverse_filter(source, bank(), regularisation_db=db)[0].drive_v.ravel(), limited.ravel())[0, 1]
        for db in (-60.0, -1e-9)
    )
    assert few < many
    assert many > 0.97


def test_two_points_hear_their_own_signals_and_not_the_other_s():
    first, second = (-4.0, 0.0), (8.0, 0.0)
    own = scene(point(first, Noise((80, 420), 0.2, 1)), point(second, Noise((80, 420), 0.2, 2)), normalise=False)
    inverse, report = inverse_filter(own, bank(), regularisation_db=-50.0)
    heard = heard_at(inverse, [first, second])
    for response, seed in zip(heard, (1, 2), strict=True):
        wanted = np.zeros(len(response))
        signal = Noise((80, 420), 0.2, seed).samples(RATE_HZ)
        wanted[LEAD : LEAD + len(signal)] = signal
        wanted = band_limited(wanted, RATE_HZ, BAND_HZ)
        assert np.linalg.norm(response - wanted) < 0.05 * np.linalg.norm(wanted)
    assert report.control_points == 2
    assert report.misfit < 0.02


def test_focus_instants_and_places_are_those_of_time_reversal():
    moving = scene(Source(Circle((0, 0), 12.0, 0.7), Noise((80, 420), 0.4, 1), 0.02, 150.0, 6.0))
    repeated = scene(Source(Line((-12, 0), (12, 0)), Impulse(), 0.02, 150.0, 8.0, emission="per_point"))
    for one in (moving, repeated):
        inverse, _ = inverse_filter(one, bank())
        reversed_, _ = render_with_report(one, bank(), method="sampled")
        for name in ("focus_sample", "focus_position", "focus_source"):
            np.testing.assert_array_equal(getattr(inverse, name), getattr(reversed_, name))
        assert inverse.drive_v.shape == reversed_.drive_v.shape
        assert inverse.method == "inverse-filter"


def test_every_point_of_a_path_hears_its_own_impulse():
    """Control points 8 mm apart, at a speed at which time reversal's foci do not yet meet."""
    path = scene(Source(Line((-16, 0), (16, 0)), Impulse(), 0.0, 200.0, 8.0, emission="per_point"))
    drive, _ = inverse_filter(path, bank())
    for sample, position in zip(drive.focus_sample, drive.focus_position, strict=True):
        response = predict(drive, bank(), [int(position)]).field[0]
        assert response[LEAD + sample] == pytest.approx(1.0, abs=0.1)


def test_points_in_one_place_are_one_control_point():
    twice = scene(point((4.0, 4.0)), point((4.0, 4.0), start_s=0.1))
    drive, report = inverse_filter(twice, bank())
    assert report.control_points == 1
    response = heard_at(drive, [(4.0, 4.0)])[0]
    assert response[LEAD] == pytest.approx(1.0, abs=0.02)
    assert response[LEAD + 200] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_a_bank_in_another_unit_gives_the_same_drive_in_that_unit(scale):
    one = scene(point((4.0, 4.0)), point((-8.0, 4.0)))
    scaled = GreenArray(bank().values * scale, SQUARE_MM, RATE_HZ, band_hz=BAND_HZ)
    expected, report = inverse_filter(one, bank())
    found, scaled_report = inverse_filter(one, scaled)
    np.testing.assert_allclose(found.drive_v * scale, expected.drive_v, atol=1e-9 * np.abs(expected.drive_v).max())
    np.testing.assert_allclose(scaled_report.condition, report.condition, rtol=1e-6)


def test_the_condition_is_that_of_the_transfer_functions():
    """Two actuators, two points, one tap each: H is a matrix of numbers at every frequency."""
    matrix = np.array([[1.0, 0.5], [0.5, 1.0]])
    plain = GreenArray(matrix[:, :, None], np.array([[0.0, 0.0], [4.0, 0.0]]), RATE_HZ)
    _, report = inverse_filter(scene(point((0.0, 0.0)), point((4.0, 0.0))), plain)
    np.testing.assert_allclose(report.condition, 3.0)
    np.testing.assert_allclose(report.regularised_condition, np.sqrt((2.25 + 0.0125) / (0.25 + 0.0125)))


def test_saturation_is_said_not_to_apply():
    saturated = Scene("s", (point((4.0, 4.0)),), Regularisation(saturation=0.5))
    _, report = inverse_filter(saturated, bank())
    assert any("saturation belongs to time reversal" in text for text in report.warnings)


@pytest.mark.parametrize("regularisation_db", [0.0, 3.0, np.nan])
def test_a_regularisation_that_is_none_is_refused(regularisation_db):
    with pytest.raises(InputError, match="regularisation_db"):
        inverse_filter(scene(point((4.0, 4.0))), bank(), regularisation_db=regularisation_db)


def test_too_many_control_points_are_refused():
    long = scene(Source(Circle((0, 0), 20.0, 400.0), Noise((80, 420), 0.4, 1), 0.0, 100.0, 2.0))
    with pytest.raises(InputError, match=r"control points over .* s are too many to invert"):
        inverse_filter(long, bank())
