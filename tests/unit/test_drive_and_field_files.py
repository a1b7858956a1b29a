"""The drive and field files of docs/reference/files.md."""

import dataclasses
import hashlib
from contextlib import nullcontext

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.lab_files import attribute, put, without
from wavefocus import Drive, InputError, read_drive, write_drive
from wavefocus.storage.field_file import Field, FieldRowReader, LowPass, field_in_rows, read_field, write_field


def drive(actuators=2, samples=5, foci=3, seed=0):
    rng = np.random.default_rng(seed)
    return Drive(
        rng.normal(size=(actuators, samples)), 10_000.0, -0.1999, "exact", 0.5, 1e-6, rng.integers(0, 1000, foci),
        rng.integers(0, 1500, foci), np.zeros(foci, np.int64),
    )  # fmt: skip


def field(positions=3, samples=5, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(positions, samples)).astype(np.float32)
    return Field(values, rng.integers(0, 1500, positions), 10_000.0, -0.2, "m/s")


def a_drive(path):
    write_drive(path, drive())


def a_field(path):
    write_field(path, field())


@settings(max_examples=4)
@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_a_drive_or_field_written_then_comes_back_bit_for_bit(tmp_path, rows, samples, foci, seed):
    written = drive(rows, samples, foci, seed)
    write_drive(tmp_path / "drive.h5", written, force=True)
    found = read_drive(tmp_path / "drive.h5")
    for name in ("drive_v", "focus_sample", "focus_position", "focus_source"):
        assert np.array_equal(getattr(found, name), getattr(written, name))
    for name in ("sample_rate_hz", "start_s", "method", "scale", "omitted_bound"):
        assert getattr(found, name) == getattr(written, name)
    response = field(rows, samples, seed)
    write_field(tmp_path / "field.h5", response, force=True)
    read = read_field(tmp_path / "field.h5")
    assert read.field.dtype == np.float32
    assert np.array_equal(read.field, response.field)
    assert np.array_equal(read.position_index, response.position_index)
    assert (read.sample_rate_hz, read.start_s, read.response_unit) == (10_000.0, -0.2, "m/s")


def test_files_opened_by_plain_h5py_then_hold_contract_section_5(tmp_path):
    a_drive(tmp_path / "drive.h5")
    a_field(tmp_path / "field.h5")
    common = {"format_version": 1, "sample_rate_hz": 10_000.0}
    attributes = {
        "drive": {**common, "format": "wavefocus-drive", "start_s": -0.1999, "method": "exact", "scale": 0.5,
                  "omitted_bound": 1e-6},
        "field": {**common, "format": "wavefocus-field", "start_s": -0.2, "response_unit": "m/s"},
    }  # fmt: skip
    for name, expected in attributes.items():
        with h5py.File(tmp_path / f"{name}.h5", "r") as file:
            assert {key: file.attrs[key] for key in expected} == expected
            assert (file[name].dtype, file[name].shape) == (
                (np.float64, (2, 5)) if name == "drive" else (np.float32, (3, 5))
            )
            integers = ["position_index"] if name == "field" else [f"focus/{one}" for one in file["focus"]]
            assert all((file[one].dtype, file[one].shape) == (np.int64, (3,)) for one in integers)
            datasets = []
            file.visititems(lambda key, one, to=datasets: to.append(key) if isinstance(one, h5py.Dataset) else None)
            for key in datasets:  # each carries its checksum
                values = np.ascontiguousarray(file[key][...], file[key].dtype.newbyteorder("<"))
                assert file[key].attrs["sha256"] == hashlib.sha256(values.tobytes()).hexdigest(), key


@pytest.mark.long  # xarray, and with it dask, takes seconds to load
@pytest.mark.parametrize(("engine", "foci"), [("h5netcdf", 3), ("netcdf4", 0)])
def test_files_opened_by_xarray_then_show_labelled_dimensions_with_units(tmp_path, engine, foci):
    import xarray

    write_drive(tmp_path / "drive.h5", drive(foci=foci))
    a_field(tmp_path / "field.h5")
    with xarray.open_datatree(tmp_path / "drive.h5", engine=engine) as tree:
        assert tree["drive"].dims == ("actuator", "time_s")
        assert (tree["drive"].attrs["units"], tree["time_s"].attrs["units"]) == ("V", "s")
        assert tree["focus/focus"].values.tolist() == list(range(foci))
        assert {one.dims for one in tree["focus"].data_vars.values()} == {("focus",)}
    with xarray.open_dataset(tmp_path / "field.h5", engine=engine) as data:
        assert data.field.dims == ("position", "time_s")
        assert np.array_equal(data.position, field().position_index)
        assert (data.field.attrs["units"], data.time_s.attrs["units"]) == ("m/s", "s")
        assert all("long_name" in one.attrs for one in data.variables.values())


def test_a_drive_file_with_only_what_is_needed_then_is_read(tmp_path):
    with h5py.File(tmp_path / "drive.h5", "w") as file:
        file.attrs.update(format="wavefocus-drive", format_version=1, sample_rate_hz=10_000, start_s=-0.1)
        file["drive"] = np.ones((2, 3), ">f4")
    found = read_drive(tmp_path / "drive.h5")
    assert found.drive_v.dtype == np.float64
    assert (found.method, found.scale, found.omitted_bound) == ("unknown", 1.0, 0.0)
    assert found.focus_sample.shape == (0,)


