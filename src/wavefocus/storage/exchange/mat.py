"""MATLAB files: a bank as one of level 5, with a struct that explains it; level 5 and version 7.3 are read."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.bank.ledger import QUALITY
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import SPARE_BYTES, UNFOLDS, Measured, require_honest
from wavefocus.storage.exchange.named_arrays import NamedArrays, bank_arrays, measured_arrays
from wavefocus.storage.exchange.netcdf import compound_complex, read_arrays, text_attribute
from wavefocus.storage.output_files import replacement

MAX_BYTES = 2**31 - 2**20
"""Largest variable of the format."""


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write the file; raises InputError where the Green's functions take more than 2 GiB."""
    from scipy.io import savemat

    needed = 4 * len(rows.row) * rows.bank.actuators * rows.bank.taps
    if needed > MAX_BYTES:
        raise InputError(
            f"{path}: {len(rows.row)} positions take {needed / 2**30:.3g} GiB, and a variable of a MATLAB file holds 2;"
            " export some --positions at a time, or as npz"
        )
    with replacement(path) as temporary, temporary.open("wb") as file:
        arrays = bank_arrays(rows, on_progress) | {"about": _about(rows)}
        savemat(file, arrays, oned_as="column")  # type: ignore[arg-type]


README = """Green's functions of a plate: green(p, a, k) is the response at position p to a drive at actuator a, tap k.
A response is y(n) = sum over a and k of green(p, a, k) * drive(a, n - k + 1), without a factor dt; tap 1 is the instant
of the drive sample. Places are millimetres on the surface: origin at its centre, x right, y up, seen from the laser.
position holds rows of the bank, counted from 0. status: 1 valid, 2 over range, 4 poor signal, 8 failed, 16 disabled.
NaN is unknown. about.units has the unit of each variable.

Example: y = filter(squeeze(green(1, 1, :)), 1, drive);   % response at the first position to the first actuator"""


def _about(rows: ExportedRows) -> dict[str, Any]:
    bank = rows.bank
    units = {"green": rows.units[0], "position_mm": "mm", "actuator_mm": "mm", "time_s": "s"}
    units |= {"sample_rate_hz": "Hz", "band_hz": "Hz"} | {f"quality_{name}": QUALITY[name][0] for name in bank.quality}
    return {"readme": README, "units": units, "publication": dict(rows.publication), "source": rows.bank_name}


_HEADER_BYTES, _MATRIX, _COMPRESSED = 128, 14, 15
_STRUCT, _CHAR, _NUMBERS, _OPAQUE = 2, 4, range(6, 16), 17
_OTHER_PROGRAMS = {b"Octave-1-": "Octave's own binary format", b"# Created by Octave": "Octave's own text format",
                   b"PK": "an archive (ZIP)"}  # fmt: skip
_TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 16: "u1", 17: "u2",
}  # fmt: skip


_UNREAD = object()
"""In place of a variable that is neither numbers nor text nor one struct."""


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read variables by name, fields of structs as ``struct.field``, or by their own names where there is one struct.

    Objects are never made. Variables that are not asked for may be of any kind.

    Level 5 is read here and not by SciPy, which a damaged file can crash (MAT-File Format, MathWorks, chapter 1).
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
    if head.startswith(b"MATLAB 7.3"):
        return read_arrays(path, options, stack, _understand)
    if head.startswith(b"\x89HDF"):
        raise InputError(f"{path} is HDF5 without MATLAB's header; import it with --from netcdf")
    order = {b"IM": "<", b"MI": ">"}.get(head[126:128], "")
    if not order:
        known = next((words for begin, words in _OTHER_PROGRAMS.items() if head.startswith(begin)), "")
        raise InputError(
            f"{path} is {known or 'a MATLAB file of level 4, or of another kind'}; files of level 5 and version 7.3 are"
            " read: save it with -v7"
        )
    variables: dict[str, Any] = {}
    for kind, content in _elements(np.memmap(path, np.uint8, "r").data[_HEADER_BYTES:], order):
        element = (kind, content)
        if kind == _COMPRESSED:
            most = UNFOLDS * len(content) + SPARE_BYTES
            whole = zlib.decompressobj().decompress(content, most)
            if len(whole) == most:
                require_honest(path, "a compressed element", most + 1, len(content))
            element = next(_elements(memoryview(whole), order))
        if element[0] == _MATRIX:
            name, value = _matrix(element[1], order)
            variables[name] = value
    structs = [value for value in variables.values() if isinstance(value, dict)]
    fields = dict(_fields(variables, ""))
    by_own_name = structs[0] if len(structs) == 1 and "green" not in variables else {}

    def get(name: str) -> Any:
        value = fields[name] if name in fields else by_own_name.get(name)
        if value is _UNREAD and name in ("response_unit", "drive_unit"):
            return None  # a text in double quotes is an object: --unit states it
        if value is _UNREAD:
            raise InputError(f"{path}: variable {name!r} is not an array of numbers, which is needed")
        return None if isinstance(value, dict) else _squeezed(name, value)

    return measured_arrays(NamedArrays(path, get, [name for name, value in fields.items() if name]), options)


