"""Frequency responses, other units and places in space as an import turns them into Green's functions."""

import math
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from wavefocus.calibration.imports.bank import import_bank
from wavefocus.cli import parser
from wavefocus.command_line import UsageError
from wavefocus.options import ImportOptions
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError

RATE_HZ, TAPS, PERIOD = 2000.0, 300, 800
POSITIONS, ACTUATORS = 6, 2
STEP_HZ = RATE_HZ / PERIOD


@pytest.fixture(scope="module")
def green():
    """Causal responses of a few decaying modes, (positions, actuators, taps)."""
    random, time_s = np.random.default_rng(1), np.arange(TAPS) / RATE_HZ
    shape = (POSITIONS, ACTUATORS, 5, 1)
    turn = 2 * np.pi * random.uniform(60, 400, shape) * time_s
    modes = random.standard_normal(shape) * np.sin(turn + random.uniform(0, 6, shape)) * np.exp(-time_s / 0.015)
    return np.asarray(modes.sum(axis=2))


@pytest.fixture
def imported(tmp_path):
    """Import an array; returns Green's functions, the report and the band."""
    places = tmp_path / "places.csv"
    places.write_text("x_m,y_m\n" + "".join(f"{0.004 * (i % 3)},{0.004 * (i // 3)}\n" for i in range(POSITIONS)))

    def do(values, **options):
        np.save(tmp_path / "a.npy", values)
        out = tmp_path / f"out-{len(list(tmp_path.iterdir()))}.h5"
        made = import_bank(tmp_path / "a.npy", out, ImportOptions(**{"places": places, "unit": "m/s/V", **options}))
        with open_bank(out, contents=True) as bank:
            return np.stack([bank.green(row) for row in range(bank.positions)]), made, bank

    return do


def off_db(found, expected):
    """Relative difference over the taps or bins that both have."""
    length = min(found.shape[-1], expected.shape[-1])
    return float(20 * np.log10(np.linalg.norm(found[..., :length] - expected[..., :length]) / np.linalg.norm(expected)))


def listed(tmp_path, frequency_hz):
    np.save(tmp_path / "f.npy", frequency_hz)
    return tmp_path / "f.npy"


@pytest.mark.parametrize("kind", ["one-sided", "negative first", "to the rate", "odd"])
def test_given_a_whole_frequency_axis_then_the_response_comes_back(green, imported, tmp_path, kind):
    period = PERIOD + (kind == "odd")
    spectra, axis_hz = np.fft.fft(green, period), np.fft.fftfreq(period, 1 / RATE_HZ)
    if kind == "one-sided":
        spectra, axis_hz = np.fft.rfft(green, period), np.fft.rfftfreq(period, 1 / RATE_HZ)
    elif kind == "negative first":
        spectra, axis_hz = np.fft.fftshift(spectra, -1), np.fft.fftshift(axis_hz)
    elif kind == "to the rate":
        axis_hz = np.arange(period) * RATE_HZ / period
    found, made, bank = imported(spectra, frequencies=listed(tmp_path, axis_hz), taps=TAPS)
    assert off_db(found, green) < -130
    assert bank.sample_rate_hz == pytest.approx(RATE_HZ)
    assert made.facts["residual_db"] < -130


def test_given_a_band_then_the_causal_fit_explains_it_and_states_what_it_does_not(green, imported):
    bins = np.arange(20, 181)
    spectra = np.fft.rfft(green, PERIOD)[..., bins]
    frequencies = (bins[0] * STEP_HZ, STEP_HZ)
    found, made, bank = imported(spectra, frequencies=frequencies, sample_rate_hz=RATE_HZ, taps=TAPS)
    assert bank.band_hz == (50.0, 450.0)
    left_db = off_db(np.fft.rfft(found, PERIOD)[..., bins], spectra)
    assert left_db < -90
    assert made.facts["residual_db"] == pytest.approx(left_db, abs=1.0)
    short, made, _ = imported(spectra, frequencies=frequencies, sample_rate_hz=RATE_HZ, taps=20)
    left_db = off_db(np.fft.rfft(short, PERIOD)[..., bins], spectra)
    assert left_db > -40
    assert made.facts["residual_db"] == pytest.approx(left_db, abs=0.1)


