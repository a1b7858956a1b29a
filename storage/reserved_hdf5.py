"""HDF5 files that are laid out once and never opened for writing through HDF5 again."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import durable, hdf5_safety
from storage.bank.header import METADATA_BLOCK
from storage.durable import PAGE
from storage.errors import InputError
from storage.sparse_memory import SparseMemory


class NewFile(h5py.File):  # type: ignore[misc]
    """An HDF5 file in the making; `memory` is where it lies."""

    memory: SparseMemory


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[NewFile]:
    """Make a file without times, whose metadata share no page with what is written later.

    It is laid out in memory, and on the disk once the block has ended.

    Raises
    ------
    OSError
        When it cannot be written, or exists.
    """
    creation = h5py.h5p.create(h5py.h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    creation.set_attr_phase_change(64, 0)  # root attributes stay in one checksummed object header
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_V18, h5py.h5f.LIBVER_V18)
    access.set_alignment(1, PAGE)
    access.set_meta_block_size(METADATA_BLOCK)
    memory = SparseMemory()
    access.set_fileobj_driver(h5py.h5fd.fileobj_driver, memory)
    with NewFile(h5py.h5f.create(os.fsencode(path.name), h5py.h5f.ACC_TRUNC, creation, access)) as file:
        file.memory = memory
        yield file
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    target = durable.open_file(path, write=True)
    try:
        for offset, page in memory.written():
            target.write(offset, page)
        target.write(memory.size - 1, memory.content(memory.size - 1, 1))  # the file ends where HDF5 says
    finally:
        target.close()


def reserved(
    file: h5py.File,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    unit: str,
    chunk: tuple[int, ...] | None = None,
) -> h5py.Dataset:
    """Create a dataset whose space is allocated and, being new file space, reads as zeros."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    properties.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    properties.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    if chunk:
        properties.set_chunk(chunk)
    group = file.require_group(str(Path(name).parent.as_posix()))
    kind = h5py.h5t.py_create(np.dtype(dtype))
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(group.id, Path(name).name.encode(), kind, space, properties)
    dataset = file[name]
    dataset.attrs["units"] = unit
    return dataset


def filled(file: h5py.File, name: str, values: NDArray[np.generic], unit: str = "1") -> h5py.Dataset:
    """Create a dataset and write it."""
    dataset = reserved(file, name, values.shape, values.dtype.newbyteorder("<").str, unit)
    dataset[...] = values
    return dataset


def label(dataset: h5py.Dataset, *scales: h5py.Dataset) -> None:
    """Attach a dimension scale to each dimension."""
    for dimension, scale in zip(dataset.dims, scales, strict=True):
        dimension.attach_scale(scale)


def row_offsets(file: h5py.File, name: str, row_bytes: int, path: Path) -> NDArray[np.int64]:
    """Find where each row of a dataset lies that has a chunk for each.

    Raises
    ------
    InputError
        When rows are missing, compressed or of another size.
    """
    count = file[name].shape[0]
    chunks = np.full(count, -1, np.int64)

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        if chunk.size == row_bytes and chunk.filter_mask == 0 and chunk.chunk_offset[0] < count:
            chunks[chunk.chunk_offset[0]] = chunk.byte_offset

    file[name].id.chunk_iter(note)
    if file[name].id.get_create_plist().get_nfilters() or (chunks < 0).any():
        raise InputError(f"{path} is damaged: {name} lacks rows or is compressed; restore it from a copy")
    return chunks


def dataset_offset(file: h5py.File, name: str, shape: tuple[int, ...], dtype: str, path: Path) -> int:
    """Find where a dataset lies that is stored in one piece.

    Raises
    ------
    InputError
        When it is of another shape or type, or in pieces.
    """
    dataset = hdf5_safety.plain_dataset(file, name, path, shape=shape)
    found = dataset.id.get_offset()
    if dataset.dtype != np.dtype(dtype) or dataset.chunks or found is None:
        raise InputError(f"{path}: {name} is not laid out as this program lays it out; restore it from a copy")
    return int(found)


def require_apart(extents: Iterable[tuple[int, int]], path: Path) -> None:
    """Refuse extents (offset, size) that overlap or are off the page grid."""
    end = 0
    for offset, size in sorted(extents):
        if offset % PAGE or offset < max(end, PAGE):
            raise InputError(f"{path} is damaged: its datasets overlap or do not start on a page; restore a copy")
        end = offset + size


def note_heaps(file: NewFile, extents: Iterable[tuple[int, int]]) -> None:
    """Note in the file where it keeps its texts, so that damage to them is found before HDF5 meets it.

    Parameters
    ----------
    file : NewFile
        The file, all written; it is flushed.
    extents : iterable of (int, int)
        Offset and size of everything that is written later.
    """
    file.flush()
    later = sorted(extents)
    found = [
        offset
        for offset, page in file.memory.written()
        if page[:4] == b"GCOL" and not any(start <= offset < start + size for start, size in later)
    ]
    file.attrs["heap_offsets"] = np.array(found, np.int64)


def require_sound_heaps(file: h5py.File, path: Path) -> None:
    """Refuse damage that HDF5 would not survive; files of other programs do not say where to look."""
    if "heap_offsets" not in file.attrs:
        return
    where = np.ravel(hdf5_safety.plain_attribute(file, "heap_offsets", path, number=True))
    if where.dtype.kind not in "iu" or (where.size and not 0 <= where.min() <= where.max() < path.stat().st_size):
        raise InputError(f"{path} is damaged: attribute heap_offsets holds no places in the file; restore a copy")
    with path.open("rb") as raw:
        for offset in where.tolist():
            raw.seek(offset)
            size = int.from_bytes(raw.read(16)[8:], "little")
            raw.seek(offset)
            if size > 16 * METADATA_BLOCK or not hdf5_safety.heap_is_sound(raw.read(size)):
                raise InputError(f"{path} is damaged: the texts in its header are not readable; restore a copy")
