"""Rows scaled by powers of two, and the rows that a scene visits."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenArray, scale_row
from wavefocus.storage.errors import InputError

ACTUATORS, TAPS = 3, 40
POSITION_MM = np.stack([4.0 * np.arange(6), np.zeros(6)], axis=1)


def make_rows(seed: int = 0) -> np.ndarray:
    """Rows of either sign, from 1e-30 to 1e30."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.01, 1.0, (6, ACTUATORS, TAPS)) * rng.choice([-1.0, 1.0], (6, ACTUATORS, TAPS))
    return (rows * np.logspace(-30, 30, 6)[:, None, None]).astype(np.float32)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, ">f4"])
def test_given_a_row_of_any_size_then_it_is_scaled_without_rounding(dtype):
    for number, raw in enumerate(make_rows().astype(dtype)):
        row = scale_row(raw, number)
        assert 0.5 <= np.abs(row.values).max() < 1.0
        np.testing.assert_array_equal(np.ldexp(row.values, row.exponent), raw)


def test_given_denormal_numbers_then_single_precision_holds_none():
    raw = np.full((ACTUATORS, TAPS), 1e-40, np.float32)
    raw[0, 0] = 1.0
    row = scale_row(raw, 0, single=True)
    assert row.values.dtype == np.float32
    assert set(np.unique(row.values)) == {0.0, 0.5}
    alone = scale_row(raw[1:], 0)
    np.testing.assert_array_equal(np.ldexp(alone.values, alone.exponent), raw[1:].astype(np.float64))


def make_bank(values: np.ndarray, **more) -> GreenArray:
    return GreenArray(values, POSITION_MM, 1000.0, **more)


def test_given_rows_read_then_their_weights_are_those_of_the_equations():
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS))
    rows = BankRows(make_bank(values), Regularisation(saturation_absolute=0.55))
    factors, saturated = rows.weigh(np.array([4, 0]), np.array([2, 0]))
    rms = np.sqrt(np.square(values).mean(axis=2))
    sigma = np.minimum(1.0, 0.55 / rms)
    for place, (row, by) in enumerate(((4, 2), (0, 0))):
        scale = np.abs(values[row]).max() / np.abs(rows.read(row).values).max()
        assert factors[place] == pytest.approx(scale / (sigma[by] @ np.square(values[by]).sum(axis=1)), rel=1e-12)
        assert saturated[place] == (sigma[by] < 1).any()
        np.testing.assert_allclose(rows.sigma(by) if saturated[place] else 1.0, sigma[by], rtol=1e-12)
    assert rows.used == [0, 2, 4]


def test_given_an_actuator_silent_in_all_rows_read_then_it_is_listed():
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS))
    values[:, 1] = 0
    rows = BankRows(make_bank(values), Regularisation())
    assert rows.silent_actuators == []
    rows.read(3)
    assert rows.silent_actuators == [1]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda values, status: values.__setitem__((3, 1, 7), np.nan), "position 3, actuator 1 of the bank holds NaN"),
        (lambda values, status: values.__setitem__(3, 0.0), r"position 3 at \(12, 0\) mm is all zeros"),
        (lambda values, status: status.__setitem__(3, 16), r"position 3 at \(12, 0\) mm is disabled"),
    ],
)
def test_given_a_row_that_may_not_be_used_then_it_is_named(spoil, message):
    values, status = make_rows(), np.ones(6, dtype=np.uint8)
    spoil(values, status)
    with pytest.raises(InputError, match=message):
        BankRows(make_bank(values, status=status), Regularisation()).read(3)
