"""A bank as netCDF-4 with CF metadata, row by row; netCDF-4 as xarray and others write it, and netCDF-3, are read.

The arrays of any HDF5 file are read here, also those of MATLAB's version 7.3.
"""

import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.bank.layout import describe_status
from wavefocus.storage.bank.ledger import QUALITY
from wavefocus.storage.bank.notes import read_notes
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import Measured, require_honest
from wavefocus.storage.exchange.named_arrays import NamedArrays, measured_arrays
from wavefocus.storage.hdf5_writing import attach, created, dimension_scale, filled, reserved, set_long_names
from wavefocus.storage.missing import DEFAULT_FILL, KEYS, WithMissing, missing_numbers
from wavefocus.storage.output_files import EXPORT_MARK, replacement


def open_hdf5(path: Path, stack: ExitStack) -> h5py.File:
    """Open a file whose texts are sound."""
    file = stack.enter_context(hdf5_reading.opened(path, cache_bytes=64 << 20))
    hdf5_reading.require_sound_texts(file)
    return file


def numbers(file: h5py.File, name: str, path: Path) -> h5py.Dataset | None:
    """A dataset of real or complex numbers in the file itself; None where there is none.

    Raises InputError: it is elsewhere, of another kind, packed, or declares far more than the file holds.
    """
    if not hdf5_reading.has(file, name):
        return None
    dataset = hdf5_reading.plain_dataset(file, name, gaps=True, kinds="fiucV")
    require_honest(path, name, dataset.size * dataset.dtype.itemsize, dataset.id.get_storage_size())
    return dataset


def text_attribute(item: Any, name: str) -> str:
    """A text from an attribute of a group or dataset; empty where there is none."""
    if not hdf5_reading.holds_attribute(item, name) or item.attrs.get_id(name).get_storage_size() > 1 << 16:
        return ""
    value = item.attrs[name]
    value = value.reshape(-1)[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""


def read_arrays(
    path: Path, options: ImportOptions, stack: ExitStack, understand: Callable[[h5py.Dataset], Any]
) -> Measured:
    """Read a file's datasets and root attributes as named arrays; those of one group where it holds no other.

    understand: Turns a dataset into an array or a text.
    """
    file = open_hdf5(path, stack)
    names = sorted(name for name in file if not name.startswith("#"))
    listed = [full for name in names for full in _members(file, name)]
    group = ""
    if "green" not in names and not options.names:
        hard = [name for name in names if isinstance(file.get(name, getlink=True), h5py.HardLink)]
        groups = [name for name in hard if file.get(name, getclass=True) is h5py.Group]
        group = next((f"{name}/" for name in groups if hdf5_reading.has(file, f"{name}/green")), "")

    def get(name: str) -> Any:
        if "." in name and name not in names:
            name = name.replace(".", "/")  # as MATLAB writes a field of a struct
        place = name if "/" in name else group + name.replace("quality_", "quality/", 1)
        if (place != name and not hdf5_reading.has(file, place)) or place.startswith("#"):
            place = group + name
        found = numbers(file, place, path)
        if found is not None:
            return understand(found)
        if name in ("response_unit", "drive_unit"):
            return text_attribute(file, name) or (
                text_attribute(file["green"], "units") if name == "response_unit" and "green" in names else None
            )
        if name in ("sample_rate_hz", "band_hz") and hdf5_reading.holds_attribute(file, name):
            return np.array(hdf5_reading.numbers(file, name, 1 if name == "sample_rate_hz" else 2))
        return None

    def units(name: str) -> str:
        place = name if "/" in name else group + name
        return text_attribute(file[place], "units") if hdf5_reading.has(file, place) else ""

    return measured_arrays(NamedArrays(path, get, listed, units), options)


def _members(file: h5py.File, name: str) -> list[str]:
    """A dataset's name, or those of the members of a group."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink) or file.get(name, getclass=True) is not h5py.Group:
        return [name]
    return [f"{name}.{member}" for member in sorted(file[name])[:64]]


def compound_complex(values: NDArray[Any]) -> NDArray[Any]:
    """Complex numbers from the pairs (real, imag) that MATLAB and others store."""
    if values.dtype.names and len(values.dtype.names) == 2:
        first, second = values.dtype.names
        return np.asarray(values[first] + 1j * values[second])
    return values


LONG_NAMES = {
    "green": "Green's functions: FIR filters from drive to response, tap 0 at the drive sample",
    "position": "row of the bank",
    "actuator": "index of the actuator",
    "time_s": "time after the drive sample",
    "axis": "axis on the surface: origin at its centre, x right, y up, seen from the laser",
    "position_mm": "place of the position",
    "x_mm": "place of the position, to the right of the centre",
    "y_mm": "place of the position, above the centre",
    "actuator_mm": "place of the actuator, NaN where unknown",
    "status": "status bits of the position",
    **{name: about for name, (_, about) in QUALITY.items()},
}

_UDUNITS = {"dB": "0.1 lg(re 1)"}
"""Units that the CF conventions write otherwise: UDUNITS-2 knows no decibel."""


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write a netCDF-4 file with names and shapes of a bank (docs/reference/files.md), so that it is read as one, too.

    ``/quality`` holds the figures of the root a second time, as links, for readers of banks. One row is in memory.
    """
    bank, count = rows.bank, len(rows.row)
    data_bytes = 4 * (count + 1) * bank.actuators * (bank.taps + 8) + 96 * count
    with replacement(path) as temporary, created(temporary, data_bytes) as file:
        file.attrs.update(_attributes(rows))
        position = dimension_scale(file, "position", rows.row.astype(np.int32))
        actuator = dimension_scale(file, "actuator", np.arange(bank.actuators, dtype=np.int32))
        time_s = dimension_scale(file, "time_s", bank.time_s, "s")
        axis = file.create_dataset("axis", data=["x", "y"], dtype=h5py.string_dtype(), track_times=False)
        axis.make_scale("axis")
        attach(filled(file, "position_mm", rows.position_mm, "mm"), position, axis)
        for name, places_mm in zip(("x_mm", "y_mm"), rows.position_mm.T, strict=True):
            attach(filled(file, name, places_mm, "mm"), position)
        attach(filled(file, "actuator_mm", bank.actuator_mm, "mm"), actuator, axis)
        status = filled(file, "status", rows.status)
        describe_status(status)
        attach(status, position)
        for name, values in bank.quality.items():
            figures = filled(
                file, name, values[rows.row].astype("<f4"), _UDUNITS.get(QUALITY[name][0], QUALITY[name][0])
            )
            attach(figures, *(position, actuator)[: figures.ndim])
            file[f"quality/{name}"] = figures
        shape = (count, bank.actuators, bank.taps)
        green = reserved(file, "green", shape, "<f4", rows.units[0], chunk=(1, *shape[1:]))
        green.attrs["coordinates"] = "x_mm y_mm status"
        attach(green, position, actuator, time_s)
        set_long_names(file, LONG_NAMES)
        for index, (_, values) in enumerate(rows.each(on_progress)):
            green[index] = values


def _attributes(rows: ExportedRows) -> dict[str, object]:
    bank, about = rows.bank, rows.publication
    made = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} wavefocus {version('wavefocus')}: export of {rows.bank_name}"
    attributes: dict[str, object] = {
        "Conventions": "CF-1.11",
        "title": rows.title,
        "source": bank.software or "measured with another program",
        "history": made,
        "sample_rate_hz": np.float64(bank.sample_rate_hz),
        "response_unit": rows.units[0],
        "drive_unit": bank.drive_unit,
        EXPORT_MARK: "netcdf",
    }
    if bank.band_hz is not None:
        attributes["band_hz"] = np.array(bank.band_hz)
    if bank.directions_deg is not None:
        attributes["directions_deg"] = np.array(bank.directions_deg)
    if bank.check[rows.row].any():
        attributes["check_rows"] = np.flatnonzero(bank.check[rows.row]).astype(np.int32)
    if bank.import_report is not None:
        attributes["import_report"] = bank.import_report
    names = {
        "comment": "description", "creator_name": "people", "institution": "organisation", "license": "licence",
        "keywords": "keywords", "references": "references", "notes": "notes",
    }  # fmt: skip
    return attributes | {name: about[key] for name, key in names.items() if key in about}


