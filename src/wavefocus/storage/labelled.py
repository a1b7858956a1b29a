"""Datasets of xarray with the names, dimensions and units of the files; xarray is imported when one is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from xarray import Dataset


def _xarray() -> Any:
    try:
        return import_module("xarray")
    except ImportError as error:
        raise InputError(f"to_xarray needs xarray ({error}): pip install 'wavefocus[exchange]'") from None


def labelled_dataset(data: Mapping[str, Any], coordinates: Mapping[str, Any], about: Mapping[str, Any]) -> Dataset:
    """A dataset of these variables and coordinates; of `about`, what is not None becomes attributes.

    Raises InputError: xarray is not installed.
    """
    stated = {name: value for name, value in about.items() if value is not None}
    dataset: Dataset = _xarray().Dataset(data, coordinates, stated)
    return dataset


def rows_on_demand(shape: tuple[int, ...], dtype: np.dtype[Any], read: Callable[[int], NDArray[Any]]) -> Any:
    """An array of that shape for a dataset whose rows, along its first axis, are read when they are used.

    Raises InputError: xarray is not installed.
    """
    backend_array: Any = _xarray().backends.BackendArray
    indexing = import_module("xarray.core.indexing")

    class Rows(backend_array):  # type: ignore[misc]
        def __init__(self) -> None:
            self.shape, self.dtype = shape, dtype

        def __getitem__(self, key: Any) -> Any:
            return indexing.explicit_indexing_adapter(key, self.shape, indexing.IndexingSupport.BASIC, self._read)

        @staticmethod
        def _read(key: tuple[int | slice, ...]) -> NDArray[Any]:
            wanted, within = np.arange(shape[0])[key[0]], key[1:]
            part = np.broadcast_to(0, shape[1:])[within].shape
            values = np.empty((wanted.size, *part), dtype)
            for index, row in enumerate(wanted.ravel().tolist()):
                values[index] = read(row)[within]
            return values.reshape(*wanted.shape, *part)

    return indexing.LazilyIndexedArray(Rows())
