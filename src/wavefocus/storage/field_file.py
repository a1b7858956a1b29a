"""The field file, docs/reference/files.md: the response at positions, predicted or scanned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import check_fields, checked, float_type, reals, require_times, whole_array
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import (
    attach,
    dimension_scale,
    filled,
    reserved,
    sample_times,
    sealed_output,
    set_long_names,
)  # fmt: skip

_FieldArray = NDArray[np.float32] | NDArray[np.float64]
Int64Array = NDArray[np.int64]

FORMAT = "wavefocus-field"
LONG_NAMES = {
    "field": "response at each position",
    "position": "row of the bank",
    "position_index": "row of the bank",
    "time_s": "scene time",
}


@dataclass(frozen=True, slots=True)
class LowPass:
    """What a field lost when it was made at a fraction of the bank's rate; out of range, InputError.

    passed_hz: Frequencies up to this are in the field as they are, > 0.
    factor: The bank's rate over the field's, >= 2.
    """

    passed_hz: float
    factor: int

    def __post_init__(self) -> None:
        if self.factor < 2:
            raise InputError(f"decimated_by is {self.factor}; 2 or more is needed, or no such attribute")
        if not (np.isfinite(self.passed_hz) and self.passed_hz > 0):
            raise InputError(f"band_hz ends at {self.passed_hz}; a frequency above 0 is needed")


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """The response at positions of a bank over time; out of range, InputError.

    field, float32 or float64 (K, n): Response of each position, finite.
    position_index, int64 (K,): Each row's position in the bank, >= 0.
    sample_rate_hz: Rate in Hz, > 0.
    start_s: Time of the first sample.
    response_unit: Unit of the response, ``"m/s"`` for a vibrometer.
    low_pass: That it is at a fraction of the bank's rate; None where nothing was low-passed.
    verified: Whether the file that it was read from carries checksums of all its values.
    """

    field: _FieldArray
    position_index: Int64Array
    sample_rate_hz: float
    start_s: float
    response_unit: str
    low_pass: LowPass | None = None
    verified: bool = True

    def __post_init__(self) -> None:
        check_fields(self)
        values: NDArray[Any] = reals("field", self.field)
        if values.dtype not in (np.float32, np.float64):
            values = values.astype(np.float64)
        if values.ndim != 2 or not values.size:
            raise InputError(f"/field has shape {values.shape}; (position, sample), each 1 or more, is needed")
        object.__setattr__(self, "field", values)
        object.__setattr__(self, "position_index", _indices(self.position_index, len(values)))
        _require_finite(values, self.position_index)
        require_times(self.sample_rate_hz, self.start_s)

    def __repr__(self) -> str:
        """Its size, in one line."""
        positions, samples = self.field.shape
        return (
            f"Field({positions} positions, {samples} samples at {self.sample_rate_hz:g} Hz from {self.start_s:g} s, "
            f"{self.response_unit})"
        )


def _require_finite(values: NDArray[Any], position_index: Int64Array) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        # A finite sum of squares has no other terms, and is found in half the time.
        doubtful = ~np.isfinite(np.einsum("ij,ij->i", values, values))
    for row, position in zip(values[doubtful], position_index[doubtful], strict=True):
        if not np.isfinite(row).all():
            raise InputError(f"/field of position {position} holds NaN or infinities; finite values are needed")


class _FieldWriter:
    """Writes the rows of a field file in turn; made by :func:`field_in_rows`."""

    def __init__(self, path: Path, data: h5py.Dataset) -> None:
        self._path, self._data, self._written = path, data, 0
        self._digest = hdf5_digest.RunningDigest(data.dtype)

    def write(self, rows: _FieldArray) -> None:
        """Write the next rows; ``rows`` is (k, samples) and finite, or InputError is raised."""
        first, last, shape = self._written, self._written + len(rows), self._data.shape
        if np.shape(rows)[1:] != shape[1:] or last > shape[0]:
            raise InputError(f"rows {first} to {last} of shape {np.shape(rows)} do not fit a field of {shape}")
        if not np.isfinite(rows).all():
            raise InputError(f"{self._path}: the field of rows {first} to {last} holds NaN or infinities")
        self._data[first:last] = rows
        self._digest.update(rows)
        self._written = last

    def finish(self) -> None:
        if self._written < len(self._data):
            raise InputError(f"{self._path}: row {self._written} of the field was never written; the file is left out")
        self._data.attrs[hdf5_digest.VALUES] = self._digest.hexdigest()


@contextmanager
def field_in_rows(
    path: str | Path,
    position_index: Sequence[int] | Int64Array,
    samples: int,
    *,
    sample_rate_hz: float,
    start_s: float,
    response_unit: str,
    low_pass: LowPass | None = None,
    dtype: DTypeLike = np.float32,
    force: bool = False,
) -> Iterator[_FieldWriter]:
    """Write a field file row by row; it appears under its name only when all rows were written.

    position_index, sequence of int (K,): Positions of the rows to come.
    samples: Samples per row, >= 1.
    sample_rate_hz, start_s, response_unit, low_pass: As :class:`Field`.
    dtype: float32 as the contract has it; float64 keeps more digits.
    force: Whether an older file of that name may be replaced; a bank, raw recordings or a link never is.

    Raises InputError: when a value is outside what is stated here, or the file cannot be written.
    """
    path, index = Path(path), _indices(position_index, len(position_index))
    if not len(index) or samples < 1:
        raise InputError(f"a field of {len(index)} positions and {samples} samples; 1 or more is needed")
    require_times(sample_rate_hz, start_s)
    kind = float_type(dtype).newbyteorder("<")
    data_bytes = len(index) * samples * kind.itemsize + 8 * (2 * len(index) + samples)
    about: dict[str, Any] = {"response_unit": response_unit}
    about |= {"sample_rate_hz": float(sample_rate_hz), "start_s": float(start_s)}
    if low_pass is not None:
        about |= {"band_hz": np.array([0.0, low_pass.passed_hz]), "decimated_by": low_pass.factor}
    with sealed_output(path, FORMAT, data_bytes, about, force=force) as file:
        positions = dimension_scale(file, "position", index)
        attach(filled(file, "/position_index", index), positions)
        data = reserved(file, "/field", (len(index), samples), kind.str, response_unit)
        attach(data, positions, dimension_scale(file, "time_s", sample_times(samples, sample_rate_hz, start_s), "s"))
        set_long_names(file, LONG_NAMES)
        writer = _FieldWriter(path, data)
        yield writer
        writer.finish()


@checked
def write_field(path: str | Path, field: Field, *, dtype: DTypeLike = np.float32, force: bool = False) -> None:
    """Write a field file; it appears under its name only when it is whole.

    Parameters
    ----------
    path
        Name of the file.
    field
        Responses, (positions, samples), and what is said of them.
    dtype
        float32, as other programs expect; float64 keeps more digits.
    force
        Whether an older file of that name may be replaced; a bank, raw recordings or a link never is.

    Raises
    ------
    InputError
        The file exists and may not be replaced, or cannot be written.

    Examples
    --------
    >>> import wavefocus as wf
    >>> wf.write_field("two.h5", wf.predict("drive.h5", "plate.h5", [0, 7]))
    """
    about = {name: getattr(field, name) for name in ("sample_rate_hz", "start_s", "response_unit", "low_pass")}
    with field_in_rows(path, field.position_index, field.field.shape[1], dtype=dtype, force=force, **about) as writer:
        writer.write(field.field)


class FieldRowReader(Closing):
    """A field file open for reading a few rows at a time, for fields that do not fit into memory; a context manager.

    position_index, int64 (K,): Bank row of each row of the field.
    samples, sample_rate_hz, start_s, response_unit, low_pass: See :class:`Field`.
    verified: Whether the file carries checksums of all its values.

    Raises InputError: the file is missing, damaged, no field file, or of a future version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = path = Path(path)
        with ExitStack() as stack:
            file = stack.enter_context(hdf5_reading.opened_as(path, FORMAT))
            self._field: h5py.Dataset = hdf5_reading.plain_dataset(file, "/field")
            if self._field.ndim != 2 or not self._field.size:
                raise InputError(f"{path}: /field has shape {self._field.shape}; (position, sample) is needed")
            hdf5_reading.require_rows(self._field)
            index = hdf5_reading.read_integers(file, "/position_index")
            self.samples = int(self._field.shape[1])
            self.sample_rate_hz = hdf5_reading.number(file, "sample_rate_hz")
            self.start_s = hdf5_reading.number(file, "start_s")
            unit = hdf5_reading.text(file, "response_unit")
            if unit is None:
                raise InputError(f"{path} has no attribute response_unit")
            self.response_unit = unit
            with hdf5_reading.named(path):
                self.position_index = _indices(index, len(self._field))
                self.low_pass = _read_low_pass(file)
                require_times(self.sample_rate_hz, self.start_s)
            hdf5_reading.require_sample_times(file, self.samples, self.sample_rate_hz, self.start_s)
            self.verified = hdf5_digest.require_all(file, apart="/field")
            self._sealed = hdf5_digest.VALUES in self._field.attrs
            self._open = stack.pop_all()

    def blocks(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Give the first row's number and the values (rows, samples) of some rows at a time.

        Raises InputError: a row cannot be read, or holds NaN or infinities; after the last one, their checksum does not
        hold.
        """
        digest = hdf5_digest.RunningDigest(self._field.dtype)
        at_once = max(1, (32 << 20) // (8 * self.samples))
        for first in range(0, len(self.position_index), at_once):
            words = f"{self.path}: /field from row {first}"
            values = hdf5_reading.read_part(self._field, slice(first, first + at_once), words)
            if not np.isfinite(values).all():
                raise InputError(f"{words} holds NaN or infinities")
            if self._sealed:
                digest.update(values)
            yield first, values
        if self._sealed:
            hdf5_digest.require_values(self._field, digest.hexdigest())
            self._sealed = False  # once is enough

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def whole(self) -> Field:
        """Read all rows, as float32 where the file holds no more digits; raises InputError as `blocks`."""
        kind = self._field.dtype
        hdf5_reading.require_whole(self._field)
        single = kind.kind == "f" and kind.itemsize <= 4
        values: _FieldArray = np.empty(self._field.shape, np.float32 if single else np.float64)
        for first, block in self.blocks():
            values[first : first + len(block)] = block
        return Field(
            values, self.position_index, self.sample_rate_hz, self.start_s, self.response_unit, self.low_pass,
            verified=self.verified,
        )  # fmt: skip


@checked
def read_field(path: str | Path) -> Field:
    """Read a field file, predicted or scanned.

    Parameters
    ----------
    path
        A field file, predicted or scanned.

    Returns
    -------
    Field
        ``field``, (positions, samples), from ``start_s`` on; ``position_index``, the rows of the bank.

    Raises
    ------
    InputError
        The file is missing, damaged, no field file, of a future version, or holds values out of range.

    Examples
    --------
    >>> import wavefocus as wf
    >>> field = wf.read_field("field.h5")
    >>> field.field.dtype, field.position_index
    (dtype('float32'), array([0, 7]))
    """
    with FieldRowReader(path) as rows:
        return rows.whole()


def _read_low_pass(file: h5py.File) -> LowPass | None:
    if "decimated_by" not in file.attrs:
        return None
    factor = hdf5_reading.number(file, "decimated_by")
    _, passed_hz = hdf5_reading.numbers(file, "band_hz", 2)
    if factor != round(factor):
        raise InputError(f"attribute decimated_by is {factor:g}; a whole number is needed")
    return LowPass(passed_hz, int(factor))


def _indices(position_index: Sequence[int] | Int64Array, count: int) -> Int64Array:
    indices = np.ascontiguousarray(whole_array("position_index", position_index))
    if indices.shape != (count,):
        raise InputError(f"/position_index has shape {indices.shape}; one position for each of {count} rows is needed")
    if (indices < 0).any():
        raise InputError(f"/position_index holds {indices.min()}; rows of a bank, 0 or more, are needed")
    return indices
