"""The rows that a scene visits."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.storage.errors import InputError

ACTUATORS, TAPS = 3, 40
POSITION_MM = np.stack([4.0 * np.arange(6), np.zeros(6)], axis=1)


def make_bank(values: np.ndarray, **more) -> GreenArray:
    return GreenArray(values, POSITION_MM, 1000.0, **more)


def test_given_rows_read_then_their_weights_are_those_of_the_equations():
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS))
    rows = BankRows(make_bank(values), Regularisation(saturation_absolute=0.55))
    factors, saturated = rows.weigh(np.array([2, 0]))
    rms = np.sqrt(np.square(values).mean(axis=2))
    sigma = np.minimum(1.0, 0.55 / rms)
    for place, by in enumerate((2, 0)):
        assert factors[place] == pytest.approx(1.0 / (sigma[by] @ np.square(values[by]).sum(axis=1)), rel=1e-12)
        assert saturated[place] == (sigma[by] < 1).any()
        np.testing.assert_allclose(rows.sigma(by) if saturated[place] else 1.0, sigma[by], rtol=1e-12)
    assert rows.used == [0, 2]


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
    values, status = np.ones((6, ACTUATORS, TAPS)), np.ones(6, dtype=np.uint8)
    spoil(values, status)
    with pytest.raises(InputError, match=message):
        BankRows(make_bank(values, status=status), Regularisation()).read(3)
