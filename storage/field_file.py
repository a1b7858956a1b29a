"""The field file, contract section 5: the response at positions, predicted or scanned."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import InitVar, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from storage import hdf5_digest, hdf5_safety
from storage.errors import InputError
from storage.hdf5_output import created
from storage.labelled_hdf5 import label, require_sample_times, sample_times
from storage.output_files import replacement

FieldArray = NDArray[np.float32] | NDArray[np.float64]
Int64Array = NDArray[np.int64]

FORMAT = "wavefocus-field"
VERSION = 1


@dataclass(frozen=True, slots=True)
class LowPass:
    """What a field lost when it was made at a fraction of the bank's rate.

    Parameters
    ----------
    passed_hz : float
        Frequencies up to this are in the field as they are, > 0.
    factor : int
        The bank's rate over the field's, >= 2.

    Raises
    ------
    InputError
        When the factor is below 2, or the frequency not above 0.
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
    """The response at positions of a bank over time.

    Parameters
    ----------
    field : float32 or float64 array (K, n)
        Response of each position, finite.
    position_index : int64 array (K,)
        Each row's position in the bank, >= 0.
    sample_rate_hz : float
        Rate in Hz, > 0.
    start_s : float
        Time of the first sample.
    response_unit : str
        Unit of the response, ``"m/s"`` for a vibrometer.
    low_pass : LowPass, optional
        That it is at a fraction of the bank's rate; None where nothing was low-passed.
    verified : bool
        Whether the file that it was read from carries checksums of all its values.
    known_finite : bool
        Whether the responses need not be looked at: whoever made them knows that they are finite.

    Raises
    ------
    InputError
        When a value is outside what is stated here.
    """

    field: FieldArray
    position_index: Int64Array
    sample_rate_hz: float
    start_s: float
    response_unit: str
    low_pass: LowPass | None = None
    verified: bool = True
    known_finite: InitVar[bool] = False

    def __post_init__(self, known_finite: bool) -> None:
        values: NDArray[Any] = np.asarray(self.field)
        if values.dtype not in (np.float32, np.float64):
            values = values.astype(np.float64)
        if values.ndim != 2 or not values.size:
            raise InputError(f"/field has shape {values.shape}; (position, sample), each 1 or more, is needed")
        object.__setattr__(self, "field", values)
        object.__setattr__(self, "position_index", _indices(self.position_index, len(values)))
        if not known_finite:
            _require_finite(values, self.position_index)
        _require_times(self.sample_rate_hz, self.start_s)


def _require_finite(values: NDArray[Any], position_index: Int64Array) -> None:
    with np.errstate(over="ignore", invalid="ignore"):
        # A finite sum of squares has no other terms, and is found in half the time.
        doubtful = ~np.isfinite(np.einsum("ij,ij->i", values, values))
    for row, position in zip(values[doubtful], position_index[doubtful], strict=True):
        if not np.isfinite(row).all():
            raise InputError(f"/field of position {position} holds NaN or infinities; finite values are needed")


class FieldWriter:
    """Writes a field file row by row; a context manager whose file appears only when all rows were written.

    Parameters
    ----------
    path : str or Path
        The file; an older one is replaced at the end.
    position_index : sequence of int (K,)
        Positions of the rows to come.
    samples : int
        Samples per row, >= 1.
    sample_rate_hz, start_s, response_unit, low_pass
        As :class:`Field`.
    dtype : dtype
        float32 as the contract has it; float64 keeps more digits.

    Raises
    ------
    InputError
        When a value is outside what is stated here, or the file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        position_index: Sequence[int] | Int64Array,
        samples: int,
        *,
        sample_rate_hz: float,
        start_s: float,
        response_unit: str,
        low_pass: LowPass | None = None,
        dtype: DTypeLike = np.float32,
    ) -> None:
        self.path = Path(path)
        self._index = _indices(position_index, len(position_index))
        if not len(self._index) or samples < 1:
            raise InputError(f"a field of {len(self._index)} positions and {samples} samples; 1 or more is needed")
        _require_times(sample_rate_hz, start_s)
        self._attributes = {"sample_rate_hz": float(sample_rate_hz), "start_s": float(start_s)}
        self._unit = response_unit
        self._low_pass = low_pass
        self._shape = (len(self._index), samples)
        self._dtype = np.dtype(dtype).newbyteorder("<")
        self._written = np.zeros(len(self._index), bool)
        self._digest = hdf5_digest.RunningDigest(self._dtype)
        self._summed = 0
        self._stack = ExitStack()

    def write(self, first: int, rows: FieldArray) -> None:
        """Write rows ``first``, ``first + 1``, ...; ``rows`` is (k, samples) and finite.

        Raises
        ------
        InputError
            When the rows do not fit or are not finite.
        """
        last = first + len(rows)
        if np.shape(rows)[1:] != self._shape[1:] or first < 0 or last > self._shape[0]:
            raise InputError(f"rows {first} to {last} of shape {np.shape(rows)} do not fit a field of {self._shape}")
        if not np.isfinite(rows).all():
            raise InputError(f"{self.path}: the field of rows {first} to {last} holds NaN or infinities")
        self._data[first:last] = rows
        self._written[first:last] = True
        if first == self._summed:
            self._digest.update(rows)
            self._summed = last
        else:
            self._summed = -1  # out of order: the whole is read again at the end

    def __enter__(self) -> Self:
        count, samples = self._shape
        data_bytes = count * samples * self._dtype.itemsize + 8 * (2 * count + samples)
        with ExitStack() as stack:
            temporary = stack.enter_context(replacement(self.path))
            file = stack.enter_context(created(temporary, data_bytes))
            file.attrs["format"] = FORMAT
            file.attrs["format_version"] = VERSION
            file.attrs["response_unit"] = self._unit
            for name, value in self._attributes.items():
                file.attrs[name] = value
            if self._low_pass is not None:
                file.attrs["band_hz"] = np.array([0.0, self._low_pass.passed_hz])
                file.attrs["decimated_by"] = self._low_pass.factor
            file.create_dataset("position_index", data=self._index, dtype="<i8")
            self._data = file.create_dataset("field", self._shape, self._dtype)
            self._data.attrs["units"] = self._unit
            times = sample_times(self._shape[1], self._attributes["sample_rate_hz"], self._attributes["start_s"])
            label(self._data, position=self._index, time_s=times)
            file["position_index"].dims[0].attach_scale(file["position"])
            self._file = file
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None and not self._written.all():
            missing = int(np.flatnonzero(~self._written)[0])
            error = InputError(f"{self.path}: row {missing} of the field was never written; the file is left out")
            self._stack.__exit__(type(error), error, None)
            raise error
        try:
            if kind is None:
                if self._summed == len(self._index):
                    self._data.attrs[hdf5_digest.VALUES] = self._digest.hexdigest()
                hdf5_digest.seal(self._file)
        except BaseException as failure:
            self._stack.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._stack.__exit__(kind, error, trace)


def write_field(path: str | Path, field: Field, *, dtype: DTypeLike = np.float32) -> None:
    """Write a field file, as float32 unless told otherwise.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    with FieldWriter(
        path,
        field.position_index,
        field.field.shape[1],
        sample_rate_hz=field.sample_rate_hz,
        start_s=field.start_s,
        response_unit=field.response_unit,
        low_pass=field.low_pass,
        dtype=dtype,
    ) as writer:
        writer.write(0, field.field)


