"""Banks, drives and fields as xarray datasets, with the names, dimensions and units of their files."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.storage.bank.ledger import QUALITY
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import sample_times

if TYPE_CHECKING:
    from xarray import Dataset

    from wavefocus.storage.bank.reading import Bank
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

AXES = ["x", "y"]


def _xarray() -> Any:
    try:
        return import_module("xarray")
    except ImportError as error:
        raise InputError(f"to_xarray needs xarray ({error}): pip install 'wavefocus[exchange]'") from None


def bank_dataset(bank: Bank) -> Dataset:
    """The bank as a dataset; rows of ``green`` are read, and verified, when they are used."""
    xarray = _xarray()
    indexing = import_module("xarray.core.indexing")
    backend_array: Any = xarray.backends.BackendArray

    class Rows(backend_array):  # type: ignore[misc]
        shape = (bank.positions, bank.actuators, bank.taps)
        dtype = bank.rows.dtype

        def __getitem__(self, key: Any) -> Any:
            return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

        @staticmethod
        def _read(key: tuple[int | slice, ...]) -> Any:
            wanted, within = np.arange(bank.positions)[key[0]], key[1:]
            shape = np.broadcast_to(0, Rows.shape[1:])[within].shape
            values = np.empty((wanted.size, *shape), Rows.dtype)
            for index, row in enumerate(wanted.ravel().tolist()):
                values[index] = bank.rows.read(row)[within]
            return values.reshape(*wanted.shape, *shape)

    pair = ("position", "actuator")
    data = {
        "green": ((*pair, "time_s"), indexing.LazilyIndexedArray(Rows()), {"units": bank.response_unit}),
        "rms": (pair, bank.rms, {"units": bank.response_unit}),
    } | {name: (pair[: figures.ndim], figures, {"units": QUALITY[name][0]}) for name, figures in bank.quality.items()}
    coordinates = {
        "position": np.arange(bank.positions),
        "actuator": np.arange(bank.actuators),
        "time_s": ("time_s", bank.time_s, {"units": "s"}),
        "axis": AXES,
        "position_mm": (("position", "axis"), bank.position_mm, {"units": "mm"}),
        "actuator_mm": (("actuator", "axis"), bank.actuator_mm, {"units": "mm"}),
        "status": ("position", bank.status),
    }
    about = {
        "sample_rate_hz": bank.sample_rate_hz,
        "response_unit": bank.response_unit,
        "drive_unit": bank.drive_unit,
        "band_hz": bank.band_hz,
        "software": bank.software,
    }
    return _dataset(xarray, data, coordinates, about)


def drive_dataset(drive: Drive) -> Dataset:
    """The drive as a dataset: ``drive``, and ``focus_sample``, ``focus_position`` and ``focus_source``."""
    actuators, samples = drive.drive_v.shape
    data = {"drive": (("actuator", "time_s"), drive.drive_v, {"units": drive.drive_unit})} | {
        name: ("focus", getattr(drive, name)) for name in ("focus_sample", "focus_position", "focus_source")
    }
    times_s = sample_times(samples, drive.sample_rate_hz, drive.start_s)
    coordinates = {"actuator": np.arange(actuators), "time_s": ("time_s", times_s, {"units": "s"})}
    names = ("sample_rate_hz", "start_s", "method", "scale", "omitted_bound")
    return _dataset(_xarray(), data, coordinates, {name: getattr(drive, name) for name in names})


def field_dataset(field: Field) -> Dataset:
    """The field as a dataset: ``field``, its ``position`` the row of the bank."""
    times_s = sample_times(field.field.shape[1], field.sample_rate_hz, field.start_s)
    data = {"field": (("position", "time_s"), field.field, {"units": field.response_unit})}
    coordinates = {"position": field.position_index, "time_s": ("time_s", times_s, {"units": "s"})}
    names = ("sample_rate_hz", "start_s", "response_unit")
    return _dataset(_xarray(), data, coordinates, {name: getattr(field, name) for name in names})


def _dataset(xarray: Any, data: Any, coordinates: Any, about: Mapping[str, Any]) -> Dataset:
    known = {name: value for name, value in about.items() if value is not None}
    dataset: Dataset = xarray.Dataset(data, coordinates, known)
    return dataset
