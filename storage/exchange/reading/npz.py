"""NumPy archives and single arrays; pickled ones are never read."""

from __future__ import annotations

import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.reading.measured import ImportOptions, Measured, require_honest
from wavefocus.storage.exchange.reading.named_arrays import NamedArrays, measured_arrays


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read an archive of arrays, never pickled ones."""
    archive = stack.enter_context(zipfile.ZipFile(path))
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    def get(name: str) -> Any:
        if name not in members:
            return None
        info = members[name]
        require_honest(path, f"array {name[:40]!r}", info.file_size, info.compress_size)
        with archive.open(info) as member:
            dtype, declared = _header(member, path)
        require_honest(path, f"array {name[:40]!r}", declared, info.file_size)
        with archive.open(info) as member:
            array = np.lib.format.read_array(member, allow_pickle=False)
        return str(array) if dtype.kind == "U" and array.size == 1 else array

    return measured_arrays(NamedArrays(path, get, members), options)


def read_array(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read one array from an NPY file; its places come from --places, its axis from an option."""
    array = mapped_array(path)
    return measured_arrays(NamedArrays(path, {"green": array}.get, ("green",)), options)


def mapped_array(path: Path) -> NDArray[Any]:
    """The array of an NPY file, read as it is used; a pickled one is refused."""
    with path.open("rb") as file:
        _, declared = _header(file, path)
        held = path.stat().st_size
    if declared > held:
        raise InputError(f"{path} is truncated: it declares {declared} bytes and holds {held}")
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _header(file: IO[bytes], path: Path) -> tuple[np.dtype[Any], int]:
    """Type and bytes of an array in NPY form."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if dtype.hasobject:
        raise InputError(f"{path} holds pickled objects, which are never read; save plain numbers")
    return dtype, int(np.prod([int(one) for one in shape], dtype=object)) * dtype.itemsize
