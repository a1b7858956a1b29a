"""Positions that are wrong, on plates that no constant was chosen on: all are found, and nothing else is."""

from functools import cache

import numpy as np
import pytest

from tests.unit.independent_plates import MAKERS, places, responses
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
def _plate(name):
    grid, actuator_mm = places(name, SPACING_MM)
    return grid, actuator_mm, responses(name, grid, actuator_mm, RATE_HZ, TAPS, BAND_HZ)


def _noisy(green, snr_db, seed):
    noise = np.random.default_rng(seed).standard_normal(green.shape)
    return green + 10 ** (-snr_db / 20) * np.sqrt(np.mean(green**2)) * noise


def _judged(name, greens):
    grid, actuator_mm, _ = _plate(name)
    spectra = RowsAtFrequencies(*greens.shape, RATE_HZ, BAND_HZ)
    for position, green in enumerate(greens):
        spectra.set(position, green)
    return judge_rows(grid, actuator_mm, spectra, np.ones(len(grid), dtype=bool))


def _spoilt(name, kind, greens, position, rng):
    if kind == "reversed":
        greens[position] *= -1
    elif kind == "swapped":
        greens[position, [1, 4]] = greens[position, [4, 1]]
    elif kind == "half a spacing off":
        grid, actuator_mm, _ = _plate(name)
        angle = rng.uniform(0, 2 * np.pi)
        place = grid[[position]] + 0.5 * SPACING_MM * np.array([[np.cos(angle), np.sin(angle)]])
        made = [responses(name, some, actuator_mm, RATE_HZ, TAPS, BAND_HZ)[0] for some in (place, grid[[position]])]
        greens[position] = made[0] * np.sqrt(np.mean(greens[position] ** 2) / np.mean(made[1] ** 2))
    elif "row" in kind:
        greens[position, 3] *= 10 ** (6 / 20)
    else:
        greens[position] *= 10 ** ((-3 if "fainter" in kind else 3) / 20)


def some_of(values):
    """Each plate with each value; one plate at once, the rest and finite elements with `make test-all`."""
    plates = list(MAKERS)
    return [
        pytest.param(name, value, marks=() if name == plates[number % len(plates)] != "elements" else pytest.mark.long)
        for number, value in enumerate(values)
        for name in plates
    ]


@pytest.mark.parametrize(("name", "kind"), some_of(KINDS))
def test_eight_wrong_positions_are_found_and_named_and_no_other(name, kind):
    rng = np.random.default_rng(5)
    grid, actuator_mm, green = _plate(name)
    # Rows near their own actuator are not judged singly.
    clear = np.hypot(*(grid[:, None] - actuator_mm[[1, 3, 4]]).transpose(2, 0, 1)).min(axis=1) > 5 * SPACING_MM
    wrong = np.sort(rng.choice(np.flatnonzero(clear), 8, replace=False)).tolist()
    greens = _noisy(green, 40.0, 1)
    for position in wrong:
        _spoilt(name, kind, greens, position, rng)
    found = _judged(name, greens).differences
    assert [one.position for one in found] == wrong
    assert {one.kind for one in found} == {KINDS[kind]}


@pytest.mark.parametrize(("name", "snr_db"), some_of([25.0, 40.0, 80.0]))
def test_a_right_plate_has_no_differences(name, snr_db):
    verdict = _judged(name, _noisy(_plate(name)[2], snr_db, 1))
    assert verdict.differences == ()
    assert verdict.judged.mean() > 0.5
