"""Files of some kilobytes that declare more than any memory holds."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from wavefocus.calibration.check import check_file
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import FieldRowReader, read_field
from wavefocus.storage.raw.writer import open_raw

LARGE = 10**12


def a_bank(path: Path, shape: tuple[int, ...], chunks: tuple[int, ...], **options: object) -> Path:
    with h5py.File(path, "w") as file:
        file.create_dataset("green", shape, "f4", chunks=chunks, **options)
        file.create_dataset("position_mm", (shape[0], 2), "f8", chunks=(1, 2))
        file.attrs["sample_rate_hz"] = 1e4
    return path


@pytest.mark.parametrize(
    ("shape", "chunks"),
    [
        ((14, 4, LARGE), (14, 4, 16)),  # a row of 14.6 TiB
        ((LARGE, 1, 1), (16, 1, 1)),
        ((14, 10**9, 10), (14, 16, 10)),
    ],
)
def test_a_bank_that_declares_terabytes_then_is_refused_with_the_size(
    tmp_path: Path, shape: tuple[int, ...], chunks: tuple[int, ...]
) -> None:
    path = a_bank(tmp_path / "bank.h5", shape, chunks)
    with pytest.raises(InputError, match=r"(TiB|GiB).*WAVEFOCUS_MOST_GIB"):
        open_bank(path)
    with pytest.raises(InputError, match="WAVEFOCUS_MOST_GIB"):
        check_file(path)


def test_a_chunk_that_unfolds_to_gigabytes_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = a_bank(tmp_path / "bank.h5", (1, 4, 1 << 22), (1, 4, 1 << 22), compression="gzip")
    with h5py.File(path, "r+") as file:
        file["green"][0] = np.zeros((4, 1 << 22), "f4")  # 64 MiB in 64 kB
    with open_bank(path) as bank:
        assert bank.green(0).shape == (4, 1 << 22)
    monkeypatch.setenv("WAVEFOCUS_MOST_GIB", "0.05")
    with pytest.raises(InputError, match="64 MiB"):
        open_bank(path)
    monkeypatch.setenv("WAVEFOCUS_MOST_GIB", "lots")
    with pytest.raises(InputError, match="WAVEFOCUS_MOST_GIB is 'lots'"):
        open_bank(path)


def a_drive(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update(format="wavefocus-drive", format_version=1, sample_rate_hz=1e4, start_s=0.0)
        file.create_dataset("drive", (2, LARGE), "f8", chunks=(2, 16))


def a_field(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update(format="wavefocus-field", format_version=1, sample_rate_hz=1e4, start_s=0.0)
        file.attrs["response_unit"] = "m/s"
        file.create_dataset("field", (2, LARGE), "f4", chunks=(2, 16))
        file["position_index"] = [0, 1]


def a_raw_file(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update(format="wavefocus-raw", format_version=1, sample_rate_hz=1e4, taps=16, band_hz=[1.0, 9.0])
        for name in ("response", "reference"):
            file.create_dataset(name, (LARGE, 1, 64), "i2", chunks=(16, 1, 64))
        file.create_dataset("position_mm", (LARGE, 2), "f8", chunks=(16, 2))
        file["schedule/actuator"] = [[0]]
        file["schedule/delay_s"] = file["schedule/gain"] = np.ones((1, 1))


@pytest.mark.parametrize(
    ("make", "read"), [(a_drive, read_drive), (a_field, read_field), (a_field, FieldRowReader), (a_raw_file, open_raw)]
)
def test_another_file_that_declares_terabytes_then_is_refused_with_the_size(
    tmp_path: Path, make: Callable[[Path], None], read: Callable[[Path], object]
) -> None:
    path = tmp_path / "file.h5"
    make(path)
    with pytest.raises(InputError, match=r"TiB.*WAVEFOCUS_MOST_GIB"):
        read(path)


def test_a_chunk_larger_than_it_declares_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = a_bank(tmp_path / "bank.h5", (1, 1, 1 << 14), (1, 1, 1 << 14), compression="gzip")
    with h5py.File(path, "r+") as file:
        file["green"].id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(1 << 27)))
    with pytest.raises(InputError, match="compressed chunk"):
        open_bank(path)
