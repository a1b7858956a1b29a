"""Reading HDF5 files that others made: plain numbers and text, in this file and no other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from calibration.errors import InputError


@contextlib.contextmanager
def opened(path: Path, *, cache_bytes: int = 1 << 20) -> Iterator[h5py.File]:
    """Open a file for reading without locks; whatever HDF5 says about it becomes one sentence.

    Raises
    ------
    InputError
        When the file is missing, not a regular file, not HDF5, truncated or damaged.
    """
    require_regular(path)
    try:
        with h5py.File(path, "r", locking=False, rdcc_nbytes=cache_bytes) as file:
            yield file
    except PermissionError as error:
        raise InputError(f"{path} may not be read: {error.strerror}") from error
    except (OSError, RuntimeError, KeyError, UnicodeDecodeError) as error:
        raise InputError(f"{path} {hdf5_complaint(error)}") from error


def require_regular(path: Path) -> None:
    """Refuse a path that is missing or not a regular file."""
    if not path.exists():
        raise InputError(f"{path} does not exist")
    if not path.is_file():
        raise InputError(f"{path} is not a regular file")


def hdf5_complaint(error: Exception) -> str:
    """Put a complaint of HDF5 into words."""
    text = " ".join(str(error).split())
    if "truncated file" in text:
        return "is truncated: it is shorter than its own header says; restore it from a copy"
    if "file signature not found" in text:
        return "is not an HDF5 file"
    return f"is damaged or not readable by HDF5 ({text.strip(chr(39))})"


def require_hard_link(file: h5py.File, name: str, path: Path) -> None:
    """Refuse a name that leads anywhere but to an object of this file."""
    group: h5py.Group = file
    parts = name.strip("/").split("/")
    for depth, part in enumerate(parts, 1):
        here = "/" + "/".join(parts[:depth])
        if isinstance(group.get(part, getlink=True), h5py.SoftLink | h5py.ExternalLink):
            raise InputError(f"{path}: {here} is a link to elsewhere; only objects inside the file itself are read")
        if depth < len(parts):
            found = group[part]
            if not isinstance(found, h5py.Group):
                raise InputError(f"{path}: {here} is not a group")
            group = found


def plain_dataset(file: h5py.File, name: str, path: Path, *, shape: tuple[int, ...] | None = None) -> h5py.Dataset:
    """Return a dataset of plain numbers stored in this file.

    Parameters
    ----------
    file : h5py.File
        The open file.
    name : str
        The dataset's name, as ``"/green"``.
    path : Path
        The file, for messages.
    shape : tuple of int, optional
        The shape it must have.

    Raises
    ------
    InputError
        When it is missing, linked or stored elsewhere, not numeric or of another shape.
    """
    if not has(file, name):
        raise InputError(f"{path} has no dataset {name}")
    require_hard_link(file, name, path)
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        raise InputError(f"{path}: {name} is not a dataset")
    properties = dataset.id.get_create_plist()
    if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
        raise InputError(f"{path}: {name} keeps its data in other files; only data inside the file itself is read")
    try:
        kind = dataset.dtype.kind
    except TypeError:
        kind = "?"
    if kind not in "fiu":
        raise InputError(f"{path}: {name} holds no plain numbers; floats or integers are allowed")
    if shape is not None and dataset.shape != shape:
        raise InputError(f"{path}: {name} has shape {dataset.shape}; {shape} is needed")
    return dataset


def has(file: h5py.File, name: str) -> bool:
    """Tell whether a name exists, without following it."""
    group: object = file
    parts = name.strip("/").split("/")
    for depth, part in enumerate(parts, 1):
        if not isinstance(group, h5py.Group) or group.get(part, getlink=True) is None:
            return False
        if depth < len(parts):
            require_hard_link(file, "/".join(parts[:depth]), Path(file.filename))
            group = group[part]
    return True


def read_floats(file: h5py.File, name: str, path: Path, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Read a whole plain dataset as native float64."""
    return np.asarray(plain_dataset(file, name, path, shape=shape)[...], np.float64)


def read_integers(file: h5py.File, name: str, path: Path, shape: tuple[int, ...] | None = None) -> NDArray[np.int64]:
    """Read a whole plain dataset of integers as native int64."""
    dataset = plain_dataset(file, name, path, shape=shape)
    if dataset.dtype.kind == "f":
        raise InputError(f"{path}: {name} holds floats; integers are needed")
    return np.asarray(dataset[...], np.int64)


def number(file: h5py.File, name: str, path: Path, default: float | None = None) -> float:
    """Read a finite number from a root attribute."""
    return float(numbers(file, name, path, 1, None if default is None else (default,))[0])


def numbers(
    file: h5py.File, name: str, path: Path, count: int, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """Read ``count`` finite numbers from a root attribute."""
    if name not in file.attrs:
        if default is None:
            raise InputError(f"{path} has no attribute {name}")
        return default
    value = plain_attribute(file, name, path)
    if value.dtype.kind not in "fiu" or value.size != count or not np.isfinite(value).all():
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"{path}: attribute {name} is {value.tolist()!r}; {wanted} is needed")
    return tuple(float(item) for item in value.reshape(-1))


def text(file: h5py.File, name: str, path: Path) -> str | None:
    """Read a text from a root attribute; None when it is absent."""
    if name not in file.attrs:
        return None
    value = plain_attribute(file, name, path)
    item = value.reshape(-1)[0] if value.size == 1 else None
    try:
        if isinstance(item, str):
            return item.encode().decode()  # h5py lets bytes that are no UTF-8 through as surrogates
        if isinstance(item, bytes):
            return item.decode()
    except UnicodeError:
        pass
    raise InputError(f"{path}: attribute {name} holds no text; a string is needed")


def require_format(file: h5py.File, path: Path, name: str, version: int, *, may_lack: bool = False) -> bool:
    """Refuse another format or version; False when the file names none and may lack it."""
    found = text(file, "format", path)
    if found is None and may_lack:
        return False
    if found is None:
        raise InputError(f"{path} says no format; {name!r} is needed")
    if found != name:
        raise InputError(f"{path} has the format {found!r}; {name!r} is needed")
    found_version = number(file, "format_version", path)
    if found_version != version:
        raise InputError(f"{path} has {name} version {found_version:g}; this program reads version {version}")
    return True


def heap_is_sound(content: bytes) -> bool:
    """Tell whether the objects of a global heap collection fit into it.

    HDF5 keeps texts there without a checksum, and 2.0 never returns from one whose sizes are wrong (HDF5 file
    format specification 3.0, section III.E).
    """
    size = int.from_bytes(content[8:16], "little")
    if content[:4] != b"GCOL" or size > len(content):
        return False
    at, seen = 16, set[int]()
    while at + 16 <= size:
        index = int.from_bytes(content[at : at + 2], "little")
        length = int.from_bytes(content[at + 8 : at + 16], "little")
        if index == 0:  # what is free, up to the end
            return at + length == size
        at += 16 + (length + 7) // 8 * 8
        if index in seen or at > size:
            return False
        seen.add(index)
    return True


def plain_attribute(file: h5py.File, name: str, path: Path) -> NDArray[np.generic]:
    """Read a root attribute of plain numbers or text."""
    try:
        dtype = file.attrs.get_id(name).dtype
    except TypeError:
        dtype = np.dtype("V1")
    if dtype.kind not in "fiubSU" and h5py.check_string_dtype(dtype) is None:
        raise InputError(f"{path}: attribute {name} holds neither plain numbers nor text")
    return np.asarray(file.attrs[name])
