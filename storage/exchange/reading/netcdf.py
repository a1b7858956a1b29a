"""A bank as netCDF-4, as xarray and others write it; classic netCDF-3 is read too."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from wavefocus.storage import hdf5_reading
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.reading.hdf5_arrays import compound_complex, read_arrays
from wavefocus.storage.exchange.reading.measured import ImportOptions, Measured
from wavefocus.storage.exchange.reading.named_arrays import NamedArrays, measured_arrays
from wavefocus.storage.packing import DEFAULT_FILL, KEYS, UnpackedArray, packing

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
            return compound_complex(hdf5_reading.read_whole(dataset, path))
        how = hdf5_reading.packing_of(dataset, path)
        return dataset if how.is_plain else UnpackedArray(dataset, how)

    return read_arrays(path, options, stack, understand)


def _read_classic(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    from scipy.io import netcdf_file

    file = stack.enter_context(netcdf_file(path, "r", mmap=True, maskandscale=False))

    def get(name: str) -> Any:
        if name in file.variables:
            variable = file.variables[name]
            stored = np.array(variable.data)
            if stored.dtype.kind == "S":
                return b"".join(stored.reshape(-1).tolist()).decode("utf-8", "replace").strip("\0 ")
            attributes = {key: getattr(variable, key) for key in KEYS if hasattr(variable, key)}
            fill = DEFAULT_FILL.get(stored.dtype.str[1:])
            return UnpackedArray(stored, packing(attributes, stored.dtype, f"{path}: {name}", fill))
        value = getattr(file, name, None) if name in _ATTRIBUTES else None
        if value is None and name == "response_unit" and "green" in file.variables:
            value = getattr(file.variables["green"], "units", None)
        return (
            value.decode("utf-8", "replace") if isinstance(value, bytes) else None if value is None else np.array(value)
        )

    return measured_arrays(NamedArrays(path, get, file.variables), options)
