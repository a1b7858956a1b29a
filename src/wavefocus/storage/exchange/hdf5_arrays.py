"""Named arrays of HDF5 files: netCDF-4, and MATLAB's version 7.3."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.exchange.measured import Measured, require_honest
from wavefocus.storage.exchange.named_arrays import NamedArrays, measured_arrays


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
    dataset = hdf5_reading.plain_dataset(file, name, packed=True, kinds="fiucV")
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
