"""HDF5 files written through this program's own calls, so that a failing disk ends in an error.

When a disk fails under HDF5, it loses data without an error or ends the process (HDF5 2.0 through h5py 3.16).
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable, hdf5_digest, hdf5_reading
from wavefocus.storage.durable import PAGE, PositionedFile
from wavefocus.storage.output_files import replacement, require_outputs

METADATA_BLOCK = 1 << 20
"""In files that are laid out once all metadata sits in blocks of this size, away from pages that are written later."""


@contextmanager
def created(path: Path, data_bytes: int = 0, *, laid_out_once: bool = False) -> Iterator[h5py.File]:
    """Make an HDF5 file that every HDF5 since 1.8 reads, with a checksum on every object header.

    path: A file that does not exist.
    data_bytes: Bytes of all datasets together, reserved before anything is written.
    laid_out_once: For a file that is never opened for writing through HDF5 again: its metadata share no page with its
        data, and nothing is reserved.

    Raises OSError: there is no room, or the disk failed; the file is of no use then.
    """
    path.touch(exist_ok=False)
    with durable.PositionedFile(path, write=True) as disk:
        if not laid_out_once:
            disk.reserve(data_bytes + (1 << 16))
        target = _Target(disk)
        try:
            with h5py.File(_new_file(target, laid_out_once=laid_out_once)) as file:
                yield file
        finally:
            if target.failure is not None:
                raise target.failure
    os.truncate(path, target.size)


@contextmanager
def sealed_output(
    path: Path, form: str, data_bytes: int, about: Mapping[str, Any], *, force: bool
) -> Iterator[h5py.File]:
    """Write a file of a format of this program, with checksums; it appears under its name when the block ends well.

    form: The format's name.
    data_bytes: As of `created`.
    about: Root attributes.
    force: Whether an older file of that name may be replaced; a bank, raw recordings or a link never is.

    Raises InputError: the file exists and may not be replaced, or cannot be written.
    """
    require_outputs((path,), (), force=force)
    with replacement(path) as temporary, created(temporary, data_bytes) as file:
        for name, value in {"format": form, "format_version": 1, **about}.items():
            file.attrs[name] = value
        yield file
        hdf5_digest.seal(file)


def _new_file(target: _Target, *, laid_out_once: bool) -> h5py.h5f.FileID:
    creation = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    if not laid_out_once:  # readers of netCDF-4 and SOFA expect it; banks stay as they were
        creation.set_link_creation_order(h5py.h5p.CRT_ORDER_TRACKED | h5py.h5p.CRT_ORDER_INDEXED)
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V18, h5py.h5f.LIBVER_V18)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)
    access.set_fileobj_driver(h5py.h5fd.fileobj_driver, target)
    if laid_out_once:
        creation.set_attr_phase_change(64, 0)  # root attributes stay in one checksummed object header
        access.set_alignment(1, PAGE)
        access.set_meta_block_size(METADATA_BLOCK)
    return h5py.h5f.create(b"new", h5py.h5f.ACC_TRUNC, creation, access)


class _Target(io.RawIOBase):
    """A file for HDF5 that keeps the first failure in `failure` and goes on, for HDF5 does not survive one."""

    def __init__(self, disk: PositionedFile) -> None:
        super().__init__()
        self.size = 0
        self.failure: OSError | None = None
        self._disk = disk
        self._at = 0

    @contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.failure = self.failure or error

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence] + offset
        return self._at

    def truncate(self, size: int | None = None) -> int:
        self.size = self._at if size is None else size
        with self._noting():
            if self.size > self._disk.size():  # what HDF5 has not written yet reads as zeros
                self._disk.write(self.size - 1, b"\0")
        return self.size

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self.size - self._at))
        view[:count] = bytes(count)
        with self._noting():
            self._disk.read_into(self._at, view[:count])
        self._at += count
        return count

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        view = memoryview(data).cast("B")
        with self._noting():
            self._disk.write(self._at, view)
        self._at += len(view)
        self.size = max(self.size, self._at)
        return len(view)


def reserved(
    file: h5py.File,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    unit: str | None = "1",
    chunk: tuple[int, ...] | None = None,
) -> h5py.Dataset:
    """Create a dataset whose space is allocated and, being new file space, reads as zeros; None: it has no units."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    if chunk:
        properties.set_chunk(chunk)
    group, _, own_name = name.rpartition("/")
    kind, space = h5py.h5t.py_create(np.dtype(dtype)), h5py.h5s.create_simple(shape)
    h5py.h5d.create(file.require_group(group or "/").id, own_name.encode(), kind, space, properties)
    dataset = file[name]
    if unit is not None:
        dataset.attrs["units"] = unit
    return dataset


def filled(file: h5py.File, name: str, values: NDArray[Any], unit: str | None = "1") -> h5py.Dataset:
    """Create a dataset of little-endian numbers and write it."""
    dataset = reserved(file, name, values.shape, values.dtype.newbyteorder("<").str, unit)
    dataset[...] = values
    return dataset


def dimension_scale(file: h5py.File, name: str, values: NDArray[Any], unit: str = "1") -> h5py.Dataset:
    """Create a dimension scale, so that other programs show labelled dimensions and units."""
    dataset = filled(file, f"/{name}", values, unit)
    dataset.make_scale(name.rpartition("/")[2])
    return dataset


def bare_dimension(file: h5py.File, name: str, size: int) -> h5py.Dataset:
    """Create a dimension without values, as netCDF-4 marks it: never written and allocated late, it takes no space."""
    dataset = file.create_dataset(name, (size,), "u1", track_times=False)
    dataset.make_scale(f"{hdf5_reading.BARE_DIMENSION}{size:10d}")
    return dataset


def attach(dataset: h5py.Dataset, *scales: h5py.Dataset) -> None:
    """Attach a dimension scale to each dimension of a dataset."""
    for dimension, scale in zip(dataset.dims, scales, strict=True):
        dimension.attach_scale(scale)


def set_long_names(file: h5py.File, names: Mapping[str, str]) -> None:
    """Say in words what datasets hold, those of them that are there; the attribute is that of CF conventions."""
    for name, text in names.items():
        if name in file:
            file[name].attrs["long_name"] = text


def sample_times(samples: int, sample_rate_hz: float, start_s: float = 0.0) -> NDArray[np.float64]:
    """Times of samples in seconds, float64 (samples,)."""
    return start_s + np.arange(samples) / sample_rate_hz
