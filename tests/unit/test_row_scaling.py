"""Rows scaled side by side are scaled as each by itself, and rows out of the ordinary are left to that."""

from __future__ import annotations

import numpy as np
import pytest

from rendering.greens.bank_rows import BankRows
from rendering.greens.row_scaling import look_at_rows, scale_row, scale_together
from rendering.greens.source import GreenArray
from rendering.inner_loops import inner_loops
from rendering.scene.model import Regularisation
from storage.errors import InputError

ACTUATORS, TAPS = 3, 40
POSITION_MM = np.stack([4.0 * np.arange(6), np.zeros(6)], axis=1)


def make_rows(seed: int = 0) -> np.ndarray:
    """Rows of either sign, from 1e-30 to 1e30."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0.01, 1.0, (6, ACTUATORS, TAPS)) * rng.choice([-1.0, 1.0], (6, ACTUATORS, TAPS))
    return (rows * np.logspace(-30, 30, 6)[:, None, None]).astype(np.float32)


@pytest.mark.parametrize("into", [np.float32, np.float64])
@pytest.mark.parametrize("lie", [lambda rows: rows, lambda rows: rows[:, :, ::-1], lambda rows: rows[::-1, ::-1]])
def test_given_plain_rows_then_each_is_scaled_as_by_itself(into, lie):
    raws = list(make_rows())
    found = np.empty((6, ACTUATORS, TAPS), dtype=into)
    exponents = scale_together(raws, lie(found))
    expected = [scale_row(raw, number, single=into == np.float32) for number, raw in enumerate(raws)]
    assert exponents.tolist() == [row.exponent for row in expected]
    np.testing.assert_array_equal(lie(found), [row.values for row in expected])
    np.testing.assert_array_equal(raws, make_rows())
    assert ((np.abs(found).max(axis=(1, 2)) >= 0.5) & (np.abs(found).max(axis=(1, 2)) < 1.0)).all()


@pytest.mark.parametrize("odd", [0.0, np.nan, np.inf, -np.inf, 1e-40])
def test_given_a_row_out_of_the_ordinary_then_each_needs_a_look_by_itself(odd):
    rows = make_rows()
    rows[3] = odd
    assert scale_together(list(rows), np.empty(rows.shape)) is None


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int16, ">f4"])
def test_given_a_row_of_another_type_then_each_needs_a_look_by_itself(dtype):
    rows = list(np.ones((3, ACTUATORS, TAPS), dtype=np.float32))
    rows[1] = rows[1].astype(dtype)
    assert scale_together(rows, np.empty((3, ACTUATORS, TAPS))) is None


def make_bank(values: np.ndarray, **more) -> GreenArray:
    return GreenArray(values, POSITION_MM, 1000.0, **more)


@pytest.mark.parametrize("into", [np.float32, np.float64])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16, np.int16, ">f4"])
@pytest.mark.parametrize("regularisation", [Regularisation(), Regularisation(saturation_absolute=0.2, normalise=False)])
def test_given_rows_read_together_then_values_and_weights_are_those_of_each_read_by_itself(dtype, into, regularisation):
    values = (100 * np.random.default_rng(1).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS))).astype(dtype)
    values[2, 1] = 0
    alone, together = (BankRows(make_bank(values), regularisation) for _ in range(2))
    found = np.empty((4, ACTUATORS, TAPS), dtype=into)
    together.read_together([4, 0, 2, 5], found)
    np.testing.assert_array_equal(found, [alone.read(row, single=into == np.float32).values for row in (4, 0, 2, 5)])
    rows = np.array([4, 0, 2, 5])
    for got, expected in zip(together.weigh(rows, rows[::-1]), alone.weigh(rows, rows[::-1]), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-14)
    np.testing.assert_allclose(together.norm_of(rows), alone.norm_of(rows), rtol=1e-14)
    for row in rows.tolist():
        np.testing.assert_allclose(
            *(bank.sigma(row) if bank.sigma(row) is not None else 1.0 for bank in (together, alone))
        )
    assert together.silent_actuators == alone.silent_actuators == []


def test_given_an_actuator_silent_in_all_rows_read_together_then_it_is_known():
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS)).astype(np.float32)
    values[:, 1] = 0
    rows = BankRows(make_bank(values), Regularisation())
    rows.read_together([1, 3], np.empty((2, ACTUATORS, TAPS), dtype=np.float32))
    assert rows.silent_actuators == [1]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda values, status: values.__setitem__((3, 1, 7), np.nan), "position 3, actuator 1 of the bank holds NaN"),
        (lambda values, status: values.__setitem__(3, 0.0), r"position 3 at \(12, 0\) mm is all zeros"),
        (lambda values, status: status.__setitem__(3, 16), r"position 3 at \(12, 0\) mm is disabled"),
    ],
)
def test_given_a_row_that_may_not_be_used_among_others_then_it_is_named(spoil, told):
    values, status = make_rows(), np.ones(6, dtype=np.uint8)
    spoil(values, status)
    rows = BankRows(make_bank(values, status=status), Regularisation())
    with pytest.raises(InputError, match=told):
        rows.read_together([1, 3, 5], np.empty((3, ACTUATORS, TAPS), dtype=np.float32))


def test_given_plain_rows_then_a_look_tells_what_scaling_each_by_itself_tells():
    raws = list(make_rows())
    for raw, row in zip(raws, look_at_rows(raws, 25, inner_loops()), strict=True):
        scaled = scale_row(raw, 0)
        assert row.exponent == scaled.exponent
        np.testing.assert_array_equal(row.values, raw)
        squares = np.square(scaled.values)
        np.testing.assert_allclose(row.energies[0], squares[:, :25].sum(axis=1), rtol=1e-13)
        np.testing.assert_allclose(row.energies[1], squares[:, 25:].sum(axis=1), rtol=1e-13)


@pytest.mark.parametrize("odd", [0.0, np.nan, np.inf, -np.inf, 1e-40])
def test_given_a_row_out_of_the_ordinary_then_a_look_does_not_do(odd):
    rows = make_rows()
    rows[3] = odd
    assert look_at_rows(list(rows), TAPS, inner_loops()) is None


def test_given_values_that_scaling_makes_denormal_then_a_look_does_not_do():
    row = np.full((ACTUATORS, TAPS), 1e30, dtype=np.float32)
    row[1, 7] = 1e-20
    assert look_at_rows([row], TAPS, inner_loops()) is None


@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int16, ">f4"])
def test_given_a_row_of_another_type_then_a_look_does_not_do(dtype):
    assert look_at_rows([np.ones((ACTUATORS, TAPS), dtype=dtype)], TAPS, inner_loops()) is None


def test_given_a_row_that_lies_backwards_or_askew_then_a_look_sees_it_as_it_is():
    row = make_rows()[2]
    askew = np.frombuffer(b"x" + row.tobytes(), dtype=np.float32, offset=1).reshape(row.shape)
    for raw in (row[::-1, ::-1], askew, np.asfortranarray(row)):
        np.testing.assert_array_equal(look_at_rows([raw], TAPS, inner_loops())[0].values, raw)


@pytest.mark.parametrize(
    "regularisation", [Regularisation(), Regularisation(normalise=False), Regularisation(saturation_absolute=0.5)]
)
def test_given_rows_looked_at_then_their_weights_are_those_of_rows_that_are_read(regularisation):
    bank = make_bank(np.random.default_rng(2).uniform(-1.0, 1.0, (6, ACTUATORS, TAPS)).astype(np.float32))
    looked_at, read = BankRows(bank, regularisation), BankRows(bank, regularisation)
    rows = np.array([4, 0, 2])
    assert looked_at.look_together(rows.tolist(), TAPS, inner_loops()) is not None
    for row in rows.tolist():
        read.read(row)
        assert (looked_at.sigma(row) is None) == (read.sigma(row) is None)
        if read.sigma(row) is not None:
            np.testing.assert_allclose(looked_at.sigma(row), read.sigma(row), rtol=1e-12)
    for found, expected in zip(looked_at.weigh(rows, rows), read.weigh(rows, rows), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_allclose(looked_at.norm_of(rows), read.norm_of(rows), rtol=1e-12)
    assert looked_at.silent_actuators == read.silent_actuators


def test_given_a_row_that_may_not_be_used_then_none_of_them_is_looked_at():
    bank = make_bank(make_rows(), status=np.array([1, 1, 0, 1, 1, 1]))
    assert BankRows(bank, Regularisation()).look_together([1, 2], TAPS, inner_loops()) is None
