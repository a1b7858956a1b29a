"""Checksums of HDF5 files: of a dataset's values (docs/reference/files.md), and of everything in a file.

Two attributes hold them as hexadecimal SHA-256. `sha256` on a dataset is that of its values in C order,
little-endian. `contents_sha256` on the root is that of all names, shapes, types, attributes and values, so
that nothing in the file can change unseen; datasets that carry a checksum of their own, and values that are
written later and are checked otherwise, stand in it without their values.
"""

import hashlib
import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_reading
from wavefocus.storage.errors import InputError

VALUES = "sha256"
_CONTENTS = "contents_sha256"
NOTES = "notes"
"""Root attribute of notes that people add to a bank later."""
_ROOT = frozenset({
    "format", "format_version", "sample_rate_hz", "response_unit", "drive_unit", "band_hz", "rig", "run", "plan_sha256",
    "software", "directions_deg", "import_report", "header_crc32", "layout_crc32", "layout_later_crc32", "taps",
    "period_s", "averages", "sweep_s", "decay_s", "same_clock", "sweep_law", "response_per_volt", "reference_gain",
    "inter_channel_delay_s", "start_s", "scale", "omitted_bound", "method", "decimated_by", "volts_per_count",
    "contents_sha256", "heap_offsets", "sha256", "origins", "check_rows", NOTES,
})  # fmt: skip
"""Root attributes of files of this program; a person may add others, which change nothing."""
# Written last of all; `heap_offsets` says where older versions keep texts.
_APART = frozenset({_CONTENTS, "heap_offsets"})
_AT_ONCE_BYTES = 32 << 20


