"""The field file of contract section 5."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from storage.errors import InputError
from storage.field_file import Field, FieldRowReader, FieldWriter, LowPass, field_in_rows, read_field, write_field


def field(positions: int = 3, samples: int = 5, seed: int = 0) -> Field:
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(positions, samples)).astype(np.float32)
    return Field(values, rng.integers(0, 1500, positions), 10_000.0, -0.2, "m/s")


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_a_field_written_then_comes_back_bit_for_bit(tmp_path: Path, positions: int, samples: int, seed: int) -> None:
    written = field(positions, samples, seed)
    write_field(tmp_path / "field.h5", written)
    found = read_field(tmp_path / "field.h5")
    assert found.field.dtype == np.float32
    assert np.array_equal(found.field, written.field)
    assert np.array_equal(found.position_index, written.position_index)
    assert (found.sample_rate_hz, found.start_s, found.response_unit) == (10_000.0, -0.2, "m/s")


def test_a_field_file_opened_by_plain_h5py_then_holds_contract_section_5(tmp_path: Path) -> None:
    write_field(tmp_path / "field.h5", field())
    with h5py.File(tmp_path / "field.h5", "r") as file:
        assert file.attrs["format"] == "wavefocus-field"
        assert file.attrs["format_version"] == 1
        assert file.attrs["sample_rate_hz"] == 10_000.0
        assert file.attrs["start_s"] == -0.2
        assert file.attrs["response_unit"] == "m/s"
        assert file["field"].dtype == np.float32
        assert file["field"].shape == (3, 5)
        assert file["position_index"].dtype == np.int64


def test_a_float64_field_written_as_float64_then_keeps_every_digit(tmp_path: Path) -> None:
    values = np.random.default_rng(3).normal(size=(2, 4))
    write_field(tmp_path / "field.h5", Field(values, np.arange(2), 1e4, 0.0, "m/s"), dtype=np.float64)
    assert np.array_equal(read_field(tmp_path / "field.h5").field, values)


def test_a_field_at_a_lower_rate_then_tells_what_it_lost(tmp_path: Path) -> None:
    path, plain = tmp_path / "low.h5", tmp_path / "plain.h5"
    write_field(path, dataclasses.replace(field(), low_pass=LowPass(500.0, 8)))
    write_field(plain, field())
    with h5py.File(path) as low, h5py.File(plain) as other:
        assert low.attrs["band_hz"].tolist() == [0.0, 500.0]
        assert low.attrs["decimated_by"] == 8
        assert not {"band_hz", "decimated_by"} & set(other.attrs)
    assert read_field(path).low_pass == LowPass(500.0, 8)
    assert read_field(plain).low_pass is None
    with FieldRowReader(path) as low_rows, FieldRowReader(plain) as rows:
        assert (low_rows.low_pass, rows.low_pass) == (LowPass(500.0, 8), None)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("decimated_by", 1, "decimated_by is 1; 2 or more"),
        ("decimated_by", 2.5, "decimated_by is 2.5; a whole number"),
        ("band_hz", [0.0, -1.0], "band_hz ends at -1"),
        ("band_hz", [0.0, np.nan], "band_hz"),
        ("band_hz", [3.0], "band_hz"),
    ],
)
def test_a_field_at_a_lower_rate_with_a_wrong_attribute_then_is_refused(
    tmp_path: Path, name: str, value: object, message: str
) -> None:
    path = tmp_path / "low.h5"
    write_field(path, dataclasses.replace(field(), low_pass=LowPass(500.0, 8)))
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    for read in (read_field, FieldRowReader):
        with pytest.raises(InputError, match=message) as refusal:
            read(path)
        assert str(path) in str(refusal.value)


def rows_of(path: Path) -> AbstractContextManager[FieldWriter]:
    return field_in_rows(path, [4, 7, 9], 2, sample_rate_hz=1e4, start_s=-0.1, response_unit="m/s")


def test_rows_written_one_by_one_then_make_the_whole_field(tmp_path: Path) -> None:
    with rows_of(tmp_path / "field.h5") as writer:
        writer.write(2, np.array([[5.0, 6.0]]))
        writer.write(0, np.array([[1.0, 2.0], [3.0, 4.0]]))
        assert not (tmp_path / "field.h5").exists()
    found = read_field(tmp_path / "field.h5")
    assert found.field.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert found.position_index.tolist() == [4, 7, 9]


def write_two_rows(path: Path) -> None:
    with rows_of(path) as writer:
        writer.write(0, np.ones((2, 2)))


def write_and_stop(path: Path) -> None:
    with rows_of(path) as writer:
        writer.write(0, np.ones((3, 2)))
        raise KeyboardInterrupt


@pytest.mark.parametrize(("write", "error"), [(write_two_rows, InputError), (write_and_stop, KeyboardInterrupt)])
def test_a_field_that_is_not_finished_then_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, write: Callable[[Path], None], error: type[BaseException]
) -> None:
    path = tmp_path / "field.h5"
    write_field(path, field())
    before = path.read_bytes()
    with pytest.raises(error):
        write(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["field.h5"]


@pytest.mark.parametrize(
    ("first", "rows", "message"),
    [
        (2, np.ones((2, 2)), "do not fit"),
        (-1, np.ones((1, 2)), "do not fit"),
        (0, np.ones((1, 3)), "do not fit"),
        (0, np.array([[1.0, np.nan]]), "holds NaN or infinities"),
    ],
)
def test_rows_that_do_not_fit_then_are_refused(tmp_path: Path, first: int, rows: np.ndarray, message: str) -> None:
    with rows_of(tmp_path / "field.h5") as writer:
        with pytest.raises(InputError, match=message):
            writer.write(first, rows)
        writer.write(0, np.ones((3, 2)))


@pytest.mark.parametrize(
    ("values", "index", "rate", "start_s", "message"),
    [
        (np.zeros(3), [0], 1e4, 0.0, "/field has shape"),
        (np.zeros((2, 3)), [0], 1e4, 0.0, "/position_index has shape"),
        (np.zeros((1, 3)), [-1], 1e4, 0.0, "/position_index holds -1"),
        (np.full((1, 3), np.nan), [8], 1e4, 0.0, "/field of position 8 holds NaN"),
        (np.zeros((1, 3)), [0], 0.0, 0.0, "sample_rate_hz is 0"),
        (np.zeros((1, 3)), [0], 1e4, np.nan, "start_s is nan"),
    ],
)
def test_a_wrong_field_then_is_refused_by_name(
    values: np.ndarray, index: list[int], rate: float, start_s: float, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Field(values, np.array(index), rate, start_s, "m/s")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("format", "wavefocus-drive", "'wavefocus-field' is needed"),
        ("format_version", 3, "version 3; this program reads version 1"),
        ("sample_rate_hz", -1.0, "sample_rate_hz is -1"),
        ("response_unit", 3, "response_unit holds no text"),
    ],
)
def test_a_field_file_with_a_wrong_attribute_then_is_refused_in_one_line(
    tmp_path: Path, name: str, value: object, message: str
) -> None:
    path = tmp_path / "field.h5"
    write_field(path, field())
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(InputError, match=message) as refusal:
        read_field(path)
    assert str(path) in str(refusal.value)


def test_a_folder_that_is_missing_then_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written: No such file"):
        write_field(tmp_path / "nowhere" / "field.h5", field())