def _fields(variables: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Variables and fields of structs by their full names."""
    for name, value in variables.items():
        if isinstance(value, dict):
            yield from _fields(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of each data element, one after the other."""
    at = 0
    while at + 8 <= len(content):
        kind, count = struct.unpack_from(f"{order}II", content, at)
        start, step = at + 8, count if kind == _COMPRESSED else -(-count // 8) * 8
        if kind >> 16:  # a small element: type, size and content in 8 bytes
            kind, count, start, step = kind & 0xFFFF, kind >> 16, at + 4, 0
        if start + count > len(content):
            raise ValueError(f"an element declares {count} bytes and {len(content) - start} are there")
        yield kind, content[start : start + count]
        at = max(start, at + 8) + step


def _matrix(content: memoryview, order: str) -> tuple[str, Any]:
    """Name and value of an array: numbers, a text, a struct as a dictionary; `_UNREAD` for what is none of these."""
    parts = _elements(content, order)
    if not len(content):
        return "", None
    _, flags = next(parts)
    kind = int(np.frombuffer(flags, f"{order}u4")[0])
    if kind & 0xFF == _OPAQUE:  # without extents; what follows is undocumented
        return bytes(next(parts)[1]).decode("latin-1"), _UNREAD
    (_, extents), (_, name) = next(parts), next(parts)
    shape, label = np.frombuffer(extents, f"{order}i4").tolist(), bytes(name).decode("latin-1")
    if kind & 0xFF == _CHAR:
        code, text = next(parts, (1, memoryview(b"")))
        wide = "utf-16-le" if order == "<" else "utf-16-be"
        return label, bytes(text).decode({17: wide, 4: wide}.get(code, "utf-8"), "replace")
    if kind & 0xFF == _STRUCT and shape == [1, 1]:
        width = int(np.frombuffer(next(parts)[1], f"{order}i4")[0])
        names = bytes(next(parts)[1])
        keys = [names[at : at + width].split(b"\0")[0].decode("latin-1") for at in range(0, len(names), max(width, 1))]
        return label, {key: _matrix(part, order)[1] for key, (_, part) in zip(keys, parts, strict=False)}
    if kind & 0xFF not in _NUMBERS:
        return label, _UNREAD
    values = _numbers(next(parts), order)
    if kind & 0x0800:
        values = values + 1j * _numbers(next(parts), order)
    return label, values.reshape(shape, order="F")


def _numbers(element: tuple[int, memoryview], order: str) -> NDArray[Any]:
    kind, content = element
    return np.frombuffer(content, f"{order}{_TYPES[kind]}")


def _squeezed(name: str, value: Any) -> Any:
    """A list without the second axis that MATLAB gives it."""
    is_list = isinstance(value, np.ndarray) and value.ndim == 2 and 1 in value.shape
    return value.reshape(-1) if is_list and name.endswith(("_hz", "_s", "status", "_mm_s")) else value


def _understand(dataset: h5py.Dataset) -> Any:
    """An array of version 7.3, whose axes are stored in the other order; text where MATLAB says that it is char."""
    values = hdf5_reading.read_whole(dataset)
    if text_attribute(dataset, "MATLAB_class") == "char":
        return "".join(chr(int(code)) for code in values.reshape(-1)[:255])
    name = str(dataset.name).rpartition("/")[2]
    return _squeezed(name, compound_complex(values).T)
