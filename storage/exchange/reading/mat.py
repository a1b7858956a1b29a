"""MATLAB files of level 5 and version 7.3."""

from __future__ import annotations

import io
import struct
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from storage import hdf5_reading
from storage.errors import InputError
from storage.exchange.reading.hdf5_arrays import compound_complex, read_arrays, text_attribute
from storage.exchange.reading.measured import SPARE_BYTES, UNFOLDS, ImportOptions, Measured, require_honest
from storage.exchange.reading.named_arrays import NamedArrays, measured_arrays

_HEADER_BYTES, _COMPRESSED, _MATRIX = 128, 15, 14


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read variables by name, or the fields of the one struct that holds `green`; objects are never made."""
    with path.open("rb") as file:
        head = file.read(10)
    if head.startswith(b"MATLAB 7.3"):
        return read_arrays(path, options, stack, _understand)
    if head.startswith(b"\x89HDF"):
        raise InputError(f"{path} is HDF5 without MATLAB's header; import it with --from netcdf")
    from scipy.io import loadmat, whosmat

    plain = stack.enter_context(_unfolded(path))
    kinds = {name: kind for name, _, kind in whosmat(plain)}
    structs = [name for name, kind in kinds.items() if kind == "struct"]
    inside: dict[str, Any] = {}
    if "green" not in kinds and len(structs) == 1 and not options.names:
        plain.seek(0)
        value = loadmat(plain, variable_names=structs)[structs[0]]
        if value.size == 1 and value.dtype.names:
            inside = {name: value.reshape(-1)[0][name] for name in value.dtype.names}

    def get(name: str) -> Any:
        value = inside.get(name)
        if value is None and name in kinds and kinds[name] not in ("object", "opaque", "function", "cell", "struct"):
            plain.seek(0)
            value = loadmat(plain, variable_names=[name]).get(name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "U":
            return str(value.reshape(-1)[0]) if value.size else ""
        return _squeezed(name, value)

    return measured_arrays(NamedArrays(path, get, inside or kinds), options)


def _squeezed(name: str, value: Any) -> Any:
    """A list without the second axis that MATLAB gives it."""
    is_list = isinstance(value, np.ndarray) and value.ndim == 2 and 1 in value.shape
    return value.reshape(-1) if is_list and name.endswith(("_hz", "_s", "status", "_mm_s")) else value


def _understand(dataset: h5py.Dataset) -> Any:
    """An array of version 7.3, whose axes are stored in the other order; text where MATLAB says that it is char."""
    values = hdf5_reading.read_whole(dataset, Path(dataset.file.filename))
    if text_attribute(dataset, "MATLAB_class") == "char":
        return "".join(chr(int(one)) for one in values.reshape(-1)[:255])
    name = str(dataset.name).rpartition("/")[2]
    return _squeezed(name, compound_complex(values).T)


def _unfolded(path: Path) -> Any:
    """A file of level 5 without compression: in memory, bounded, where an element is compressed."""
    size = path.stat().st_size
    file = path.open("rb")
    header = file.read(_HEADER_BYTES)
    order = "<" if header[126:128] == b"IM" else ">"
    whole, compressed = io.BytesIO(), False
    whole.write(header)
    while len(tag := file.read(8)) == 8:
        kind, count = struct.unpack(f"{order}II", tag)
        if count > size:
            file.close()
            raise InputError(f"{path} is damaged: an element declares {count} bytes and the file holds {size}")
        if kind != _COMPRESSED:
            if not compressed and kind == _MATRIX:
                file.seek(0)
                return file
            whole.write(tag + file.read(count))
            continue
        compressed = True
        most = UNFOLDS * count + SPARE_BYTES
        piece = zlib.decompressobj().decompress(file.read(count), most)
        if len(piece) == most:
            file.close()
            require_honest(path, "a compressed element", most + 1, count)
        whole.write(piece)
    file.close()
    whole.seek(0)
    return whole