_ATTRIBUTES = ("sample_rate_hz", "band_hz", "response_unit", "drive_unit")
"""Facts that a file may state in attributes of its own."""


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read arrays by name, from netCDF-4 row by row."""
    with path.open("rb") as file:
        head = file.read(4)
    if head == b"CDF\x05":
        raise InputError(f"{path} is netCDF-3 with 64-bit data (CDF-5); convert it with nccopy -k nc4 OLD.nc NEW.nc")
    if head.startswith(b"CDF"):
        return _read_classic(path, options, stack)

    def understand(dataset: h5py.Dataset) -> Any:
        if dataset.dtype.kind == "V":
            return compound_complex(hdf5_reading.read_whole(dataset))
        missing = hdf5_reading.missing_in(dataset)
        return WithMissing(dataset, missing) if missing else dataset

    with hdf5_reading.opened(path) as content:
        notes = read_notes(content)
    return replace(read_arrays(path, options, stack, understand), notes=notes)


def _read_classic(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    from scipy.io import netcdf_file

    stack.enter_context(warnings.catch_warnings())
    # Rows refer to the file's memory until the import is over.
    warnings.filterwarnings("ignore", message="Cannot close a netcdf_file")
    file = stack.enter_context(netcdf_file(path, "r", mmap=True, maskandscale=False))

    def get(name: str) -> Any:
        if name in file.variables:
            variable = file.variables[name]
            stored = np.array(variable.data)
            if stored.dtype.kind == "S":
                return b"".join(stored.reshape(-1).tolist()).decode("utf-8", "replace").strip("\0 ")
            attributes = {key: getattr(variable, key) for key in KEYS if hasattr(variable, key)}
            fill = DEFAULT_FILL.get(stored.dtype.str[1:])
            return WithMissing(stored, missing_numbers(attributes, f"{path}: {name}", fill))
        value = getattr(file, name, None) if name in _ATTRIBUTES else None
        if value is None and name == "response_unit" and "green" in file.variables:
            value = getattr(file.variables["green"], "units", None)
        return (
            value.decode("utf-8", "replace") if isinstance(value, bytes) else None if value is None else np.array(value)
        )

    def units(name: str) -> str:
        value = getattr(file.variables.get(name), "units", b"")
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else ""

    return measured_arrays(NamedArrays(path, get, file.variables, units), options)