@pytest.mark.parametrize("missing", ["left out", "NaN"])
def test_given_no_value_at_0_hz_then_the_causal_fit_finds_it(green, imported, missing):
    spectra = np.fft.rfft(green, PERIOD)
    if missing == "NaN":
        spectra[..., 0] = np.nan
    found, _, _ = imported(
        spectra if missing == "NaN" else spectra[..., 1:],
        frequencies=(0.0 if missing == "NaN" else STEP_HZ, STEP_HZ),
        taps=PERIOD // 2,
    )
    assert off_db(found, green) < -90


@pytest.mark.parametrize(("unit", "power", "size"), [("g/N", 1, 9.80665), ("um/V", -1, 1e-6)])
def test_given_other_motions_then_they_become_velocities_when_asked(green, imported, unit, power, size):
    omega = 2 * np.pi * STEP_HZ * np.arange(PERIOD // 2 + 1)
    spectra = np.fft.rfft(green, PERIOD) / size
    spectra[..., 1:] *= (1j * omega[1:]) ** power
    options = {"frequencies": (0.0, STEP_HZ), "unit": unit, "band_hz": (50.0, 450.0), "taps": TAPS}
    found, _, bank = imported(spectra, to_velocity=True, **options)
    band = slice(20, 181)
    assert off_db(np.fft.rfft(found, PERIOD)[..., band], np.fft.rfft(green, PERIOD)[..., band]) < -90
    assert bank.response_unit == f"m/s/{unit[-1]}"
    _, _, bank = imported(spectra, **options)
    assert (bank.response_unit, bank.drive_unit) == (unit, unit[-1])


def test_samples_of_acceleration_then_they_are_integrated_in_the_band_that_is_named(green, imported):
    with pytest.raises(InputError, match="--band"):
        imported(green, sample_rate_hz=RATE_HZ, unit="m/s^2/N", to_velocity=True)
    found, made, _ = imported(
        green, sample_rate_hz=RATE_HZ, unit="m/s^2/N", to_velocity=True, band_hz=(50.0, 450.0), taps=PERIOD // 2
    )
    bins = np.arange(20, 181)
    expected = np.fft.rfft(green, PERIOD)[..., bins] / (2j * np.pi * STEP_HZ * bins)
    left_db = off_db(np.fft.rfft(found, PERIOD)[..., bins], expected)
    assert left_db < -40
    assert made.facts["residual_db"] == pytest.approx(left_db, abs=6.0)


@pytest.mark.parametrize(
    ("axis_hz", "told"),
    [
        (np.geomspace(10, 1000, PERIOD // 2 + 1), "not evenly spaced"),
        (0.7 + STEP_HZ * np.arange(PERIOD // 2 + 1), "no multiples"),
        (np.zeros(PERIOD // 2 + 1), "does not ascend"),
        (-STEP_HZ * (1 + np.arange(PERIOD // 2 + 1)), "0 Hz or above"),
    ],
)
def test_given_an_axis_that_no_transform_has_then_it_is_refused(green, imported, tmp_path, axis_hz, told):
    with pytest.raises(InputError, match=told):
        imported(np.fft.rfft(green, PERIOD), frequencies=listed(tmp_path, axis_hz))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"sample_rate_hz": 1500.0}, "--sample-rate-hz"),
        ({"band_hz": (450.0, 50.0)}, "--band"),
        ({"band_hz": (50.0, math.inf)}, "--band"),
        ({"band_hz": (51.0, 52.0)}, "--band"),
        ({"taps": PERIOD + 1}, "--taps"),
        ({"unit": "parsec"}, "RESPONSE/DRIVE"),
        ({"unit": "Pa/V", "to_velocity": True}, "--to-velocity"),
        ({"axes": "position,sample"}, "--axes"),
        ({"names": {"greens": "h"}}, "--names"),
    ],
)
def test_given_an_option_out_of_range_then_it_is_named(green, imported, options, told):
    with pytest.raises(InputError, match=told):
        imported(np.fft.rfft(green, PERIOD), **{"frequencies": (0.0, STEP_HZ), **options})


@pytest.mark.parametrize(
    "option", [["--band", "50"], ["--band", "a,b"], ["--band", "50,inf"], ["--names", "green"], ["--names", "=h"]]
)
def test_given_an_option_that_cannot_be_read_then_the_command_line_is_wrong(option):
    with pytest.raises(UsageError, match=option[0]):
        parser().parse_args(["import", "a.npy", "--bank", "a.h5", *option])


def test_given_fewer_taps_then_the_energy_that_is_lost_is_stated(green, imported):
    found, made, _ = imported(green, sample_rate_hz=RATE_HZ, taps=50)
    assert np.array_equal(found, green[..., :50].astype(np.float32))
    lost_db = 10 * np.log10(np.square(green[..., 50:]).sum() / np.square(green).sum())
    assert made.facts["residual_db"] == pytest.approx(lost_db, abs=1e-3)


@pytest.mark.parametrize("kind", ["mat", "mat 7.3", "npz", "netcdf", "netcdf in parts", "netcdf 3", "npz, directions"])
def test_given_frequency_responses_as_named_arrays_then_every_format_gives_the_same(green, tmp_path, kind):
    spectra = np.fft.rfft(green, PERIOD)
    arrays: dict[str, Any] = {
        "position_mm": np.array([[4.0 * (row % 3), 4.0 * (row // 3)] for row in range(POSITIONS)]),
        "actuator_mm": np.array([[30.0, 0.0], [np.nan, np.nan]]),
        "frequency_hz": STEP_HZ * np.arange(PERIOD // 2 + 1),
    }
    parts = {"green_real": spectra.real, "green_imag": spectra.imag}
    options, file = ImportOptions(unit="m/s/N", taps=TAPS), tmp_path / "a"
    match kind:
        case "mat":
            scipy.io.savemat(file, arrays | {"green": spectra}, appendmat=False)
        case "mat 7.3":
            pairs = np.empty(spectra.T.shape, [("real", "f8"), ("imag", "f8")])
            pairs["real"], pairs["imag"] = spectra.real.T, spectra.imag.T
            with h5py.File(file, "w", userblock_size=512) as content:
                content["green"] = pairs
                for name, values in arrays.items():
                    content[name] = np.atleast_2d(values).T
            whole = file.read_bytes()
            file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + whole[128:])
        case "npz":
            np.savez(file.with_suffix(".npz"), **arrays, green=spectra)
            file = file.with_suffix(".npz")
        case "npz, directions":
            np.savez(file.with_suffix(".npz"), **arrays, green=np.stack([0 * spectra, spectra], axis=2))
            file, options = file.with_suffix(".npz"), replace(options, direction="1")
        case "netcdf 3":
            with scipy.io.netcdf_file(file, "w") as content:
                for name, values in (arrays | parts).items():
                    axes = tuple(f"{name}{axis}" for axis in range(values.ndim))
                    for axis, length in zip(axes, values.shape, strict=True):
                        content.createDimension(axis, length)
                    content.createVariable(name, "f8", axes)[:] = values
        case _:
            with h5py.File(file, "w") as content:
                for name, values in (arrays | (parts if "parts" in kind else {"green": spectra})).items():
                    content[name] = values
    import_bank(file, tmp_path / "out.h5", options)
    with open_bank(tmp_path / "out.h5") as bank:
        assert off_db(np.stack([bank.green(row) for row in range(POSITIONS)]), green) < -130
        assert np.array_equal(bank.position_mm, arrays["position_mm"])
        assert np.array_equal(bank.actuator_mm, arrays["actuator_mm"], equal_nan=True)


def test_given_the_bank_is_an_input_then_it_is_refused_even_with_force(tmp_path):
    file = listed(tmp_path, STEP_HZ * np.arange(PERIOD // 2 + 1))
    before = file.read_bytes()
    with pytest.raises(InputError, match=r"f\.npy"):
        import_bank(tmp_path / "a.npy", file, ImportOptions(frequencies=file), force=True)
    assert file.read_bytes() == before
