"""Rows judged against their neighbours: what is wrong is found and named, and nothing else is."""

import numpy as np
import pytest

from tests.unit.plate_banks import ACTUATOR_MM, BAND_HZ, RATE_HZ, SQUARE_MM, TAPS, plate_bank, plate_greens
from wavefocus.benchmarks.plate import ThinPlate
from wavefocus.calibration.coarse_grid.left_out_rows import waves_of_rows
from wavefocus.calibration.neighbour_judge import RowsAtFrequencies, judge_rows

POSITIONS, ACTUATORS = len(SQUARE_MM), len(ACTUATOR_MM)
RNG = np.random.default_rng(4)


@pytest.fixture(scope="module")
def clean():
    bank = plate_bank(noise_db=-45.0)
    return np.stack([bank.green(position) for position in range(POSITIONS)])


def spectra_of(greens):
    spectra = RowsAtFrequencies(*greens.shape, RATE_HZ, BAND_HZ)
    for position, green in enumerate(greens):
        spectra.set(position, green)
    return spectra


def judged(greens, position_mm=SQUARE_MM, actuator_mm=ACTUATOR_MM):
    return judge_rows(position_mm, actuator_mm, spectra_of(greens), np.ones(len(greens), dtype=bool))


def found(verdict):
    return sorted((one.position, one.kind) for one in verdict.differences)


def test_faulty_neighbours_side_by_side_then_are_all_found_and_no_other(clean):
    greens = clean.copy()
    block = [83, 84, 97]
    greens[block, 4] *= 0.4
    assert [one.position for one in judged(greens).differences] == block


def test_where_positions_are_too_far_apart_then_nothing_is_judged():
    position_mm = SQUARE_MM * 6.0
    greens = RNG.standard_normal((POSITIONS, 3, TAPS))
    verdict = judged(greens, position_mm, np.full((3, 2), np.nan))
    assert verdict.differences == ()
    assert not verdict.judged.any()


def test_a_thin_ringing_plate_then_raises_no_alarm():
    plate = ThinPlate(0.3, 0.2, 1.57)
    points_m = (SQUARE_MM + np.array([150.0, 100.0])) / 1e3
    sources_m = np.array([[0.03, 0.04], [0.27, 0.15], [0.26, 0.03]])
    greens = plate.impulse_velocity(points_m, sources_m, TAPS, RATE_HZ, quality=60.0, band_hz=(30.0, 900.0))
    greens = greens + 1e-3 * greens.std() * RNG.standard_normal(greens.shape)
    actuator_mm = 1e3 * sources_m - [150.0, 100.0]
    assert judged(greens, SQUARE_MM, actuator_mm).differences == ()
    greens[60, 1] *= 0.5
    assert [one.position for one in judged(greens, SQUARE_MM, actuator_mm).differences] == [60]


def test_banks_in_any_unit_then_are_judged_alike(clean):
    greens = clean * 1e-30
    greens[84] *= 0.6
    assert found(judged(greens)) == [(84, "level")]


def test_rows_that_do_not_belong_together_then_are_not_judged():
    # Each row is a response as of a plate, and has nothing to do with those next to it.
    time_s = np.arange(TAPS) / RATE_HZ
    phases = np.random.default_rng(0).uniform(0, 6.3, (POSITIONS, ACTUATORS, 1))
    verdict = judged(np.exp(-time_s / 0.02) * np.sin(2 * np.pi * 150 * time_s + phases))
    assert verdict.differences == ()
    assert not verdict.judged.any()


COARSE_MM = np.stack(np.meshgrid(10.0 * np.arange(-4, 5), 10.0 * np.arange(-3, 4)), axis=-1).reshape(-1, 2)
CHECKS_MM = np.array([[-13.0, 4.0], [6.0, -17.0], [24.0, 13.0]])


@pytest.fixture(scope="module")
def coarse():
    """A grid of 10 mm, up to two wavelengths a spacing, and three positions off it."""
    bank = plate_bank(np.vstack([COARSE_MM, CHECKS_MM]), noise_db=-50.0)
    return np.stack([bank.green(position) for position in range(bank.positions)])


@pytest.mark.long
def test_wrong_rows_of_a_coarse_grid_then_are_named_as_on_a_fine_one_and_no_other(coarse):
    greens = coarse.copy()
    greens[12, 3] *= 0.4
    greens[22, [2, 7]] = greens[22, [7, 2]]
    place_mm = COARSE_MM[40] + [2.4, -3.2]
    greens[40] = plate_greens(place_mm[None])[0]
    greens[50] *= 0.6
    greens[len(COARSE_MM) + 1] *= -1
    on_grid, every = np.arange(len(greens)) < len(COARSE_MM), np.ones(len(greens), bool)
    verdict = judge_rows(np.vstack([COARSE_MM, CHECKS_MM]), ACTUATOR_MM, spectra_of(greens), on_grid, every)
    assert verdict.by_waves
    assert verdict.judged.mean() > 0.7
    assert found(verdict) == [(12, "level"), (22, "swapped"), (40, "elsewhere"), (50, "level"), (64, "polarity")]
    level, swap, _, whole, _ = verdict.differences
    assert (level.actuators, swap.actuators) == ((3,), (2, 7))
    assert (level.level_db, whole.level_db) == pytest.approx((-7.96, -4.44), abs=0.4)


@pytest.mark.long
def test_waves_that_leave_no_noise_or_none_at_all_then_judge_no_row(coarse):
    spectra, usable = spectra_of(coarse), np.ones(len(coarse), bool)
    position_mm = np.vstack([COARSE_MM, CHECKS_MM])
    on_grid = np.arange(len(coarse)) < len(COARSE_MM)
    waves = waves_of_rows(position_mm, ACTUATOR_MM, spectra.values, spectra.frequency_hz, usable)
    assert waves is not None
    exact = waves._replace(shares=waves.shares - np.array([0.0, 0.0, 60.0, 60.0]))
    for found in (exact, None):
        assert not judge_rows(position_mm, ACTUATOR_MM, spectra, on_grid, usable, lambda found=found: found).by_waves
