"""Dimension scales of drive and field files, so that other programs show labelled dimensions and units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import hdf5_safety
from storage.errors import InputError

LIBVER = ("v108", "v108")
"""Object headers of HDF5 1.8 and later carry checksums; every HDF5 of the last fifteen years reads them."""
_UNITS = {"time_s": "s"}
# What rounding may put between two ways of counting samples.
_ROUNDING_SAMPLES = 1e-2


def sample_times(samples: int, sample_rate_hz: float, start_s: float) -> NDArray[np.float64]:
    """Times of samples in seconds, float64 (samples,)."""
    return start_s + np.arange(samples) / sample_rate_hz


def label(dataset: h5py.Dataset, **scales: NDArray[Any]) -> None:
    """Write a dimension scale for each dimension of a dataset, and attach it."""
    for dimension, (name, values) in zip(dataset.dims, scales.items(), strict=True):
        scale = dataset.file.create_dataset(name, data=values)
        scale.attrs["units"] = _UNITS.get(name, "1")
        scale.make_scale(name)
        dimension.attach_scale(scale)


def require_sample_times(file: h5py.File, path: Path, samples: int, sample_rate_hz: float, start_s: float) -> None:
    """Refuse a file whose `/time_s` contradicts its rate and start; one without `/time_s` is fine.

    Raises
    ------
    InputError
        It has another number of times, or they are others.
    """
    if not hdf5_safety.has(file, "/time_s"):
        return
    time_s = hdf5_safety.read_floats(file, "/time_s", path, (samples,))
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(time_s - sample_times(samples, sample_rate_hz, start_s)) * sample_rate_hz
    if not (off <= _ROUNDING_SAMPLES).all():
        sample = int(np.argmax(~(off <= _ROUNDING_SAMPLES)))
        raise InputError(
            f"{path}: /time_s has {time_s[sample]:g} s at sample {sample}, and by sample_rate_hz it is at"
            f" {start_s + sample / sample_rate_hz:g} s; they must agree"
        )
