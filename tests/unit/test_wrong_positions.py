"""Rows judged against their neighbours, on plates that no constant was chosen on: what is wrong is found and named."""

from functools import cache

import numpy as np
import pytest

from tests.unit.independent_plates import MAKERS, places, responses
from tests.unit.plate_banks import ACTUATOR_MM, plate_bank, plate_greens
from wavefocus.benchmarks.plate import ThinPlate
from wavefocus.calibration.coarse_grid.left_out_rows import waves_of_rows
from wavefocus.calibration.neighbour_judge import RowsAtFrequencies, judge_rows

RATE_HZ, BAND_HZ, TAPS, SPACING_MM = 2000.0, (50.0, 450.0), 128, 4.0
KINDS = {
    "reversed": "polarity",
    "swapped": "swapped",
    "half a spacing off": "elsewhere",
    "3 dB fainter": "level",
    "3 dB louder": "level",
    "6 dB louder in one row": "level",
}


@cache
def plate(name):
    grid, actuator_mm = places(name, SPACING_MM)
    return grid, actuator_mm, responses(name, grid, actuator_mm, RATE_HZ, TAPS, BAND_HZ)


def noisy(green, snr_db):
    noise = np.random.default_rng(1).standard_normal(green.shape)
    return green + 10 ** (-snr_db / 20) * np.sqrt(np.mean(green**2)) * noise


def spectra_of(greens, band_hz=BAND_HZ):
    spectra = RowsAtFrequencies(*greens.shape, RATE_HZ, band_hz)
    for position, green in enumerate(greens):
        spectra.set(position, green)
    return spectra


def judged(greens, position_mm, actuator_mm, band_hz=BAND_HZ):
    return judge_rows(position_mm, actuator_mm, spectra_of(greens, band_hz), np.ones(len(greens), dtype=bool))


def spoil(name, kind, greens, position, rng):
    if kind == "reversed":
        greens[position] *= -1
    elif kind == "swapped":
        greens[position, [1, 4]] = greens[position, [4, 1]]
    elif kind == "half a spacing off":
        grid, actuator_mm, _ = plate(name)
        angle = rng.uniform(0, 2 * np.pi)
        place = grid[[position]] + 0.5 * SPACING_MM * np.array([[np.cos(angle), np.sin(angle)]])
        made = [responses(name, some, actuator_mm, RATE_HZ, TAPS, BAND_HZ)[0] for some in (place, grid[[position]])]
        greens[position] = made[0] * np.sqrt(np.mean(greens[position] ** 2) / np.mean(made[1] ** 2))
    elif "row" in kind:
        greens[position, 3] *= 10 ** (6 / 20)
    else:
        greens[position] *= 10 ** ((-3 if "fainter" in kind else 3) / 20)


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        *(pytest.param(name, tuple(KINDS), id=f"{name}-all", marks=pytest.mark.long) for name in ("disk", "elements")),
        *(pytest.param(name, (kind,) * 8, marks=pytest.mark.nightly) for name in MAKERS for kind in KINDS),
    ],
)
def test_wrong_positions_are_found_and_named_and_no_other(name, kinds):
    rng = np.random.default_rng(5)
    grid, actuator_mm, green = plate(name)
    # Rows near their own actuator are not judged singly.
    clear = np.hypot(*(grid[:, None] - actuator_mm[[1, 3, 4]]).transpose(2, 0, 1)).min(axis=1) > 5 * SPACING_MM
    wrong = rng.choice(np.flatnonzero(clear), len(kinds), replace=False).tolist()
    greens = noisy(green, 40.0)
    for position, kind in zip(wrong, kinds, strict=True):
        spoil(name, kind, greens, position, rng)
    verdict = judged(greens, grid, actuator_mm)
    assert verdict.judged.mean() > 0.5
    expected = sorted((position, KINDS[kind]) for position, kind in zip(wrong, kinds, strict=True))
    assert [(one.position, one.kind) for one in verdict.differences] == expected


@pytest.mark.nightly
@pytest.mark.parametrize("snr_db", [25.0, 80.0])
@pytest.mark.parametrize("name", MAKERS)
def test_a_right_plate_has_no_differences(name, snr_db):
    grid, actuator_mm, green = plate(name)
    verdict = judged(noisy(green, snr_db), grid, actuator_mm)
    assert verdict.differences == ()
    assert verdict.judged.mean() > 0.5


SMALL_MM = SPACING_MM * np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5)), axis=-1).reshape(-1, 2)
RNG = np.random.default_rng(4)


