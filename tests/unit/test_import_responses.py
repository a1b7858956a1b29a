"""Frequency responses, other units and causality: what an import makes of them, and what it refuses or names."""

import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy.io

from wavefocus import InputError, open_bank
from wavefocus.calibration.imports.bank import import_bank
from wavefocus.cli import parser
from wavefocus.options import ImportOptions
from wavefocus.storage.units import quantity, response_unit

RATE_HZ, TAPS, PERIOD = 2000.0, 300, 800
POSITIONS, ACTUATORS = 4, 2
STEP_HZ = RATE_HZ / PERIOD
AXIS_HZ = STEP_HZ * np.arange(PERIOD // 2 + 1)
BINS = np.arange(20, 181)  # 50 to 450 Hz
PLACES_MM = np.array([[4.0 * (row % 2), 4.0 * (row // 2)] for row in range(POSITIONS)])


def modes(taps, decay_s=0.015, delay_s=0.0):
    """Causal responses of five decaying modes each, (positions, actuators, taps)."""
    random, time_s = np.random.default_rng(1), np.arange(taps) / RATE_HZ - delay_s
    shape = (POSITIONS, ACTUATORS, 5, 1)
    turn = 2 * np.pi * random.uniform(60, 400, shape) * time_s
    ringing = random.standard_normal(shape) * np.sin(turn) * np.exp(-np.maximum(time_s, 0) / decay_s)
    return np.asarray(np.where(time_s >= 0, ringing, 0.0).sum(axis=2))


@pytest.fixture(scope="module")
def green():
    return modes(TAPS)


@pytest.fixture
def imported(tmp_path):
    """Import an array; returns Green's functions, the report and the bank."""
    places = tmp_path / "places.csv"
    places.write_text("x_mm,y_mm\n" + "".join(f"{x},{y}\n" for x, y in PLACES_MM.tolist()))

    def do(values, frequencies=None, **options):
        np.save(tmp_path / "a.npy", values)
        if isinstance(frequencies, np.ndarray):
            np.save(tmp_path / "f.npy", frequencies)
            frequencies = tmp_path / "f.npy"
        given = ImportOptions(**{"places": places, "unit": "m/s/V", "frequencies": frequencies, **options})
        out = tmp_path / f"out-{len(list(tmp_path.iterdir()))}.h5"
        facts, _ = import_bank(tmp_path / "a.npy", out, given)
        with open_bank(out, contents=True) as bank:
            return np.stack([bank.green(row) for row in range(bank.positions)]), facts, bank

    return do


def off_db(found, expected):
    """Relative difference over the taps or bins that both have."""
    length = min(found.shape[-1], expected.shape[-1])
    return float(20 * np.log10(np.linalg.norm(found[..., :length] - expected[..., :length]) / np.linalg.norm(expected)))


def in_band(samples):
    return np.fft.rfft(samples, PERIOD)[..., BINS]


@pytest.mark.parametrize("kind", ["one-sided", "negative first", "to the rate", "odd"])
def test_given_a_whole_frequency_axis_then_the_response_comes_back(green, imported, kind):
    period = PERIOD + (kind == "odd")
    spectra, axis_hz = np.fft.fft(green, period), np.fft.fftfreq(period, 1 / RATE_HZ)
    if kind == "one-sided":
        spectra, axis_hz = np.fft.rfft(green, period), AXIS_HZ
    elif kind == "negative first":
        spectra, axis_hz = np.fft.fftshift(spectra, -1), np.fft.fftshift(axis_hz)
    elif kind == "to the rate":
        axis_hz = np.arange(period) * RATE_HZ / period
    for unmeasured in (None, 0.0, np.nan):  # the first position
        if unmeasured is not None:
            spectra[0], green = unmeasured, np.concatenate([np.zeros_like(green[:1]), green[1:]])
        found, facts, bank = imported(spectra, axis_hz, taps=TAPS)
        assert off_db(np.nan_to_num(found), green) < -130
        assert bank.sample_rate_hz == pytest.approx(RATE_HZ)
        assert facts["residual_db"] < -130


@pytest.mark.parametrize(("taps", "within_db"), [(TAPS, 1.0), (20, 0.1)])
def test_given_a_band_then_the_causal_fit_explains_it_and_states_what_it_does_not(green, imported, taps, within_db):
    spectra = in_band(green)
    found, facts, bank = imported(spectra, (50.0, STEP_HZ), sample_rate_hz=RATE_HZ, taps=taps)
    assert bank.band_hz == (50.0, 450.0)
    left_db = off_db(in_band(found), spectra)
    assert left_db < -90 if taps == TAPS else left_db > -40
    assert facts["residual_db"] == pytest.approx(left_db, abs=within_db)


def test_given_no_value_at_0_hz_then_the_causal_fit_finds_it(green, imported):
    spectra = np.fft.rfft(green, PERIOD)
    spectra[..., 0] = np.nan
    for first in (0, 1):  # NaN; left out
        found, _, _ = imported(spectra[..., first:], (first * STEP_HZ, STEP_HZ), taps=PERIOD // 2)
        assert off_db(found, green) < -90


@pytest.mark.parametrize("unit", ["g/N", "um/V"])
def test_given_other_motions_then_the_bank_keeps_their_unit(green, imported, unit):
    _, _, bank = imported(np.fft.rfft(green, PERIOD), (0.0, STEP_HZ), unit=unit, band_hz=(50.0, 450.0), taps=TAPS)
    assert (bank.response_unit, bank.drive_unit) == (unit, unit[-1])


def test_given_fewer_taps_then_the_energy_that_is_lost_is_stated(green, imported):
    found, facts, _ = imported(green, sample_rate_hz=RATE_HZ, taps=50)
    assert np.array_equal(found, green[..., :50].astype(np.float32))
    lost_db = 10 * np.log10(np.square(green[..., 50:]).sum() / np.square(green).sum())
    assert facts["residual_db"] == pytest.approx(lost_db, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"frequencies": np.geomspace(10, 1000, len(AXIS_HZ))}, "not evenly spaced"),
        ({"frequencies": 0.7 + AXIS_HZ}, "no multiples"),
        ({"frequencies": 0 * AXIS_HZ}, "does not ascend"),
        ({"frequencies": -STEP_HZ - AXIS_HZ}, "0 Hz or above"),
        ({"sample_rate_hz": 1500.0}, "--sample-rate-hz"),
        ({"band_hz": (450.0, 50.0)}, "--band"),
        ({"band_hz": (50.0, math.inf)}, "--band"),
        ({"band_hz": (51.0, 52.0)}, "--band"),
        ({"taps": PERIOD + 1}, "--taps"),
        ({"unit": "parsec"}, "RESPONSE/DRIVE"),
        ({"axes": "position,sample"}, "--axes"),
        ({"names": {"greens": "h"}}, "--names"),
    ],
)
def test_given_an_axis_or_option_that_does_not_fit_then_it_is_named(green, imported, options, told):
    with pytest.raises(InputError, match=told):
        imported(np.fft.rfft(green, PERIOD), **{"frequencies": (0.0, STEP_HZ), **options})


@pytest.mark.parametrize(
    "option", [["--band", "50"], ["--band", "a,b"], ["--band", "50,inf"], ["--names", "green"], ["--names", "=h"]]
)
def test_given_an_option_that_cannot_be_read_then_the_command_line_is_wrong(option):
    with pytest.raises(InputError, match=option[0]):
        parser().parse_args(["import", "a.npy", "--bank", "a.h5", *option])


@pytest.mark.parametrize(
    ("kind", "decay_s", "wanted", "band"),
    [
        ("causal", 0.06, [], None), ("causal", 0.06, [], (50, 226)), ("late", 0.03, [], (50, 226)),
        ("weak noise", 0.03, [], (50, 226)), ("conjugated", 0.02, ["conjugated"], None),
        ("one conjugated", 0.02, ["conjugated"], None), ("one conjugated", 0.02, ["conjugated"], (50, 226)),
        ("leading", 0.02, ["conjugated"], (50, 226)), ("aliased", 0.5, ["aliased"], None),
    ],
)  # fmt: skip
def test_only_responses_that_are_not_causal_then_are_named(imported, band, kind, decay_s, wanted):
    period = 1000
    whole = np.fft.rfft(modes(8000, decay_s, 0.05 if kind == "late" else 0.0))
    spectra = whole[..., :: 8000 // period]  # wrapped round
    if kind == "weak noise":
        random = np.random.default_rng(5)
        spectra += 0.002 * np.abs(spectra).max() * np.exp(2j * np.pi * random.uniform(size=spectra.shape))
    elif kind == "leading":
        spectra = spectra * np.exp(2j * np.pi * np.arange(spectra.shape[-1]) * 24 / period)  # 12 ms
    elif "conjugated" in kind:
        first = int(kind == "one conjugated")
        spectra[:, first:] = spectra[:, first:].conj()
    low, high = band or (0, spectra.shape[-1])
    step_hz = RATE_HZ / period
    _, facts, _ = imported(spectra[..., low:high], (low * step_hz, step_hz), sample_rate_hz=RATE_HZ)
    assert [name for name in ("conjugated", "aliased") for text in facts["warnings"] if name in text] == wanted
    assert any("last tenth" in text and "before zero" in text for text in facts["read"])
    assert all(text in facts["paragraph"] for text in facts["warnings"])
    assert kind != "one conjugated" or "1 of 2 actuators (the first is 1)" in facts["warnings"][0]


@pytest.mark.parametrize("kind", ["mat", "mat 7.3", "npz", "netcdf", "netcdf in parts", "netcdf 3", "npz, directions"])
def test_given_frequency_responses_as_named_arrays_then_every_format_gives_the_same(green, tmp_path, kind):
    spectra = np.fft.rfft(green, PERIOD)
    arrays = {
        "position_mm": PLACES_MM, "actuator_mm": np.array([[30.0, 0.0], [np.nan, np.nan]]), "frequency_hz": AXIS_HZ,
    }  # fmt: skip
    parts = arrays | {"green_real": spectra.real, "green_imag": spectra.imag}
    options, file = ImportOptions(unit="m/s/N", taps=TAPS), tmp_path / ("a.npz" if "npz" in kind else "a")
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
            file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM" + file.read_bytes()[128:])
        case "npz":
            np.savez(file, **arrays, green=spectra)
        case "npz, directions":
            np.savez(file, **arrays, green=np.stack([0 * spectra, spectra], axis=2))
            options = replace(options, direction="1")
        case "netcdf 3":
            with scipy.io.netcdf_file(file, "w") as content:
                for name, values in parts.items():
                    axes = tuple(f"{name}{axis}" for axis in range(values.ndim))
                    for axis, length in zip(axes, values.shape, strict=True):
                        content.createDimension(axis, length)
                    content.createVariable(name, "f8", axes)[:] = values
        case _:
            with h5py.File(file, "w") as content:
                content.update(parts if "parts" in kind else arrays | {"green": spectra})
    import_bank(file, tmp_path / "out.h5", options)
    with open_bank(tmp_path / "out.h5") as bank:
        assert off_db(np.stack([bank.green(row) for row in range(POSITIONS)]), green) < -130
        assert np.array_equal(bank.position_mm, PLACES_MM)
        assert np.array_equal(bank.actuator_mm, arrays["actuator_mm"], equal_nan=True)


def test_a_response_has_the_unit_of_the_green_function_times_that_of_the_drive():
    for green, drive, response in (
        ("m/s/V", "V", "m/s"), ("m/V", "V", "m"), ("(m/s)/V", "V", "m/s"), ("m s-1 V-1", "V", "m/s"),
        ("Pa per V", "V", "Pa"), ("Pa / V", "V", "Pa"), ("1/V", "V", "1"), ("V/V", "V", "V"), ("m/s/mV", "mV", "m/s"),
        ("m/s/A", "A", "m/s"), ("m·s⁻¹·V⁻¹", "volts", "m/s"), ("Pa", "V", "Pa"), ("m/s/mV", "V", "m/s/mV"),
        ("1", "V", "1"), ("", "1", "1"),
    ):  # fmt: skip
        assert response_unit(green, drive) == response, green
    assert (quantity("1", "1"), quantity("0.5", ""), quantity("0.5", "m/s")) == ("1", "0.5", "0.5 m/s")
