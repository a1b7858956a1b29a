"""Missing and unwritten values of netCDF files, as the netCDF library reads them itself; packed ones are refused."""

import h5py
import netCDF4
import numpy as np
import pytest
import sofar
import xarray

import wavefocus as wf
from tests.system.captures import refused

POSITIONS, ACTUATORS, TAPS = 5, 2, 12
PLACES_MM = np.array([[4.0 * (row % 3), 4.0 * (row // 3)] for row in range(POSITIONS)])
VALUES = np.random.default_rng(5).integers(1, 1200, (POSITIONS, ACTUATORS, TAPS))


def write(path, kind, form, attributes, rows=None):
    """Write stored numbers with the netCDF library, whose own packing is off, in some rows only."""
    attributes = dict(attributes)
    with netCDF4.Dataset(path, "w", format=form) as file:
        for name, size in (("position", POSITIONS), ("actuator", ACTUATORS), ("tap", TAPS), ("axis", 2)):
            file.createDimension(name, size)
        fill = attributes.pop("_FillValue", None)
        green = file.createVariable("green", kind, ("position", "actuator", "tap"), fill_value=fill)
        places = file.createVariable("position_mm", "f8", ("position", "axis"))
        file.set_auto_maskandscale(False)
        green.setncatts(attributes)
        places[:] = PLACES_MM
        for row in range(POSITIONS) if rows is None else rows:
            green[row] = VALUES[row].astype(kind)
        file.setncatts({"sample_rate_hz": np.float32(1000.0), "response_unit": "m/s/V"})


def imported(source, tmp_path):
    """Values and status of the bank that an import makes."""
    with wf.import_bank(source, tmp_path / f"{source.stem}.h5", "netcdf") as bank:
        assert (bank.sample_rate_hz, bank.response_unit) == (1000.0, "m/s/V")
        return np.stack([bank.green(row) for row in range(bank.positions)]), bank.status


def as_netcdf4_reads(source):
    with netCDF4.Dataset(source) as file:
        return np.ma.masked_array(file["green"][:], dtype=np.float64)


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC"])
@pytest.mark.parametrize(
    ("kind", "attributes"),
    [
        ("f4", {"_FillValue": np.float32(-999.9)}),
        ("f8", {"_FillValue": np.nan}),
        ("i2", {"_FillValue": np.int16(-1)}),
        ("f4", {"missing_value": np.float32([-999.9, -998.9])}),
        ("i4", {"_FillValue": np.int32(-1), "missing_value": np.int32(-2)}),
    ],
)
def test_masked_rows_then_are_not_measured(tmp_path, capsys, kind, attributes, form):
    write(tmp_path / "a.nc", kind, form, attributes)
    fill = np.atleast_1d(list(attributes.values())[-1])[-1]
    with netCDF4.Dataset(tmp_path / "a.nc", "r+") as file:
        file.set_auto_maskandscale(False)
        file["green"][2] = fill
    found, status = imported(tmp_path / "a.nc", tmp_path)
    assert status.tolist() == [1, 1, 0, 1, 1]
    wanted = as_netcdf4_reads(tmp_path / "a.nc")
    assert np.array_equal(found[[0, 1, 3, 4]], wanted[[0, 1, 3, 4]])
    with netCDF4.Dataset(tmp_path / "a.nc", "r+") as file:
        file.set_auto_maskandscale(False)
        file["green"][3, 1, 4] = fill
    refused(capsys, "import", tmp_path / "a.nc", "--bank", tmp_path / "partly.h5")


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC"])
@pytest.mark.parametrize(
    ("kind", "attributes", "told"),
    [
        ("i2", {"scale_factor": 1e-3, "add_offset": 0.5}, "green is packed (scale_factor)"),
        ("i2", {"add_offset": 0.5}, "green is packed (add_offset)"),
        ("i2", {"_Unsigned": "true"}, "green is packed (_Unsigned)"),
        ("i2", {"valid_range": np.int16([0, 1200]), "scale_factor": 1e-3}, "green has a valid_range"),
        ("f4", {"valid_max": np.float32(1e4)}, "green has a valid_max"),
        ("f8", {"valid_min": -5.0}, "green has a valid_min"),
    ],
)
def test_packed_values_and_limits_then_are_refused_by_name(tmp_path, capsys, kind, attributes, told, form):
    write(tmp_path / "a.nc", kind, form, attributes)
    assert told in refused(capsys, "import", tmp_path / "a.nc", "--bank", tmp_path / "a.h5")


def test_packing_that_changes_nothing_and_limits_of_the_status_then_are_passed_over(tmp_path):
    write(tmp_path / "a.nc", "f4", "NETCDF4", {"scale_factor": 1.0, "add_offset": 0.0, "_Unsigned": "false"})
    with h5py.File(tmp_path / "a.nc", "r+") as file:
        status = file.create_dataset("status", data=np.ones(POSITIONS, np.uint8))
        status.attrs.update(valid_min=np.uint8(0), valid_max=np.uint8(31))
    with wf.open_bank(tmp_path / "a.nc") as bank:
        assert bank.status.tolist() == [1] * POSITIONS
        assert np.array_equal(bank.green(2), VALUES[2].astype(np.float32))


@pytest.mark.parametrize(
    ("kind", "form"),
    [
        ("f4", "NETCDF3_CLASSIC"),
        ("i4", "NETCDF3_CLASSIC"),
        ("i2", "NETCDF4"),
        ("f8", "NETCDF4"),
        ("f4", "NETCDF4_CLASSIC"),
    ],
)
def test_rows_that_were_never_written_then_are_not_measured(tmp_path, kind, form):
    write(tmp_path / "a.nc", kind, form, {}, rows=(0, 3))
    assert np.ma.getmaskarray(as_netcdf4_reads(tmp_path / "a.nc")).all(axis=(1, 2)).tolist() == [0, 1, 1, 0, 1]
    found, status = imported(tmp_path / "a.nc", tmp_path)
    assert status.tolist() == [1, 0, 0, 1, 0]
    assert np.array_equal(found[[0, 3]], VALUES[[0, 3]])
    if form != "NETCDF3_CLASSIC":  # read as a bank, without an import
        with wf.open_bank(tmp_path / "a.nc") as bank:
            assert bank.status.tolist() == [1, 0, 0, 1, 0]


def test_rows_that_are_zero_or_not_measured_by_their_status_then_are_not_valid(tmp_path):
    green = VALUES.astype(float)
    green[1] = 0.0
    np.savez(tmp_path / "a.npz", green=green, position_mm=PLACES_MM, sample_rate_hz=1000.0, response_unit="m/s",
             drive_unit="V", status=[1, 1, 0, 4, 16])  # fmt: skip
    with wf.import_bank(tmp_path / "a.npz", tmp_path / "a.h5") as bank:
        assert bank.status.tolist() == [1, 0, 0, 4, 16]


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_a_file_that_xarray_packs_then_comes_back_by_the_remedy(tmp_path, capsys, engine):
    dims = ("position", "actuator", "tap")
    values = VALUES * 1e-3
    values[4] = np.nan
    data = xarray.Dataset({"green": (dims, values), "position_mm": (("position", "axis"), PLACES_MM)},
                          attrs={"sample_rate_hz": 1000.0, "response_unit": "m/s/V"})  # fmt: skip
    encoding = {"green": {"dtype": "int16", "scale_factor": 1e-3, "_FillValue": -32768}}
    data.to_netcdf(tmp_path / "packed.nc", engine=engine, encoding=encoding)
    sentence = refused(capsys, "import", tmp_path / "packed.nc", "--bank", tmp_path / "refused.h5")
    assert "ds = xarray.load_dataset(FILE), then v.encoding = {} for each v in ds.variables.values()" in sentence
    ds = xarray.load_dataset(tmp_path / "packed.nc")
    for v in ds.variables.values():
        v.encoding = {}
    ds.to_netcdf(tmp_path / "unpacked.nc")
    found, status = imported(tmp_path / "unpacked.nc", tmp_path)
    assert np.abs(found[:4] - values[:4]).max() < 1e-6
    assert status.tolist() == [1, 1, 1, 1, 0]


def test_measurements_of_a_sofa_file_that_were_never_written_then_are_not_measured(tmp_path):
    sofa = sofar.Sofa("GeneralFIR")
    sofa.Data_IR, sofa.Data_SamplingRate = VALUES[:, :1].astype(float), 1000.0
    sofa.ListenerPosition = np.column_stack([PLACES_MM / 1e3, np.zeros(POSITIONS)])
    sofar.write_sofa(str(tmp_path / "a.sofa"), sofa)
    with h5py.File(tmp_path / "a.sofa", "r+") as file:
        file["Data.IR"][3] = netCDF4.default_fillvals["f8"]
        has_fill = file["Data.IR"].fillvalue == netCDF4.default_fillvals["f8"]
    assert has_fill
    with wf.import_bank(tmp_path / "a.sofa", tmp_path / "a.h5", unit="Pa/V") as bank:
        assert bank.status.tolist() == [1, 1, 1, 0, 1]


def test_a_kind_of_netcdf_that_is_not_read_then_is_named(tmp_path, capsys):
    write(tmp_path / "a.nc", "i8", "NETCDF3_64BIT_DATA", {})
    assert "CDF-5" in refused(capsys, "import", tmp_path / "a.nc", "--bank", tmp_path / "a.h5")