class RunningDigest:
    """SHA-256 of numbers that come piece by piece, in C order, little-endian; `dtype` is as the file holds them."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype.newbyteorder("<")
        self._digest = hashlib.sha256()

    def update(self, values: NDArray[Any]) -> None:
        """Take in the next piece."""
        self._digest.update(np.ascontiguousarray(values, self._dtype).reshape(-1).view(np.uint8).data)

    def hexdigest(self) -> str:
        """Checksum of all pieces."""
        return self._digest.hexdigest()


def values_sha256(values: NDArray[Any]) -> str:
    """SHA-256 of numbers in C order, little-endian."""
    digest = RunningDigest(values.dtype)
    digest.update(values)
    return digest.hexdigest()


def _dataset_sha256(dataset: h5py.Dataset) -> str:
    """SHA-256 of a dataset's numbers, read piece by piece."""
    if dataset.ndim == 0 or not dataset.size:
        return values_sha256(np.asarray(dataset[...]))
    digest = RunningDigest(dataset.dtype)
    hdf5_reading.require_rows(dataset)
    row_bytes = dataset.size // len(dataset) * dataset.dtype.itemsize
    if row_bytes <= _AT_ONCE_BYTES or dataset.ndim != 2:
        at_once = max(1, _AT_ONCE_BYTES // row_bytes)
        for first in range(0, len(dataset), at_once):
            digest.update(dataset[first : first + at_once])
        return digest.hexdigest()
    at_once = _AT_ONCE_BYTES // dataset.dtype.itemsize
    for row in range(len(dataset)):
        for first in range(0, dataset.shape[1], at_once):
            digest.update(dataset[row, first : first + at_once])
    return digest.hexdigest()


def seal(file: h5py.File) -> None:
    """Write the checksum of every dataset that lacks one, then that of the whole file."""
    for _, found in _objects(file):
        if isinstance(found, h5py.Dataset) and VALUES not in found.attrs:
            found.attrs[VALUES] = _dataset_sha256(found)
    seal_contents(file)


def seal_contents(file: h5py.File, later: Collection[str] = ()) -> None:
    """Write the checksum of everything but the values of some datasets, as ``"/green"``, that are written later."""
    file.attrs[_CONTENTS] = _contents_sha256(file, later)


def unknown_attributes(file: h5py.File) -> tuple[str, ...]:
    """Names of root attributes that this program does not write, such as those that a person has added."""
    return tuple(sorted(set(file.attrs) - _ROOT))


def _contents_sha256(file: h5py.File, later: Collection[str], without: Collection[str] = ()) -> str:
    """SHA-256 of everything but some root attributes."""
    digest = hashlib.sha256()
    for name, found in _objects(file):
        facts: list[object] = [name, "group" if isinstance(found, h5py.Group) else type(found).__name__]
        if isinstance(found, h5py.Dataset):
            facts += [list(found.shape or ()), found.dtype.newbyteorder("<").str]
            if name not in later and VALUES not in found.attrs and found.id.get_storage_size():
                facts.append(_plain(hdf5_reading.read_whole(found), file))
        if isinstance(found, h5py.Group | h5py.Dataset):
            apart = {*_APART, *without} if name == "/" else _APART
            attributes = found.attrs
            facts += [[key, _plain(attributes[key], file)] for key in sorted(attributes) if key not in apart]
        digest.update(json.dumps(facts).encode() + b"\n")
    return digest.hexdigest()


def require_contents(file: h5py.File, later: Collection[str] = ()) -> None:
    """Refuse a file whose contents are not as they were written; older files carry no checksum of them."""
    if _CONTENTS not in file.attrs:
        return
    try:
        sealed = hdf5_reading.text(file, _CONTENTS)
        added = {NOTES, *unknown_attributes(file)} & set(file.attrs)
        # A later version may have sealed attributes that this one does not know.
        same = any(sealed == _contents_sha256(file, later, without) for without in dict.fromkeys([tuple(added), ()]))
    except InputError:
        raise
    except (TypeError, ValueError, AttributeError) as error:  # h5py, of types and references that are none
        raise InputError(f"{hdf5_reading.path_of(file)} {hdf5_reading.hdf5_complaint(error)}") from error
    if not same:
        raise InputError(
            f"{hdf5_reading.path_of(file)} is damaged: the checksum of its contents does not hold; make it anew or"
            " restore a copy"
        )


def format_of(path: Path) -> tuple[str | None, bool]:
    """Return the format that a file says it has, and whether it carries a checksum of its contents."""
    with hdf5_reading.opened(path) as file:
        hdf5_reading.require_sound_texts(file)
        return hdf5_reading.text(file, "format"), _CONTENTS in file.attrs


def _expected_sha256(dataset: h5py.Dataset) -> str | None:
    """Read the checksum that a dataset carries; None when it carries none."""
    if VALUES not in dataset.attrs:
        return None
    value = dataset.attrs[VALUES]
    if not isinstance(value, str | bytes):
        raise InputError(
            f"{hdf5_reading.path_of(dataset)}: {dataset.name} has a {VALUES} that is not a text; a text is needed"
        )
    return value if isinstance(value, str) else value.decode("ascii", "replace")


def require_values(dataset: h5py.Dataset, found: str) -> None:
    """Refuse a dataset whose values have another checksum than it carries; it may carry none."""
    expected = _expected_sha256(dataset)
    if expected is not None and found != expected.lower():
        raise InputError(
            f"{hdf5_reading.path_of(dataset)} is damaged: the checksum of {dataset.name} does not hold; make it anew or"
            " restore a copy"
        )


def require_all(file: h5py.File, apart: str) -> bool:
    """Verify the contents and every dataset but one that the caller verifies; False when one carries no checksum.

    Raises InputError: a checksum does not hold.
    """
    require_contents(file)
    complete = True
    for name, found in _objects(file):
        if not isinstance(found, h5py.Dataset):
            continue
        expected = _expected_sha256(found)
        complete &= expected is not None
        if expected is not None and name != apart:
            require_values(found, _dataset_sha256(hdf5_reading.plain_dataset(file, name)))
    return complete


def _objects(file: h5py.File) -> Iterator[tuple[str, object]]:
    """Every object by name, in order; an object with several names comes once, links only as what they say."""
    seen = {hash(file.id)}
    yield "/", file
    names = [("/" + name, file) for name in sorted(file, reverse=True)]
    while names:
        name, parent = names.pop()
        link = parent.get(name.rsplit("/", 1)[1], getlink=True)
        if not isinstance(link, h5py.HardLink):
            yield f"{name} {json.dumps(vars(link), default=str)}", link
            continue
        found = parent[name.rsplit("/", 1)[1]]
        yield name, found
        if isinstance(found, h5py.Group) and hash(found.id) not in seen:
            seen.add(hash(found.id))
            names += [(f"{name}/{member}", found) for member in sorted(found, reverse=True)]


def _plain(value: object, file: h5py.File) -> object:
    """Put a value of HDF5 into what JSON can say, so that equal values give equal words anywhere."""
    if isinstance(value, h5py.Reference):
        return ["reference", str(h5py.h5r.get_name(value, file.id)) if value else None]
    if isinstance(value, h5py.Empty):
        return ["empty", value.dtype.str]
    if isinstance(value, str):
        return value
    if isinstance(value, bytes):
        return ["bytes", value.hex()]
    array = np.asarray(value)
    if array.dtype.names:
        return [[_plain(item[field], file) for field in array.dtype.names] for item in array.reshape(-1)]
    if array.dtype.kind in "OV":
        return [list(array.shape), *(_plain(item, file) for item in array.reshape(-1).tolist())]
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return [little.dtype.str, list(array.shape), little.tobytes().hex()]
