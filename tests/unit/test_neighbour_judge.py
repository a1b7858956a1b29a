"""Rows judged against their neighbours: what is wrong is found and named, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.plate_banks import ACTUATOR_MM, BAND_HZ, RATE_HZ, SQUARE_MM, TAPS, plate_bank
from wavefocus.calibration.neighbour_judge import NeighbourJudge, NeighbourResult, RowsAtFrequencies
from wavefocus.mocks.plates.thin import ThinPlate

POSITIONS, ACTUATORS = len(SQUARE_MM), len(ACTUATOR_MM)
RNG = np.random.default_rng(4)
FAULTY = np.sort(RNG.choice(POSITIONS, 10, replace=False)).tolist()


@pytest.fixture(scope="module")
def clean() -> np.ndarray:
    bank = plate_bank(noise_db=-45.0)
    return np.stack([bank.green(position) for position in range(POSITIONS)])


def judged(
    greens: np.ndarray, position_mm: np.ndarray = SQUARE_MM, actuator_mm: np.ndarray = ACTUATOR_MM
) -> NeighbourResult:
    spectra = RowsAtFrequencies(len(greens), greens.shape[1], greens.shape[2], RATE_HZ, BAND_HZ)
    for position, green in enumerate(greens):
        spectra.set(position, green)
    return NeighbourJudge(position_mm, actuator_mm, spectra, np.ones(len(greens), dtype=bool)).find()


def delayed(rows: np.ndarray, delay_s: float) -> np.ndarray:
    turns = np.fft.rfftfreq(TAPS, 1.0 / RATE_HZ) * delay_s
    return np.fft.irfft(np.fft.rfft(rows) * np.exp(-2j * np.pi * turns), TAPS)


def found(verdict: NeighbourResult) -> list[tuple[int, str]]:
    return sorted((one.position, one.kind) for one in verdict.differences)


def test_a_clean_plate_then_has_no_differences_and_is_judged_to_its_rim(clean: np.ndarray) -> None:
    verdict = judged(clean)
    assert verdict.differences == ()
    assert verdict.judged.mean() > 0.99


@pytest.mark.parametrize("level_db", [-0.5, -3.0, 6.0])
def test_single_rows_of_another_level_then_are_found_with_it(clean: np.ndarray, level_db: float) -> None:
    greens = clean.copy()
    for number, position in enumerate(FAULTY):
        greens[position, number % ACTUATORS] *= 10 ** (level_db / 20)
    verdict = judged(greens)
    assert found(verdict) == [(position, "level") for position in FAULTY]
    assert [one.actuators for one in verdict.differences] == [(number % ACTUATORS,) for number in range(10)]
    assert [one.level_db for one in verdict.differences] == pytest.approx([level_db] * 10, abs=0.2)


@pytest.mark.parametrize("level_db", [-1.0, -20.0])
def test_whole_positions_of_another_level_then_are_one_difference_each(clean: np.ndarray, level_db: float) -> None:
    greens = clean.copy()
    greens[FAULTY] *= 10 ** (level_db / 20)
    verdict = judged(greens)
    assert found(verdict) == [(position, "level") for position in FAULTY]
    assert all(one.whole for one in verdict.differences)


@pytest.mark.parametrize("level_db", [-0.3, -1.0, -3.0, -20.0])
def test_whole_positions_of_another_level_side_by_side_then_are_all_found_and_no_other(
    clean: np.ndarray, level_db: float
) -> None:
    greens = clean.copy()
    wrong = [30, 31, 57, 70, 84, 98, 110, 111, 123, 137]
    greens[wrong] *= 10 ** (level_db / 20)
    assert found(judged(greens)) == [(position, "level") for position in wrong]


def test_reversed_late_and_swapped_rows_then_are_named(clean: np.ndarray) -> None:
    greens = clean.copy()
    greens[20, 3] *= -1
    greens[75, 1] = delayed(greens[75, 1], 1e-3)
    greens[123, [2, 7]] = greens[123, [7, 2]]
    verdict = judged(greens)
    assert found(verdict) == [(20, "polarity"), (75, "delay"), (123, "swapped")]
    assert verdict.differences[1].delay_s == pytest.approx(1e-3, abs=2e-5)
    assert verdict.differences[2].actuators == (2, 7)


def test_a_position_measured_elsewhere_then_is_told_where(clean: np.ndarray) -> None:
    greens = clean.copy()
    greens[84] = clean[20]
    (one,) = judged(greens[:, ::2], actuator_mm=ACTUATOR_MM[::2]).differences
    assert (one.position, one.kind, one.whole) == (84, "elsewhere", True)
    assert one.place_mm == pytest.approx(tuple(SQUARE_MM[20]), abs=2.0)


def test_faulty_neighbours_side_by_side_then_are_all_found_and_no_other(clean: np.ndarray) -> None:
    greens = clean.copy()
    block = [83, 84, 97]
    greens[block, 4] *= 0.7
    assert [one.position for one in judged(greens).differences] == block


def test_where_positions_are_too_far_apart_then_nothing_is_judged() -> None:
    position_mm = SQUARE_MM * 6.0
    greens = RNG.standard_normal((POSITIONS, 3, TAPS))
    verdict = judged(greens, position_mm, np.full((3, 2), np.nan))
    assert verdict.differences == ()
    assert not verdict.judged.any()


def test_a_thin_ringing_plate_then_raises_no_alarm() -> None:
    plate = ThinPlate(0.3, 0.2, 1.57)
    points_m = (SQUARE_MM + np.array([150.0, 100.0])) / 1e3
    sources_m = np.array([[0.03, 0.04], [0.27, 0.15], [0.26, 0.03]])
    greens = plate.impulse_velocity(points_m, sources_m, TAPS, RATE_HZ, quality=60.0, band_hz=(30.0, 900.0))
    greens = greens + 1e-3 * greens.std() * RNG.standard_normal(greens.shape)
    verdict = judged(greens, SQUARE_MM, 1e3 * sources_m - [150.0, 100.0])
    assert verdict.differences == ()
    greens[60, 1] *= 0.9
    assert [one.position for one in judged(greens, SQUARE_MM, 1e3 * sources_m - [150.0, 100.0]).differences] == [60]


def test_banks_in_any_unit_then_are_judged_alike(clean: np.ndarray) -> None:
    greens = clean * 1e-30
    greens[84] *= 0.8
    assert found(judged(greens)) == [(84, "level")]


def test_rows_that_do_not_belong_together_then_are_called_so_and_none_is_judged() -> None:
    # Each row is a response as of a plate, and has nothing to do with those next to it.
    time_s = np.arange(TAPS) / RATE_HZ
    phases = np.random.default_rng(0).uniform(0, 0.8, (POSITIONS, ACTUATORS, 1))
    verdict = judged(np.exp(-time_s / 0.02) * np.sin(2 * np.pi * 150 * time_s + phases))
    assert verdict.incoherent
    assert verdict.differences == ()
    assert not verdict.judged.any()
