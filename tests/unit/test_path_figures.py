"""Figures of fields, banks and paths against cases that can be worked out: spots, gain, crosstalk, travel."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import j0

from tests.unit.independent_plates import impulse_travel as travel_of_a_wave
from wavefocus import GreenArray, InputError
from wavefocus.config.scene import Regularisation
from wavefocus.mocks.plates.soft import SOFT_PLATE, DampedWave
from wavefocus.rendering.field import metrics
from wavefocus.rendering.field.wave_figures import (
    correlation_over_distance,
    crosstalk_table,
    impulse_travel,
    path_responses,
)
from wavefocus.rendering.greens.regularisation import focus_gain_map, rms_map, saturation_threshold
from wavefocus.rendering.verify.field_pair import BandLimit

RATE_HZ = 10_000.0
RNG = np.random.default_rng(4)


def line_mm(points, step_mm=4.0):
    return np.stack([step_mm * np.arange(points), np.zeros(points)], axis=1)


def decaying_bank(points, ratio=0.9, taps=400):
    """One actuator whose Green's function is ratio**k everywhere: a focus makes ratio**|t| everywhere."""
    green = ratio ** np.arange(taps)
    return GreenArray(np.tile(green, (points, 1, 1)), line_mm(points), RATE_HZ)


@pytest.mark.parametrize("period", [1, 20])
def test_crosstalk_of_equal_decaying_responses_is_their_sum_over_the_window(period):
    points, ratio = 9, 0.9
    speeds_mm_s = [4.0 * RATE_HZ / period]
    ((found,),) = crosstalk_table(decaying_bank(points, ratio), range(points), 4.0, speeds_mm_s, [1]).energy_ratio
    own = others = 0.0
    for m in range(points):
        time = m * period + (1 - period) // 2 + np.arange(period)
        parts = np.array([ratio ** np.abs(time - other * period) for other in range(points)])
        own += np.sum(parts[m] ** 2)
        others += np.sum((parts.sum(axis=0) - parts[m]) ** 2)
    assert found == pytest.approx(others / own, rel=1e-9)


def test_the_responses_are_those_of_the_equations_with_saturation():
    greens = RNG.standard_normal((3, 2, 40))
    bank = GreenArray(greens, line_mm(3), RATE_HZ)
    found = path_responses(bank, range(3), Regularisation(saturation_absolute=0.8))
    rms = np.sqrt(np.mean(greens**2, axis=2))
    sigma = np.where(rms < 0.8, 1.0, 0.8 / rms)
    n = 1.0 / np.sum(sigma * np.sum(greens**2, axis=2), axis=1)
    expected = sum(n[2] * sigma[2, i] * np.convolve(greens[0, i], greens[2, i, ::-1]) for i in range(2))
    np.testing.assert_allclose(found[0, 2][:79], expected, atol=1e-12)
    assert found[1, 1, 39] == pytest.approx(1.0)


def uneven_bank(status, scale=1.0):
    values = scale * np.random.default_rng(1).standard_normal((6, 3, 40)) * np.array([1, 3, 0.1])[:, None]
    return GreenArray(values, line_mm(6), 1000.0, status=np.array(status, np.uint8))


def test_maps_of_rms_and_focus_gain_are_equations_14_and_15_over_measured_positions():
    bank = uneven_bank([1, 1, 0, 8, 4, 17])
    power = np.sum(bank.values**2, axis=2)
    rms, measured = np.sqrt(power / 40), np.array([0, 1, 4])
    np.testing.assert_allclose(rms_map(bank)[measured], rms[measured], rtol=1e-14)
    assert saturation_threshold(Regularisation(saturation_absolute=2.5), bank) == 2.5
    for saturation in (None, 0.4):
        threshold = np.inf if saturation is None else saturation * np.median(rms[measured])
        assert saturation_threshold(Regularisation(saturation=saturation or 0.0), bank) == pytest.approx(threshold)
        gain = 1 / np.sum(np.where(rms < threshold, 1, threshold / rms) * power, axis=1)
        found = focus_gain_map(bank, Regularisation(saturation=saturation or 0.0))
        assert np.isnan(found[[2, 3, 5]]).all()
        np.testing.assert_allclose(found[measured], gain[measured], rtol=1e-13)
        absolute = Regularisation(saturation_absolute=0.0 if saturation is None else threshold)
        np.testing.assert_array_equal(focus_gain_map(bank, absolute), found)


