"""Drives and fields by the array API: on any namespace that follows the standard, and on a GPU where there is one."""

import importlib.util

import array_api_strict
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.plate_banks import noise_bank
from tests.unit.test_drive import MOVING, REPEATING, STANDING
from tests.unit.test_field import convolved, make_drive
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.device import Device, cuda_device, host_device
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.errors import InputError

STRICT = Device("strict", array_api_strict, np.from_dlpack, 2**16)


@settings(max_examples=5)
@given(
    sources=st.lists(st.sampled_from([MOVING, REPEATING, STANDING]), min_size=1, max_size=3),
    saturation=st.sampled_from([None, 0.7]),
    normalise=st.booleans(),
    interpolation=st.sampled_from(["nearest", "bilinear"]),
    scale=st.sampled_from([1.0, 1e-12, 1e12]),
    taps=st.integers(1, 90),
    seed=st.integers(0, 2**32),
)
def test_given_any_bank_and_scene_then_the_standard_alone_gives_the_drives(
    sources, saturation, normalise, interpolation, scale, taps, seed
):
    bank = noise_bank(taps, seed=seed, scale=scale, band_hz=(50.0, 400.0))
    scene = Scene(
        "s",
        tuple(sources),
        Regularisation(saturation=saturation or 0.0, normalise=normalise),
        Output(interpolation=interpolation),
    )
    expected, report = render_with_report(scene, bank)
    largest = np.abs(expected.drive_v).max()
    for device in (STRICT, host_device()):
        found, told = render_with_report(scene, bank, device=device)
        assert np.abs(found.drive_v - expected.drive_v).max() <= 1e-12 * largest
        assert (found.omitted_bound, told.omitted_bound) == (0.0, 0.0)
        assert told.warnings == report.warnings
        assert told.pairs > 0
        for share, right in zip(told.out_of_band, report.out_of_band, strict=True):
            assert share == pytest.approx(right, abs=1e-3)


@pytest.mark.may_skip("a GPU is not everywhere")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is None, reason="needs CuPy and a GPU")
def test_given_a_gpu_then_it_gives_the_drives_of_the_cpu():
    scene = Scene("s", (MOVING, REPEATING, STANDING), Regularisation(saturation=0.7), Output(interpolation="bilinear"))
    here = render_with_report(scene, noise_bank(500, band_hz=(50.0, 400.0)))[0].drive_v
    there = render_with_report(scene, noise_bank(500, band_hz=(50.0, 400.0)), device=cuda_device())[0].drive_v
    assert np.abs(there - here).max() <= 1e-12 * np.abs(here).max()


def field_of(bank, drive, positions, device):
    prediction = Prediction(drive, bank, positions, dtype=np.float64, device=device)
    return np.concatenate([responses for _, responses in prediction.rows()])


@given(st.integers(1, 40), st.integers(1, 300), st.integers(1, 4), st.integers(-12, 12), st.integers(0, 2**32))
def test_given_any_bank_and_drive_then_the_standard_alone_gives_the_field(taps, samples, actuators, decade, seed):
    random = np.random.default_rng(seed)
    bank = GreenArray(random.standard_normal((3, actuators, taps)) * 10.0**decade, np.zeros((3, 2)), 1000.0)
    drive = make_drive(random.standard_normal((actuators, samples)))
    expected = convolved(bank, drive, [2, 0])
    scale = np.abs(bank.values).sum() * np.abs(drive.drive_v).max()
    for device in (STRICT, host_device()):
        found = field_of(bank, drive, [2, 0], device)
        assert found.shape == expected.shape
        assert np.abs(found - expected).max() <= 1e-13 * scale


@pytest.mark.may_skip("a GPU is not everywhere")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is None, reason="needs CuPy and a GPU")
def test_given_a_gpu_then_it_gives_the_field_of_the_cpu():
    random = np.random.default_rng(2)
    bank = GreenArray(random.standard_normal((40, 20, 2000)).astype(np.float32), np.zeros((40, 2)), 1000.0)
    drive = make_drive(random.standard_normal((20, 9000)))
    rows = list(range(40))
    here, there = field_of(bank, drive, rows, host_device()), field_of(bank, drive, rows, cuda_device())
    assert np.abs(there - here).max() <= 1e-12 * np.abs(here).max()


@pytest.mark.may_skip("it is about machines without CuPy")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is not None, reason="CuPy is installed")
def test_given_no_cupy_then_a_sentence_says_what_to_install():
    with pytest.raises(InputError, match="pip install cupy"):
        cuda_device()
