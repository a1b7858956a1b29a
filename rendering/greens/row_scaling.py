"""Rows of a bank scaled by powers of two, so that squares neither vanish nor overflow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

FLUSH = np.float32(2.0**-70)
"""Added and taken away again, it rounds single precision to multiples of 2**-94: no denormal is left."""


@dataclass(frozen=True, slots=True)
class ScaledRow:
    """One row of a bank as `values * 2**exponent`, with the largest value in [0.5, 1).

    Powers of two scale without rounding, so that a bank in any unit renders to the same bits and squares
    neither vanish nor overflow. A row of zeros has exponent 0.
    """

    values: RealArray
    exponent: int

    @property
    def silent(self) -> bool:
        # A look at the exponent spares most rows the search through all values.
        return not self.exponent and not self.values.any()

    def rounded(self) -> ScaledRow:
        """The row in float32, without a denormal number."""
        single = self.values.astype(np.float32) + FLUSH
        return ScaledRow(np.subtract(single, FLUSH, out=single), self.exponent)


def scale_row(raw: NDArray[Any], position: int, *, single: bool = False) -> ScaledRow:
    """Scale one row by a power of two.

    raw, (actuators, taps): The row as the bank has it.
    single: As float32, without a denormal number, instead of float64.

    Raises InputError: the row holds NaN or infinity.
    """
    values, shift = _without_denormals(raw)
    peak = max(float(values.max()), -float(values.min()))
    if not np.isfinite(peak):
        actuator = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise InputError(
            f"position {position}, actuator {actuator} of the bank holds NaN or infinity; remeasure or disable"
            " the position"
        )
    exponent = int(np.frexp(peak)[1]) if peak else 0
    if exponent:
        values *= np.ldexp(1.0, -exponent)
    if single:
        return ScaledRow(values, exponent + shift).rounded()
    if raw.dtype.itemsize >= np.dtype(np.float64).itemsize:
        # What stands 290 decades below the peak adds nothing but denormal arithmetic, 100 times slower.
        values[np.abs(values) < 1e-290] = 0.0
    return ScaledRow(values, exponent + shift)


def _without_denormals(raw: NDArray[Any]) -> tuple[Float64Array, int]:
    """Copy to float64 as `values * 2**shift`, without ever computing with a denormal number.

    A denormal is its integer mantissa times a fixed power of two, so that integers can carry it over.
    """
    integers = {np.dtype(np.float32): (np.uint32, 23, -149), np.dtype(np.float64): (np.uint64, 52, -1074)}
    if raw.dtype not in integers:
        return np.array(raw, dtype=np.float64, order="C"), 0
    unsigned, mantissa_bits, unit = integers[raw.dtype]
    raw = np.ascontiguousarray(raw)
    magnitude = raw.view(unsigned) & unsigned(2 ** (8 * raw.dtype.itemsize - 1) - 1)
    # Zero wraps round to the largest integer, so that the smallest one shows a denormal.
    magnitude -= unsigned(1)
    if magnitude.min(initial=unsigned(2**mantissa_bits)) >= 2**mantissa_bits - 1:
        return raw.astype(np.float64), 0
    magnitude += unsigned(1)
    denormal = magnitude < unsigned(2**mantissa_bits)
    largest = np.array(magnitude.max(), dtype=unsigned).view(raw.dtype)
    double = raw.dtype == np.float64
    if double and not largest < 2.0**-60:
        return np.where(denormal, 0.0, raw), 0  # they stand 290 decades below the rest
    lift = 54 if double else 0
    lifted = magnitude.astype(np.float64)
    lifted *= 2.0 ** (unit + lift)
    np.copysign(lifted, raw, out=lifted)
    if not denormal.all():
        lifted = np.where(denormal, lifted, np.where(denormal, raw.dtype.type(0), raw) * 2.0**lift)
    return lifted, -lift
