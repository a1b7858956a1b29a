"""Predicted fields against plain convolution, eqs. (4) and (17)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.drive_file import Drive
from calibration.errors import InputError
from rendering.field import measured_positions, predict, predict_rows
from rendering.green_source import GreenArray

NONE = np.zeros(0, np.int64)


def make_drive(volts, rate_hz=1000.0, start_s=-0.1):
    return Drive(np.asarray(volts, float), rate_hz, start_s, "exact", 1.0, 0.0, NONE, NONE, NONE)


def make_bank(values, **options):
    position_mm = np.stack([4.0 * np.arange(len(values)), np.zeros(len(values))], axis=1)
    return GreenArray(values, position_mm, 1000.0, **options)


def convolved(bank, drive, positions):
    return np.array(
        [
            sum(np.convolve(bank.values[p, i].astype(float), drive.drive_v[i]) for i in range(bank.actuators))
            for p in positions
        ]
    )


def relative_error(found, expected):
    assert found.shape == expected.shape
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@given(
    seed=st.integers(0, 2**31),
    positions=st.integers(1, 5),
    actuators=st.integers(1, 4),
    taps=st.integers(1, 200),
    samples=st.sampled_from([1, 7, 500, 9000, 20000]),
)
@settings(max_examples=20, deadline=None)
def test_a_field_is_the_full_convolution(seed, positions, actuators, taps, samples):
    rng = np.random.default_rng(seed)
    bank = make_bank(rng.standard_normal((positions, actuators, taps)))
    drive = make_drive(rng.standard_normal((actuators, samples)))
    expected = convolved(bank, drive, range(positions))
    assert relative_error(predict(drive, bank).field, expected) < 1e-12
    single = predict(drive, bank, dtype=np.float32)
    assert single.field.dtype == np.float32
    assert relative_error(single.field, expected) < 2e-6


def test_taps_longer_than_a_block_are_convolved_in_full():
    rng = np.random.default_rng(0)
    bank = make_bank(rng.standard_normal((2, 2, 9000)))
    drive = make_drive(rng.standard_normal((2, 70_000)))
    from scipy.signal import fftconvolve

    expected = np.array([fftconvolve(bank.values[p], drive.drive_v, axes=1).sum(axis=0) for p in range(2)])
    assert relative_error(predict(drive, bank).field, expected) < 1e-12


def test_a_field_starts_with_its_drive_and_has_the_banks_unit():
    bank = make_bank(np.ones((1, 1, 3)))
    field = predict(make_drive([[1.0, 2.0]], start_s=-0.002), bank)
    np.testing.assert_allclose(field.field, [[1, 3, 3, 2]])
    assert (field.start_s, field.sample_rate_hz, field.response_unit) == (-0.002, 1000.0, "m/s")


def test_positions_are_predicted_in_the_order_asked_for():
    rng = np.random.default_rng(0)
    bank = make_bank(rng.standard_normal((4, 2, 30)))
    drive = make_drive(rng.standard_normal((2, 50)))
    field = predict(drive, bank, [3, 0, 3])
    assert field.position_index.tolist() == [3, 0, 3]
    assert relative_error(field.field, convolved(bank, drive, [3, 0, 3])) < 1e-12


def test_unmeasured_positions_are_left_out_and_can_be_listed():
    bank = make_bank(np.ones((5, 1, 3)), status=np.array([1, 0, 4, 16, 8], np.uint8))
    assert predict(make_drive([[1.0]]), bank).position_index.tolist() == [0, 2]
    assert [rows.tolist() for rows in measured_positions(bank)] == [[0, 2], [1, 3, 4]]


def test_an_unmeasured_position_that_is_asked_for_is_refused_by_name():
    bank = make_bank(np.ones((5, 1, 3)), status=np.array([1, 0, 4, 16, 8], np.uint8))
    with pytest.raises(InputError, match="positions holds 1, 3: not measured"):
        predict(make_drive([[1.0]]), bank, [0, 1, 3])


def test_silent_actuators_add_nothing():
    rng = np.random.default_rng(0)
    bank = make_bank(rng.standard_normal((2, 3, 30)))
    volts = rng.standard_normal((3, 50))
    volts[1] = 0
    drive = make_drive(volts)
    assert relative_error(predict(drive, bank).field, convolved(bank, drive, range(2))) < 1e-12
    assert not predict(make_drive(np.zeros((3, 50))), bank).field.any()


def test_rows_come_as_a_stream_with_progress():
    rng = np.random.default_rng(0)
    bank = make_bank(rng.standard_normal((200, 2, 30)))
    drive = make_drive(rng.standard_normal((2, 50_000)))
    told, rows = [], []
    for part in predict_rows(drive, bank, dtype=np.float64, on_progress=lambda *count: told.append(count)):
        assert part.first == len(rows)
        rows.extend(part.field)
    assert told[-1] == (200, 200)
    assert len(told) > 1
    np.testing.assert_array_equal(rows, predict(drive, bank).field)


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**100])
def test_single_precision_holds_any_unit(scale):
    rng = np.random.default_rng(0)
    bank = make_bank(rng.standard_normal((2, 2, 30)) * scale)
    drive = make_drive(rng.standard_normal((2, 50)) / scale)
    field = predict(drive, bank, dtype=np.float32)
    assert relative_error(field.field, convolved(bank, drive, range(2))) < 2e-6


@pytest.mark.parametrize(
    ("drive", "positions", "message"),
    [
        (make_drive(np.ones((2, 5))), None, "the drive has 2 actuators, the bank 1"),
        (make_drive([[1.0]], rate_hz=2000.0), None, "the drive is at 2000 Hz"),
        (make_drive([[1.0]]), [], "positions is empty"),
        (make_drive([[1.0]]), [0, 7], "positions holds 7; allowed are 0 to 1"),
        (make_drive([[1.0]]), [-1], "positions holds -1"),
        (make_drive([[1e300]]), None, "does not fit into float64"),
    ],
)
def test_what_does_not_fit_the_bank_is_refused(drive, positions, message):
    with pytest.raises(InputError, match=message):
        predict(drive, make_bank(np.full((2, 1, 3), 1e100)), positions)


def test_a_bank_without_a_measured_row_is_refused():
    with pytest.raises(InputError, match="no measured position"):
        predict(make_drive([[1.0]]), make_bank(np.ones((2, 1, 3)), status=np.zeros(2, np.uint8)))


def test_another_precision_is_refused():
    with pytest.raises(InputError, match="dtype is float16"):
        predict(make_drive([[1.0]]), make_bank(np.ones((2, 1, 3))), dtype=np.float16)
