"""The drive file of contract section 5."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from storage.drive_file import Drive, read_drive, write_drive
from storage.errors import InputError


def drive(actuators: int = 2, samples: int = 5, foci: int = 3, seed: int = 0) -> Drive:
    rng = np.random.default_rng(seed)
    return Drive(
        drive_v=rng.normal(size=(actuators, samples)),
        sample_rate_hz=10_000.0,
        start_s=-0.1999,
        method="exact",
        scale=0.5,
        omitted_bound=1e-6,
        focus_sample=rng.integers(0, 1000, foci),
        focus_position=rng.integers(0, 1500, foci),
        focus_source=np.zeros(foci, np.int64),
    )


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 4), st.integers(1, 9), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_a_drive_written_then_comes_back_bit_for_bit(
    tmp_path: Path, actuators: int, samples: int, foci: int, seed: int
) -> None:
    written = drive(actuators, samples, foci, seed)
    write_drive(tmp_path / "drive.h5", written)
    found = read_drive(tmp_path / "drive.h5")
    for name in ("drive_v", "focus_sample", "focus_position", "focus_source"):
        assert np.array_equal(getattr(found, name), getattr(written, name))
    for name in ("sample_rate_hz", "start_s", "method", "scale", "omitted_bound"):
        assert getattr(found, name) == getattr(written, name)


def test_a_drive_file_opened_by_plain_h5py_then_holds_contract_section_5(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive.h5", drive())
    with h5py.File(tmp_path / "drive.h5", "r") as file:
        assert file.attrs["format"] == "wavefocus-drive"
        assert file.attrs["format_version"] == 1
        assert file.attrs["sample_rate_hz"] == 10_000.0
        assert file.attrs["start_s"] == -0.1999
        assert file.attrs["method"] == "exact"
        assert file.attrs["scale"] == 0.5
        assert file.attrs["omitted_bound"] == 1e-6
        assert file["drive"].dtype == np.float64
        assert file["drive"].shape == (2, 5)
        for name in ("sample", "position", "source"):
            assert file["focus"][name].dtype == np.int64
            assert file["focus"][name].shape == (3,)


def test_a_drive_file_with_only_what_is_needed_then_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "drive.h5", "w") as file:
        file.attrs.update(format="wavefocus-drive", format_version=1, sample_rate_hz=10_000, start_s=-0.1)
        file["drive"] = np.ones((2, 3), ">f4")
    found = read_drive(tmp_path / "drive.h5")
    assert found.drive_v.dtype == np.float64
    assert (found.method, found.scale, found.omitted_bound) == ("unknown", 1.0, 0.0)
    assert found.focus_sample.shape == (0,)


def test_a_drive_written_over_an_older_one_then_replaces_it_and_leaves_nothing_else(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive.h5", drive(seed=1))
    write_drive(tmp_path / "drive.h5", drive(seed=2))
    assert np.array_equal(read_drive(tmp_path / "drive.h5").drive_v, drive(seed=2).drive_v)
    assert [entry.name for entry in tmp_path.iterdir()] == ["drive.h5"]


def test_a_folder_that_is_missing_then_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere/drive\.h5 cannot be written: No such file"):
        write_drive(tmp_path / "nowhere" / "drive.h5", drive())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"drive_v": np.zeros(3)}, "/drive has shape"),
        ({"drive_v": np.array([[0.0], [np.nan]])}, "/drive of actuator 1 holds NaN"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz is 0"),
        ({"start_s": np.inf}, "start_s is inf"),
        ({"scale": 0.0}, "scale is 0"),
        ({"omitted_bound": -1.0}, "omitted_bound is -1"),
        ({"focus_sample": np.zeros(2)}, "one common length"),
    ],
)
def test_a_wrong_drive_then_is_refused_by_name(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(drive(), **change)


def attribute(name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file.attrs[name] = value

    return change


def put(name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            attribute("format", "wavefocus-bank"),
            "has the format 'wavefocus-bank'; 'wavefocus-drive' is needed",
        ),
        (attribute("format_version", 2), "version 2; this program reads version 1"),
        (attribute("sample_rate_hz", "fast"), "sample_rate_hz is 'fast'"),
        (attribute("scale", -1.0), "scale is -1"),
        (attribute("method", 5), "method holds no text"),
        (put("drive", None), "has no dataset /drive"),
        (put("drive", np.array(["x"], h5py.string_dtype())), "/drive holds no plain numbers"),
        (put("drive", h5py.ExternalLink("other.h5", "/drive")), "/drive is a link to elsewhere"),
        (put("drive", np.array([[np.inf]])), "/drive of actuator 0 holds NaN or infinities"),
        (put("focus/sample", np.zeros(3)), "/focus/sample holds floats"),
        (put("focus/sample", np.zeros(2, int)), "one common length"),
    ],
)
def test_a_drive_file_with_something_wrong_then_is_refused_in_one_line(
    tmp_path: Path, change: Callable[[h5py.File], None], message: str
) -> None:
    path = tmp_path / "drive.h5"
    write_drive(path, drive())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=message) as refusal:
        read_drive(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("content", "message"), [(b"", "is not an HDF5 file"), (None, "does not exist")])
def test_a_path_without_a_drive_then_is_refused(tmp_path: Path, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / "drive.h5").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_drive(tmp_path / "drive.h5")