def test_silent_banks_rows_not_measured_and_gains_beyond_float64_are_refused():
    with pytest.raises(InputError, match="median is 0"):
        saturation_threshold(Regularisation(saturation=0.5), uneven_bank([1] * 6, 0.0))
    with pytest.raises(InputError, match="give the bank a unit in which its values are nearer to 1"):
        focus_gain_map(uneven_bank([1] * 6, 1e-200), Regularisation())
    bank = decaying_bank(3)
    assert np.isnan(crosstalk_table(bank, [0], 4.0, [10.0], [1]).energy_ratio).all()
    bank.values[1] = 0.0
    with pytest.raises(InputError, match="position 1 is all zeros"):
        path_responses(bank, range(3))


def test_waves_from_all_sides_correlate_like_a_bessel_function():
    """Actuator i is a plane wave cos(w t - k d_i.x) over whole periods: the coefficient is cos(k d_i.(x - x'))."""
    k, taps, directions = 0.5, 64, 48
    angle = 2.0 * np.pi * (np.arange(directions) + 0.5) / directions
    position_mm = line_mm(20, 3.0)
    phase = k * position_mm @ np.stack([np.cos(angle), np.sin(angle)])
    greens = np.cos(2.0 * np.pi * 4.0 * np.arange(taps) / taps - phase[..., None])
    edges = np.arange(1.5, 50.0, 3.0)
    found = correlation_over_distance(GreenArray(greens, position_mm, RATE_HZ), edges, range(20))
    np.testing.assert_allclose(found.distance_mm, 3.0 * np.arange(1, 17))
    np.testing.assert_allclose(found.mean, j0(k * found.distance_mm), atol=1e-9)
    assert (found.low <= found.mean).all()
    assert (found.mean <= found.high).all()


def test_a_band_from_0_hz_has_no_lower_edge():
    signal = np.random.default_rng(1).standard_normal(400) + 1.0
    band = BandLimit(400, RATE_HZ, (0.0, 450.0))
    found = metrics.band_limited(signal, RATE_HZ, (0.0, 450.0))
    np.testing.assert_allclose(band.signals(band.spectrum(signal)), found, atol=0.03)
    assert found.mean() == pytest.approx(signal.mean(), abs=0.03)


def plane_wave_bank(wave, *, band=(50.0, 450.0), taps=1500):
    """exp(-j k r) / sqrt(r), flat over the band: what the definition of group velocity and loss speaks of."""
    position_mm = np.stack(np.meshgrid(np.arange(0, 80, 8.0), np.arange(0, 40, 8.0)), axis=-1).reshape(-1, 2)
    actuator_mm = np.array([[-25.0, 5.0], [100.0, 10.0], [30.0, 62.0]])
    radius_mm = np.hypot(*(position_mm[:, None] - actuator_mm).transpose(2, 0, 1))
    frequency = np.fft.rfftfreq(taps, 1.0 / RATE_HZ)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    delay = np.exp(-2j * np.pi * frequency * 0.03)
    lag = np.exp(-1j * wave.wavenumber(frequency) * radius_mm[..., None] / 1e3) / np.sqrt(radius_mm[..., None])
    greens = np.fft.irfft(np.where(inside, lag * delay, 0.0), taps, axis=2)
    return GreenArray(greens, position_mm, RATE_HZ, actuator_mm=actuator_mm)


def test_group_velocity_and_attenuation_are_the_waves_and_a_room_has_none():
    for wave in (SOFT_PLATE, DampedWave(6.0, 150.0)):
        found = impulse_travel(plane_wave_bank(wave), span_mm=(20.0, 100.0))
        expected = travel_of_a_wave(wave, (50.0, 450.0), (20.0, 100.0))
        assert found.group_velocity_m_s == pytest.approx(expected.group_velocity_m_s, rel=0.02)
        assert found.attenuation_db_per_cm == pytest.approx(expected.attenuation_db_per_cm, rel=0.01)
        assert found.is_sure
        assert found.velocity_error_m_s < 0.1 * found.group_velocity_m_s
    # Sound that a room answers for tenths of a second, as at a few microphones close together.
    like = plane_wave_bank(SOFT_PLATE, taps=3000)
    tail = np.random.default_rng(0).standard_normal(like.values.shape) * np.exp(-np.arange(3000) / 600.0)
    greens = metrics.band_limited(tail, RATE_HZ, (50.0, 450.0))
    bank = GreenArray(greens, like.position_mm, RATE_HZ, actuator_mm=like.actuator_mm)
    assert not impulse_travel(bank).is_sure


