"""Drives into fields: the response that the bank predicts (eqs. 4 and 17)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import DTypeLike, NDArray

from rendering.field.prediction import FieldRows, OnProgress, Prediction
from rendering.greens.source import GreenSource, drive_unit, refusal, usable
from storage.drive_file import Drive
from storage.errors import InputError
from storage.field_file import Field
from storage.units import response_unit

Int64Array = NDArray[np.int64]

LISTED = 8


def predict(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float64,
    tolerance_db: float | None = None,
    rate_hz: float | None = None,
    on_progress: OnProgress | None = None,
) -> Field:
    """Predict the response y(x)[n] = sum_i (g_i(x) * f_i)[n], drive samples + L - 1 long.

    drive: The drives, at the bank's rate; the field starts with them.
    positions: Bank rows in any order; by default all that `measured_positions` gives.
    dtype, tolerance_db, rate_hz: See `Prediction`.
    on_progress: Called with positions done and positions in all.
    """
    index = chosen_positions(drive, bank, positions)
    prediction = Prediction(drive, bank, index, dtype=dtype, tolerance_db=tolerance_db, rate_hz=rate_hz)
    return prediction.field(on_progress)


def predict_rows(
    drive: Drive,
    bank: GreenSource,
    positions: Sequence[int] | None = None,
    *,
    dtype: DTypeLike = np.float32,
    tolerance_db: float | None = None,
    rate_hz: float | None = None,
    on_progress: OnProgress | None = None,
) -> Iterator[FieldRows]:
    """Predict like `predict`, a few rows at a time, for fields that are written as they come."""
    index = chosen_positions(drive, bank, positions)
    yield from Prediction(drive, bank, index, dtype=dtype, tolerance_db=tolerance_db, rate_hz=rate_hz).rows(on_progress)


def measured_positions(bank: GreenSource) -> tuple[Int64Array, Int64Array]:
    """Rows of a field by default, and rows left out as not measured."""
    allowed = usable(bank)
    return np.flatnonzero(allowed).astype(np.int64), np.flatnonzero(~allowed).astype(np.int64)


def field_unit(bank: GreenSource) -> str:
    """Unit of a field: that of the Green's functions times that of the drive."""
    return response_unit(bank.response_unit, drive_unit(bank))


def chosen_positions(drive: Drive, bank: GreenSource, positions: Sequence[int] | None) -> Int64Array:
    """Bank rows to predict.

    Raises InputError: drive and bank do not fit, a position does not exist or was not measured, or none is left.
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
