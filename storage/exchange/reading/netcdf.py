"""A bank as netCDF-4, as xarray and others write it; classic netCDF-3 is read too."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from wavefocus.storage import hdf5_reading
from wavefocus.storage.exchange.reading.hdf5_arrays import compound_complex, read_arrays
from wavefocus.storage.exchange.reading.measured import ImportOptions, Measured
from wavefocus.storage.exchange.reading.named_arrays import NamedArrays, measured_arrays


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read arrays by name, from netCDF-4 row by row."""
    with path.open("rb") as file:
        classic = file.read(3) == b"CDF"
    if classic:
        return _read_classic(path, options, stack)

    def understand(dataset: h5py.Dataset) -> Any:
        if dataset.dtype.kind == "V":
            return compound_complex(hdf5_reading.read_whole(dataset, path))
        packing = hdf5_reading.packing_of(dataset, path)
        return dataset if packing.is_plain else packing.unpack(hdf5_reading.read_whole(dataset, path))

    return read_arrays(path, options, stack, understand)


def _read_classic(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    from scipy.io import netcdf_file

    file = stack.enter_context(netcdf_file(path, "r", mmap=True, maskandscale=False))

    def get(name: str) -> Any:
        if name in file.variables:
            return np.array(file.variables[name].data)
        value = getattr(file, name, None) if name.isidentifier() and not name.startswith("_") else None
        return value.decode("utf-8", "replace") if isinstance(value, bytes) else None

    return measured_arrays(NamedArrays(path, get, file.variables), options)
