"""Drives into fields: the response that the bank predicts (eqs. 4 and 17)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from calibration.drive_file import Drive
from calibration.errors import InputError
from calibration.field_file import Field
from rendering.convolution import Convolution
from rendering.green_source import GreenSource, refusal, usable

Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]
OnProgress = Callable[[int, int], None]

THREADS = 2
"""Parts under way at a time, each with transforms and products of its own."""
LEAST_ROWS = 8
"""Fewer rows are not worth a thread of their own."""
LISTED = 8


@dataclass(frozen=True, slots=True)
class FieldRows:
    """Some rows of a predicted field.

    Parameters
    ----------
    first : int
        Index of the first of them in the field.
    position_index : int64 array, shape (k,)
        Their bank rows.
    field : float32 or float64 array, shape (k, samples)
        Their responses.
    """

    first: int
    position_index: Int64Array
    field: RealArray


def predict(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float64,
    on_progress: OnProgress | None = None,
) -> Field:
    """Predict the response y(x)[n] = sum_i (g_i(x) * f_i)[n], drive samples + L - 1 long.

    Parameters
    ----------
    drive : Drive
        The drives, at the bank's rate.
    bank : GreenSource
        Measured Green's functions.
    positions : sequence of int, optional
        Bank rows in the order wanted; by default all that `measured_positions` gives.
    dtype : {float64, float32}
        float64: to 1e-12 of direct evaluation. float32: spectra in complex64, about twice as fast, 1e-6 of
        each position's largest response.
    on_progress : callable, optional
        Told positions done and positions in all.

    Returns
    -------
    Field
        Starts with the drive.

    Raises
    ------
    InputError
        Drive and bank do not fit, or a position asked for was not measured.
    """
    index = chosen_positions(drive, bank, positions)
    samples = field_samples(drive, bank)
    field = np.empty((len(index), samples), dtype=_precision(dtype))
    for rows in predict_rows(drive, bank, index.tolist(), dtype=dtype, on_progress=on_progress):
        field[rows.first : rows.first + len(rows.field)] = rows.field
    return Field(
        field=field,
        position_index=index,
        sample_rate_hz=drive.sample_rate_hz,
        start_s=drive.start_s,
        response_unit=field_unit(bank),
    )


def predict_rows(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float32,
    on_progress: OnProgress | None = None,
) -> Iterator[FieldRows]:
    """Predict like `predict`, a few rows at a time, for fields that are written as they come."""
    index = chosen_positions(drive, bank, positions)
    convolution = Convolution(drive, bank, _precision(dtype))
    at_once = min(convolution.rows_at_once, max(LEAST_ROWS, -(-len(index) // THREADS)))
    parts = deque((first, index[first : first + at_once]) for first in range(0, len(index), at_once))
    under_way: deque[tuple[int, Int64Array, Future[RealArray]]] = deque()
    with ThreadPoolExecutor(THREADS) as pool:
        try:
            while parts or under_way:
                while parts and len(under_way) <= THREADS:
                    first, part = parts.popleft()
                    under_way.append((first, part, pool.submit(convolution.respond, part)))
                first, part, field = under_way.popleft()
                yield FieldRows(first, part, field.result())
                if on_progress is not None:
                    on_progress(first + len(part), len(index))
        finally:
            for _, _, field in under_way:
                field.cancel()


def measured_positions(bank: GreenSource) -> tuple[Int64Array, Int64Array]:
    """Which rows a field has where none are asked for, and which are left out as not measured."""
    allowed = usable(bank)
    return np.flatnonzero(allowed).astype(np.int64), np.flatnonzero(~allowed).astype(np.int64)


def field_samples(drive: Drive, bank: GreenSource) -> int:
    """Samples of a predicted field: drive samples + L - 1."""
    return int(drive.drive_v.shape[1]) + bank.taps - 1


def field_unit(bank: GreenSource) -> str:
    """Unit of a field: that of the Green's functions without the volts of the drive."""
    return bank.response_unit.removesuffix("/V")


def chosen_positions(drive: Drive, bank: GreenSource, positions: Sequence[int] | None) -> Int64Array:
    """Settle which bank rows to predict.

    Raises
    ------
    InputError
        Drive and bank do not fit, a position does not exist or was not measured, or none is left.
    """
    if len(drive.drive_v) != bank.actuators:
        raise InputError(f"the drive has {len(drive.drive_v)} actuators, the bank {bank.actuators}; they must agree")
    if abs(drive.sample_rate_hz / bank.sample_rate_hz - 1.0) > 1e-9:
        raise InputError(
            f"the drive is at {drive.sample_rate_hz:g} Hz, the bank at {bank.sample_rate_hz:g} Hz; they must agree"
        )
    if positions is None:
        index, _ = measured_positions(bank)
        if not len(index):
            raise InputError("the bank has no measured position; nothing can be predicted")
        return index
    index = np.asarray(positions, dtype=np.int64).reshape(-1)
    if not len(index):
        raise InputError("positions is empty; at least one bank row is needed")
    missing = index[(index < 0) | (index >= bank.positions)]
    if len(missing):
        raise InputError(f"positions holds {missing[0]}; allowed are 0 to {bank.positions - 1}")
    status = np.asarray(bank.status)
    refused = [int(row) for row in index if refusal(int(status[row]))]
    if refused:
        more = f" and {len(refused) - LISTED} more" if len(refused) > LISTED else ""
        named = ", ".join(map(str, refused[:LISTED]))
        raise InputError(
            f"positions holds {named}{more}: {refusal(int(status[refused[0]]))}; leave them out or measure them"
        )
    return index


def _precision(dtype: DTypeLike) -> np.dtype[Any]:
    chosen = np.dtype(dtype)
    if chosen not in (np.float32, np.float64):
        raise InputError(f"dtype is {chosen}; allowed are float32 and float64")
    return chosen