def read_field(path: str | Path) -> Field:
    """Read a field file.

    Raises
    ------
    InputError
        When the file is missing, damaged, no field file, of a future version, or holds values out of range.
    """
    path = Path(path)
    with hdf5_safety.opened(path) as file:
        hdf5_safety.require_format(file, path, FORMAT, VERSION)
        hdf5_safety.require_sound_texts(file, path)
        dataset = hdf5_safety.plain_dataset(file, "/field", path)
        single = dataset.dtype.kind == "f" and dataset.dtype.itemsize <= 4
        stored = hdf5_safety.read_whole(dataset, path)
        values: FieldArray = stored.astype(np.float32) if single else stored.astype(np.float64)
        index = hdf5_safety.read_integers(file, "/position_index", path)
        rate, start_s = (hdf5_safety.number(file, name, path) for name in ("sample_rate_hz", "start_s"))
        unit = hdf5_safety.text(file, "response_unit", path)
        low_pass = read_low_pass(file, path)
        if unit is None:
            raise InputError(f"{path} has no attribute response_unit")
        try:
            field = Field(values, index, rate, start_s, unit, low_pass)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        require_sample_times(file, path, stored.shape[1], rate, start_s)
        # Last, so that a value that is wrong in itself is named.
        hdf5_digest.require_contents(file, path)
        verified = hdf5_digest.require_datasets(file, path, {"/field"})
        if (expected := hdf5_digest.expected_sha256(dataset, path)) is not None:
            hdf5_digest.require_values(hdf5_digest.values_sha256(stored), expected, "/field", path)
    return field if verified else replace(field, verified=False, known_finite=True)


def read_low_pass(file: h5py.File, path: Path) -> LowPass | None:
    """Read what a field lost to a lower rate; None where its file says nothing of one.

    Raises
    ------
    InputError
        When the attributes hold something else.
    """
    if "decimated_by" not in file.attrs:
        return None
    factor = hdf5_safety.number(file, "decimated_by", path)
    _, passed_hz = hdf5_safety.numbers(file, "band_hz", path, 2)
    if factor != round(factor):
        raise InputError(f"{path}: attribute decimated_by is {factor:g}; a whole number is needed")
    try:
        return LowPass(passed_hz, int(factor))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _indices(position_index: Sequence[int] | Int64Array, count: int) -> Int64Array:
    indices = np.ascontiguousarray(position_index, np.int64)
    if indices.shape != (count,):
        raise InputError(f"/position_index has shape {indices.shape}; one position for each of {count} rows is needed")
    if (indices < 0).any():
        raise InputError(f"/position_index holds {indices.min()}; rows of a bank, 0 or more, are needed")
    return indices


def _require_times(sample_rate_hz: float, start_s: float) -> None:
    if not (np.isfinite(sample_rate_hz) and sample_rate_hz > 0):
        raise InputError(f"sample_rate_hz is {sample_rate_hz}; a rate above 0 is needed")
    if not np.isfinite(start_s):
        raise InputError(f"start_s is {start_s}; a finite time is needed")
