"""Facts of foreign files are held against sense: units, rates, fill values, and what is left out."""

import h5py
import numpy as np
import pytest
import scipy.io

from wavefocus.calibration.imports.bank import import_bank
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import ImportOptions

GREEN = np.random.default_rng(1).standard_normal((4, 2, 100))
PLACES = np.array([[0.0, 0], [8, 0], [0, 8], [8, 8]])
OPTIONS = ImportOptions(unit="m/s/V")


def classic(path, green, **attributes):
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


def hdf5(path, time_unit="s", place_unit="mm", rate_hz=1000.0):
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


def test_a_row_of_a_foreign_bank_that_is_400_db_from_the_others_is_not_valid(tmp_path):
    path = hdf5(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        file.attrs["sample_rate_hz"] = 1000.0
        file["green"][2] *= 1e25
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 1, 0, 1]
