"""Banks, drives and fields in a catalogue of tiled, as xarray datasets: for ``--adapter application/x-hdf5=...``.

tiled's own adapter of HDF5 files fails on dimension scales, and verifies no checksum. ``pip install 'tiled[server]'``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tiled.adapters.hdf5 import HDF5Adapter
from tiled.adapters.xarray import DatasetAdapter
from tiled.utils import path_from_uri

from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import read_field

ROWS_AT_ONCE = 16
"""Rows of a bank in a chunk: a few MB, so that a client that asks for one row does not wait for the file."""


class FileAdapter:
    """Takes a file of this program as an xarray dataset, any other HDF5 file as tiled does."""

    @classmethod
    def from_catalog(cls, data_source: Any, node: Any, /, **options: Any) -> Any:
        """Open a file that the catalogue knows."""
        found = _dataset_of(path_from_uri(data_source.assets[0].data_uri))
        return HDF5Adapter.from_catalog(data_source, node, **options) if found is None else found

    @classmethod
    def from_uris(cls, data_uri: str, **options: Any) -> Any:
        """Open a file that the catalogue meets for the first time."""
        found = _dataset_of(path_from_uri(data_uri))
        return HDF5Adapter.from_uris(data_uri, **options) if found is None else found


def _dataset_of(path: Path) -> DatasetAdapter | None:
    openers: tuple[Callable[[Path], Any], ...] = open_bank, read_drive, read_field
    for opener in openers:
        try:
            dataset = opener(path).to_xarray()
        except InputError:
            continue
        return DatasetAdapter.from_dataset(dataset.chunk({"position": ROWS_AT_ONCE} if "green" in dataset else {}))
    return None