# --- spots


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
    assert math.dist(peak.at_mm, (x, y)) < 0.01
    width = metrics.focal_width_mm(GRID_MM, field, peak.row, SPACING_MM)
    # 4.3 % is the worst of all places and widths: a spot of 9 mm between four positions.
    assert width == pytest.approx(fwhm, rel=0.045)


@pytest.mark.parametrize("pitch_mm", [(4.0, 5.0), (4.0, 6.0), (4.0, 8.0), (12.0, 12.0)])
def test_a_spot_on_a_rectangular_grid_or_next_to_a_check_position_is_found(pitch_mm):
    grid_mm = np.stack(np.meshgrid(*(pitch * np.arange(-10.0, 11.0) for pitch in pitch_mm)), axis=-1).reshape(-1, 2)
    if pitch_mm == (12.0, 12.0):
        grid_mm = np.append(grid_mm, [(2.0, -1.0)], axis=0)
    field = np.exp(-4.0 * math.log(2.0) * np.square((grid_mm - (1.1, 1.3)) / (3.0 * max(pitch_mm))).sum(axis=1))
    spot = metrics.focus_spot(grid_mm, field, (0.0, 0.0), 15.0, metrics.grid_spacing_mm(grid_mm))
    assert math.dist(spot.at_mm, (1.1, 1.3)) < 0.01
    assert spot.width_mm == pytest.approx(3.0 * max(pitch_mm), rel=0.045)
    hexagonal_mm = np.array([(4.0 * x + 2.0 * (y % 2), y * math.sqrt(12.0)) for x in range(9) for y in range(9)])
    assert metrics.grid_spacing_mm(hexagonal_mm) == pytest.approx(4.0)


def test_given_two_spots_then_the_one_within_the_radius_is_found_and_measured_alone():
    field = gaussian((-10.0, 0.0), 9.0) - 5.0 * gaussian((25.0, 0.0), 12.0)
    peak = metrics.focus_peak(GRID_MM, field, (-9.0, 1.0), 10.0)
    assert math.dist(peak.at_mm, (-10.0, 0.0)) < 0.6
    assert metrics.focal_width_mm(GRID_MM, field, peak.row, SPACING_MM) == pytest.approx(9.0, rel=0.04)


def test_given_a_spot_at_the_rim_or_too_few_positions_then_it_has_no_width():
    field = gaussian((40.0, 0.0), 10.0)
    assert metrics.focal_width_mm(GRID_MM, field, int(np.argmax(field)), SPACING_MM) is None
    few = [200, 201, 220, 221, 222, 240, 241]
    assert metrics.focal_width_mm(GRID_MM[few], gaussian((0.0, 0.0), 10.0)[few], 0, SPACING_MM) is None


def test_given_silence_then_the_figures_say_so_and_do_not_divide_by_it():
    silence, field = np.zeros((2, 3)), np.arange(6.0).reshape(2, 3)
    assert metrics.correlation(field, -0.9 * field) == pytest.approx(-1.0)
    assert metrics.normalised_error(silence, silence) == 0.0
    assert metrics.normalised_error(silence, field) == math.inf
    assert math.isnan(metrics.correlation(silence, field))
    assert metrics.level_db(0.0) == -math.inf


def test_given_gains_of_1_to_10_with_unmeasured_positions_then_the_range_is_20_db():
    assert metrics.range_db(np.array([1.0, 10.0, np.nan, np.inf, 0.0, 3.0])) == pytest.approx(20.0)
    assert math.isnan(metrics.range_db(np.array([np.nan, 2.0])))


def test_side_spot_of_tenth_then_artefact_level_is_minus_20_db():
    field = gaussian((0.0, 0.0), 9.0) - 0.1 * gaussian((32.0, 0.0), 9.0)
    spot = metrics.focus_spot(GRID_MM, field, (0.0, 0.0), 15.0, SPACING_MM)
    assert spot.artefact_db == pytest.approx(-20.0, abs=0.1)
    assert (spot.value, spot.off_mm) == (pytest.approx(1.0), pytest.approx(0.0, abs=0.01))
    assert spot.width_mm == pytest.approx(9.0, rel=0.045)
    assert math.isnan(metrics.artefact_level_db(GRID_MM, field, (0.0, 0.0), 500.0))
    assert metrics.focus_spot(GRID_MM, field, (200.0, 0.0), 15.0, SPACING_MM) is None