def test_a_wrong_drive_or_field_in_memory_then_is_refused_by_name():  # test_wrong_arguments.py has other values
    for sound, change, message in (
        (drive(), {"drive_v": np.zeros(3)}, "/drive has shape"), (drive(), {"omitted_bound": -1.0}, "omitted_bound is"),
        (field(), {"field": np.zeros(3)}, "/field has shape"), (field(), {"position_index": [1, -1, 2]}, "holds -1"),
        (drive(), {"drive_v": np.array([[0.0], [np.nan]])}, "/drive of actuator 1 holds NaN"),
        (field(), {"field": np.full((3, 5), np.nan), "position_index": [8, 8, 8]}, "/field of position 8 holds NaN"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            dataclasses.replace(sound, **change)


@pytest.mark.parametrize(
    ("write", "change", "message"),
    [
        (a_drive, attribute("format", "wavefocus-bank"), "the format 'wavefocus-bank'; 'wavefocus-drive' is needed"),
        (a_drive, attribute("sample_rate_hz", 0.0), "sample_rate_hz is 0"),
        (a_drive, attribute("format_version", 2), "version 2; this program reads version 1"),
        (a_drive, attribute("scale", -1.0), "scale is -1"),
        (a_drive, attribute("method", 5), "method holds no text"),
        (a_drive, without("drive"), "has no dataset /drive"),
        (a_drive, put("drive", np.array(["x"], h5py.string_dtype())), "/drive holds no plain numbers"),
        (a_drive, put("drive", h5py.ExternalLink("other.h5", "/drive")), "/drive is a link to elsewhere"),
        (a_drive, put("drive", np.array([[np.inf]])), "/drive of actuator 0 holds NaN or infinities"),
        (a_drive, put("focus/sample", np.zeros(3)), "/focus/sample holds floats"),
        (a_drive, put("focus/sample", np.zeros(2, int)), "one common length"),
        (a_field, attribute("format", "wavefocus-drive"), "'wavefocus-field' is needed"),
        (a_field, attribute("start_s", np.nan), "start_s is nan"),
        (a_field, attribute("response_unit", 3), "response_unit holds no text"),
        (a_field, put("position_index", np.array([3, 4])), "/position_index has shape"),
        (a_field, put("field", np.full((3, 5), np.nan)), "is damaged: the checksum"),
    ],
)
def test_a_file_with_something_wrong_then_is_refused_in_one_line(tmp_path, write, change, message):
    path = tmp_path / "file.h5"
    with pytest.raises(InputError, match="does not exist"):
        read_drive(path) if write is a_drive else read_field(path)
    write(path)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=message) as refusal:
        read_drive(path) if write is a_drive else read_field(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


LOW_PASS = LowPass(500.0, 8)


def test_a_field_at_a_lower_rate_then_says_what_it_lost(tmp_path):
    path, plain = tmp_path / "low.h5", tmp_path / "plain.h5"
    write_field(path, dataclasses.replace(field(), low_pass=LOW_PASS))
    a_field(plain)
    with h5py.File(path) as low, h5py.File(plain) as other:
        assert low.attrs["band_hz"].tolist() == [0.0, 500.0]
        assert low.attrs["decimated_by"] == 8
        assert not {"band_hz", "decimated_by"} & set(other.attrs)
    assert (read_field(path).low_pass, read_field(plain).low_pass) == (LOW_PASS, None)
    for name, value, message in (
        ("decimated_by", 1, "decimated_by is 1; 2 or more"), ("decimated_by", 2.5, "decimated_by is 2.5; a whole"),
        ("band_hz", [0.0, -1.0], "band_hz ends at -1"), ("band_hz", [0.0, np.nan], "band_hz"),
        ("band_hz", [3.0], "band_hz"),
    ):  # fmt: skip
        with h5py.File(path, "r+") as file:
            file.attrs["decimated_by"], file.attrs["band_hz"] = 8, [0.0, 500.0]
            file.attrs[name] = value
        with pytest.raises(InputError, match=message) as refusal:
            FieldRowReader(path)
        assert str(path) in str(refusal.value)


@pytest.mark.parametrize("error", [None, InputError, KeyboardInterrupt])
def test_rows_written_one_by_one_make_the_whole_field_or_leave_the_old_file_alone(tmp_path, error):
    path = tmp_path / "field.h5"
    a_field(path)
    before = path.read_bytes()
    with (
        pytest.raises(error) if error else nullcontext(),
        field_in_rows(path, [4, 7, 9], 2, sample_rate_hz=1e4, start_s=-0.1, response_unit="m/s", force=True) as writer,
    ):
        writer.write(np.array([[1.0, 2.0], [3.0, 4.0]]))
        assert path.read_bytes() == before
        if error is KeyboardInterrupt:
            raise KeyboardInterrupt
        if error is None:
            writer.write(np.array([[5.0, 6.0]]))
    assert [entry.name for entry in tmp_path.iterdir()] == ["field.h5"]
    if error is None:
        found = read_field(path)
        assert found.field.tolist() == [[1, 2], [3, 4], [5, 6]]
        assert found.position_index.tolist() == [4, 7, 9]
    else:
        assert path.read_bytes() == before