def test_wrong_rows_side_by_side_are_found_in_a_bank_of_any_unit():
    bank = plate_bank(SMALL_MM, noise_db=-45.0)
    greens, block = 1e-30 * bank.values, [39, 40, 49]
    greens[block, 4] *= 0.4
    found = judged(greens, SMALL_MM, ACTUATOR_MM, bank.band_hz).differences
    assert [(one.position, one.kind) for one in found] == [(position, "level") for position in block]


@pytest.mark.long
def test_a_thin_ringing_plate_then_raises_no_alarm():
    points_m, sources_m = SMALL_MM / 1e3 + [0.15, 0.1], np.array([[0.03, 0.04], [0.27, 0.15], [0.26, 0.03]])
    greens = ThinPlate(0.3, 0.2, 1.57).impulse_velocity(
        points_m, sources_m, 256, RATE_HZ, quality=60.0, band_hz=(30.0, 900.0)
    )
    greens = greens + 1e-3 * greens.std() * RNG.standard_normal(greens.shape)
    actuator_mm = 1e3 * sources_m - [150.0, 100.0]
    assert judged(greens, SMALL_MM, actuator_mm, (50.0, 500.0)).differences == ()
    greens[30, 1] *= 0.5
    found = judged(greens, SMALL_MM, actuator_mm, (50.0, 500.0)).differences
    assert [one.position for one in found] == [30]


# Each row is a response as of a plate, and has nothing to do with those next to it.
TIME_S = np.arange(256) / RATE_HZ
UNRELATED = np.exp(-TIME_S / 0.02) * np.sin(2 * np.pi * 150 * TIME_S + RNG.uniform(0, 6.3, (len(SMALL_MM), 3, 1)))


@pytest.mark.parametrize(
    ("greens", "spread"),
    [(RNG.standard_normal((len(SMALL_MM), 3, 256)), 6.0), (UNRELATED, 1.0)],
    ids=["positions too far apart", "rows that do not belong together"],
)
def test_rows_of_which_neighbours_say_nothing_are_not_judged(greens, spread):
    verdict = judged(greens, spread * SMALL_MM, np.full((3, 2), np.nan))
    assert verdict.differences == ()
    assert not verdict.judged.any()


COARSE_MM = np.stack(np.meshgrid(10.0 * np.arange(-4, 5), 10.0 * np.arange(-3, 4)), axis=-1).reshape(-1, 2)
PLACES_MM = np.vstack([COARSE_MM, [[-13.0, 4.0], [6.0, -17.0], [24.0, 13.0]]])
ON_GRID = np.arange(len(PLACES_MM)) < len(COARSE_MM)


@pytest.fixture(scope="module")
def coarse():
    """A grid of 10 mm, up to two wavelengths a spacing, and three positions off it."""
    return plate_bank(PLACES_MM, noise_db=-50.0)


@pytest.mark.long
def test_wrong_rows_of_a_coarse_grid_then_are_named_as_on_a_fine_one_and_no_other(coarse):
    greens, every = coarse.values.copy(), np.ones(len(PLACES_MM), bool)
    greens[12, 3] *= 0.4
    greens[22, [2, 7]] = greens[22, [7, 2]]
    greens[40] = plate_greens(COARSE_MM[[40]] + [2.4, -3.2])[0]
    greens[50] *= 0.6
    greens[len(COARSE_MM) + 1] *= -1
    verdict = judge_rows(PLACES_MM, ACTUATOR_MM, spectra_of(greens, coarse.band_hz), ON_GRID, every)
    assert verdict.by_waves
    assert verdict.judged.mean() > 0.7
    found = [(one.position, one.kind) for one in verdict.differences]
    assert found == [(12, "level"), (22, "swapped"), (40, "elsewhere"), (50, "level"), (64, "polarity")]
    level, swap, _, whole, _ = verdict.differences
    assert (level.actuators, swap.actuators) == ((3,), (2, 7))
    assert (level.level_db, whole.level_db) == pytest.approx((-7.96, -4.44), abs=0.4)


@pytest.mark.long
def test_waves_that_leave_no_noise_or_none_at_all_then_judge_no_row(coarse):
    spectra, usable = spectra_of(coarse.values, coarse.band_hz), np.ones(len(PLACES_MM), bool)
    waves = waves_of_rows(PLACES_MM, ACTUATOR_MM, spectra.values, spectra.frequency_hz, usable)
    exact = waves._replace(shares=waves.shares - np.array([0.0, 0.0, 60.0, 60.0]))
    for found in (exact, None):
        assert not judge_rows(PLACES_MM, ACTUATOR_MM, spectra, ON_GRID, usable, lambda found=found: found).by_waves
