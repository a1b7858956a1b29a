"""Facts of foreign files are held against sense: units, rates, fill values, and what is left out."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from wavefocus.__main__ import run
from wavefocus.calibration.imports.bank import import_bank
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import ImportOptions

GREEN = np.random.default_rng(1).standard_normal((4, 2, 100))
PLACES = np.array([[0.0, 0], [8, 0], [0, 8], [8, 8]])
OPTIONS = ImportOptions(unit="m/s/V")


def classic(path: Path, green: np.ndarray, **attributes: float) -> Path:
    file = scipy.io.netcdf_file(path, "w")
    for name, size in zip(("position", "actuator", "sample", "xy", "one"), (*green.shape, 2, 1), strict=True):
        file.createDimension(name, size)
    variable = file.createVariable("green", "d", ("position", "actuator", "sample"))
    variable[:] = green
    for name, value in attributes.items():
        setattr(variable, name, value)
    file.createVariable("position_mm", "d", ("position", "xy"))[:] = PLACES
    file.createVariable("sample_rate_hz", "d", ("one",))[:] = [1000.0]
    file.close()
    return path


def hdf5(path: Path, time_unit: str = "s", place_unit: str = "mm", rate_hz: float | None = 1000.0) -> Path:
    with h5py.File(path, "w") as file:
        file["green"], file["position_mm"] = GREEN, PLACES
        file["time_s"] = np.arange(100) * 1e-3
        file["time_s"].attrs["units"], file["position_mm"].attrs["units"] = time_unit, place_unit
        if rate_hz is not None:
            del file["time_s"]
            file["sample_rate_hz"] = rate_hz
    return path


@pytest.mark.parametrize("attribute", ["_FillValue", "missing_value"])
@pytest.mark.parametrize("taps", [slice(50, None), slice(0, 100)])
def test_fill_values_of_another_type_are_never_valid(tmp_path, attribute, taps):
    green = GREEN.copy()
    green[2, 1, taps] = 1e20
    with pytest.raises(InputError, match="position 2"):
        import_bank(classic(tmp_path / "a.nc", green, **{attribute: 1e20}), tmp_path / "a.h5", OPTIONS)


def test_a_level_that_no_instrument_measures_beside_the_others_is_not_valid(tmp_path):
    green = GREEN.copy()
    green[2] = 1e20
    made = import_bank(classic(tmp_path / "a.nc", green), tmp_path / "a.h5", OPTIONS)
    with open_bank(tmp_path / "a.h5") as bank:
        assert bank.status.tolist() == [1, 1, 4, 1]
    assert any("position" in warning and "200 dB" in warning for warning in made.facts["warnings"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"time_unit": "ms", "rate_hz": None}, "time_s states the units 'ms'"),
        ({"place_unit": "m"}, "position_mm states the units 'm'"),
        ({"rate_hz": 1e-320}, "sample rate"),
        ({"rate_hz": 1e40}, "sample rate"),
        ({"rate_hz": 1.0}, "sample rate is 1 Hz"),
    ],
)
def test_units_and_rates_that_cannot_be_meant_are_refused(tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        import_bank(hdf5(tmp_path / "a.nc", **options), tmp_path / "a.h5", OPTIONS)
    assert not (tmp_path / "a.h5").exists()


def test_an_accelerance_is_whole_by_default_and_taps_that_cut_it_are_a_warning(tmp_path):
    rate_hz, period = 2000.0, 800
    time_s = np.arange(period) / rate_hz
    velocity = np.sin(2 * np.pi * 90 * time_s) * np.exp(-time_s / 0.1)
    spectrum = np.fft.rfft(velocity) * 2j * np.pi * np.fft.rfftfreq(period, 1 / rate_hz)
    np.save(tmp_path / "a.npy", np.tile(spectrum, (4, 1, 1)))
    places = tmp_path / "places.csv"
    places.write_text("x_mm,y_mm\n" + "".join(f"{x:g},{y:g}\n" for x, y in PLACES))
    options = {"unit": "m/s^2/N", "to_velocity": True, "places": places, "frequencies": (0.0, rate_hz / period)}
    made = import_bank(tmp_path / "a.npy", tmp_path / "a.h5", ImportOptions(**options))
    with open_bank(tmp_path / "a.h5") as bank:
        found = bank.green(0)[0] - bank.green(0)[0].mean()
    assert made.shape[2] == period
    assert made.facts["warnings"] == []
    wrong = np.linalg.norm(found - (velocity - velocity.mean())) / np.linalg.norm(velocity)
    assert 20 * np.log10(wrong) < -100
    cut = import_bank(tmp_path / "a.npy", tmp_path / "b.h5", ImportOptions(**options, taps=200))
    assert any("--taps" in warning for warning in cut.facts["warnings"])


def test_the_source_of_an_import_is_named_where_it_is_this_folder(tmp_path, monkeypatch, capsys):
    import_bank(hdf5(tmp_path / "night.nc"), tmp_path / "a.h5", OPTIONS)
    assert run(["export", str(tmp_path / "a.h5"), str(tmp_path / "sounds"), "--to", "wav"]) == 0
    monkeypatch.chdir(tmp_path / "sounds")
    capsys.readouterr()
    assert run(["import", ".", "--bank", str(tmp_path / "b.h5")]) == 0
    assert "Imported from sounds (wav)" in capsys.readouterr().out


def test_a_row_of_a_foreign_bank_that_is_400_db_from_the_others_is_not_valid(tmp_path):
    path = hdf5(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["sample_rate_hz"] = 1000.0
        file["green"][2] *= 1e25
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 1, 0, 1]
