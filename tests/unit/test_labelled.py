"""Banks, drives and fields as xarray datasets."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray

from tests.unit.test_bank_writer import green_of, measured
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import Drive, write_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, write_field


@pytest.fixture
def bank(tmp_path: Path) -> Bank:
    return open_bank(measured(tmp_path / "bank.h5"))


def test_a_bank_then_its_dataset_has_the_names_dimensions_and_units_of_its_file(bank: Bank) -> None:
    found = bank.to_xarray()
    with xarray.open_dataset(bank.path, engine="h5netcdf") as file:
        for name in ("green", "position_mm", "actuator_mm", "status", "time_s", "axis"):
            assert found[name].dims == file[name].dims
            assert np.array_equal(found[name], file[name], equal_nan=name != "axis")
            assert found[name].attrs.get("units", "1") == file[name].attrs.get("units", "1")
    with xarray.open_dataset(bank.path, engine="h5netcdf", group="quality") as quality:
        for name in quality.data_vars:
            assert found[name].dims == quality[name].dims
            assert found[name].attrs["units"] == quality[name].attrs["units"]


@pytest.mark.parametrize(
    "key",
    [
        (2,),
        (slice(1, 3), 1),
        ([3, 0], [1, 0], slice(None, None, -3)),
        (slice(0, 0),),
        (np.array([False, True, True, False]), 0, [5, 5]),
    ],
)
def test_given_any_selection_then_the_rows_are_those_of_the_bank(bank: Bank, key: tuple) -> None:
    green = np.stack([green_of(row) for row in range(4)])
    expected = xarray.DataArray(green, dims=("position", "actuator", "time_s"))
    assert np.array_equal(bank.to_xarray()["green"][key].values, expected[key].values)


def test_given_a_damaged_row_then_only_reading_that_row_is_refused(bank: Bank) -> None:
    with h5py.File(bank.path, "r+") as file:
        file["green"][1, 0, 0] += 1.0
    dataset = bank.to_xarray()
    assert np.array_equal(dataset["green"].sel(position=3).values, green_of(3))
    with pytest.raises(InputError, match="position 1"):
        dataset["green"].sel(position=1).load()


def test_given_a_drive_then_its_dataset_is_that_of_its_file(tmp_path: Path) -> None:
    drive = Drive(np.ones((2, 5)), 1000.0, -0.003, "exact", 0.5, 0.0, [3, 4], [7, 8], [0, 0])
    write_drive(tmp_path / "drive.h5", drive)
    found = drive.to_xarray()
    with xarray.open_dataset(tmp_path / "drive.h5", engine="h5netcdf") as file:
        assert file["drive"].dims == found["drive"].dims
        assert np.array_equal(file["time_s"], found["time_s"])
        assert file["drive"].attrs["units"] == found["drive"].attrs["units"]
    assert found["focus_sample"].values.tolist() == [3, 4]
    assert found.attrs["scale"] == 0.5


def test_given_a_field_then_its_positions_are_chosen_by_their_row_in_the_bank(tmp_path: Path) -> None:
    field = Field(np.arange(10.0).reshape(2, 5), [700, 12], 1000.0, -0.003, "m/s")
    write_field(tmp_path / "field.h5", field)
    found = field.to_xarray()
    assert found["field"].sel(position=12, time_s=0.0).item() == 8.0
    with xarray.open_dataset(tmp_path / "field.h5", engine="h5netcdf") as file:
        assert file["field"].dims == found["field"].dims
        assert file["position"].values.tolist() == found["position"].values.tolist()


def test_a_bank_s_dataset_written_as_netcdf_then_comes_back_equal(bank: Bank, tmp_path: Path) -> None:
    bank.to_xarray().to_netcdf(tmp_path / "bank.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "bank.nc", engine="h5netcdf") as found:
        assert np.array_equal(found["green"], bank.to_xarray()["green"])


def test_given_no_xarray_then_the_error_says_how_to_get_it(bank: Bank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)  # as Python has it for a package that cannot be imported
    with pytest.raises(InputError, match=r"pip install 'wavefocus\[exchange\]'"):
        bank.to_xarray()
