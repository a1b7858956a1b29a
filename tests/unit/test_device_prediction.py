"""Fields by the array API: on any namespace that follows the standard, and on a GPU where there is one."""

from __future__ import annotations

import importlib.util

import array_api_strict
import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from rendering.device import Device, cuda_device, host_device
from rendering.field.prediction import Prediction
from rendering.greens.source import GreenArray
from storage.drive_file import Drive
from storage.errors import InputError

STRICT = Device("strict", array_api_strict, np.from_dlpack, 2**16)


def drive_of(drive_v: np.ndarray) -> Drive:
    none = np.zeros(0, np.int64)
    return Drive(drive_v, 2000.0, 0.0, "sampled", 1.0, 0.0, none, none, none)


def direct(bank: GreenArray, drive: Drive, positions: list[int]) -> np.ndarray:
    rows = [bank.values[position].astype(np.float64) for position in positions]
    return np.array(
        [
            sum(
                scipy.signal.convolve(one, volts, method="direct")
                for one, volts in zip(row, drive.drive_v, strict=True)
            )
            for row in rows
        ]
    )


def field_of(bank: GreenArray, drive: Drive, positions: list[int], device: Device) -> np.ndarray:
    prediction = Prediction(drive, bank, positions, dtype=np.float64, device=device)
    parts = list(prediction.rows())
    assert [one for part in parts for one in part.position_index] == positions
    return np.concatenate([part.field for part in parts])


@given(st.integers(1, 40), st.integers(1, 300), st.integers(1, 4), st.integers(-200, 100), st.integers(0, 2**32))
def test_given_any_bank_and_drive_then_the_standard_alone_gives_the_field(
    taps: int, samples: int, actuators: int, decade: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    bank = GreenArray(random.standard_normal((3, actuators, taps)) * 10.0**decade, np.zeros((3, 2)), 2000.0)
    drive = drive_of(random.standard_normal((actuators, samples)))
    expected = direct(bank, drive, [2, 0])
    scale = np.abs(bank.values).sum() * np.abs(drive.drive_v).max()
    for device in (STRICT, host_device()):
        found = field_of(bank, drive, [2, 0], device)
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() <= 1e-13 * scale


def test_given_many_rows_then_memory_bounds_how_many_are_computed_at_once() -> None:
    random = np.random.default_rng(1)
    bank = GreenArray(random.standard_normal((50, 2, 30)), np.zeros((50, 2)), 2000.0)
    drive = drive_of(random.standard_normal((2, 500)))
    assert len(list(Prediction(drive, bank, range(50), dtype=np.float64, device=STRICT).rows())) > 5
    assert np.allclose(field_of(bank, drive, list(range(50)), STRICT), direct(bank, drive, list(range(50))))


@pytest.mark.may_skip("a GPU is not everywhere")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is None, reason="needs CuPy and a GPU")
def test_given_a_gpu_then_it_gives_the_field_of_the_cpu() -> None:
    random = np.random.default_rng(2)
    bank = GreenArray(random.standard_normal((40, 20, 2000)).astype(np.float32), np.zeros((40, 2)), 2000.0)
    drive = drive_of(random.standard_normal((20, 9000)))
    rows = list(range(40))
    here, there = field_of(bank, drive, rows, host_device()), field_of(bank, drive, rows, cuda_device())
    assert np.abs(there - here).max() <= 1e-12 * np.abs(here).max()


@pytest.mark.may_skip("it is about machines without CuPy")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is not None, reason="CuPy is installed")
def test_given_no_cupy_then_a_sentence_says_what_to_install() -> None:
    with pytest.raises(InputError, match="pip install cupy"):
        cuda_device()
