"""Rows of a bank scaled by powers of two, so that squares neither vanish nor overflow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.inner_loops import InnerLoops
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest number of single precision that is not denormal."""
LOOKED_AT = 8
"""Every so many samples are looked at for denormal numbers."""
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


@dataclass(frozen=True, slots=True)
class RawRow:
    """One row of a bank as it is, to be multiplied with 2**-exponent.

    Parameters
    ----------
    values : float32 array, shape (actuators, taps)
        Contiguous; largest value times 2**-exponent in [0.5, 1), none denormal.
    exponent : int
    energies : float64 array, shape (2, actuators)
        Of the scaled row: in the taps that are used, and in the others.
    """

    values: NDArray[np.float32]
    exponent: int
    energies: Float64Array


def look_at_rows(raws: Sequence[NDArray[Any]], used_taps: int, loops: InnerLoops) -> list[RawRow] | None:
    """Look at rows that compiled loops are to scale.

    Parameters
    ----------
    raws : sequence of arrays, shape (actuators, taps)
        Rows as the bank has them.
    used_taps : int
        How many taps, from the first, are used.
    loops : InnerLoops
        The loops.

    Returns
    -------
    list of RawRow, or None
        None where a row is of another type than float32, all zeros, not finite or holds denormal numbers.
    """
    if any(raw.dtype != np.float32 for raw in raws):
        return None
    # Elsewhere than a number of their size may lie they are copied, too.
    rows = [np.require(raw, requirements=["C", "A"]) for raw in raws]
    largest, smallest, energies = loops.look(rows, used_taps)
    if not ((largest > 0) & (largest < np.inf)).all():
        return None
    exponents = np.frexp(largest)[1].astype(np.int64)
    # What is denormal when it is scaled is, too.
    if (smallest < np.ldexp(SMALLEST, np.maximum(exponents, 0))).any():
        return None
    energies = np.ldexp(energies, -2 * exponents[:, None, None])
    return [RawRow(*row) for row in zip(rows, exponents.tolist(), energies, strict=True)]


def scale_row(raw: NDArray[Any], position: int, *, single: bool = False) -> ScaledRow:
    """Scale one row by a power of two.

    Parameters
    ----------
    raw : array, shape (actuators, taps)
        The row as the bank has it.
    position : int
        Its number, for messages.
    single : bool
        As float32, without a denormal number, instead of float64.

    Raises
    ------
    InputError
        The row holds NaN or infinity.
    """
    if raw.dtype == np.float32:
        row = _scaled_plainly(raw, single=single)
        if row is not None:
            return row
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


def scale_together(raws: Sequence[NDArray[Any]], out: RealArray) -> Int64Array | None:
    """Scale rows side by side, each as `scale_row` does.

    Parameters
    ----------
    raws : sequence of arrays, shape (actuators, taps)
        Rows as the bank has them.
    out : float32 or float64 array, shape (rows, actuators, taps)
        Gets the scaled values, however it lies.

    Returns
    -------
    int64 array, shape (rows,), or None
        Exponents of the rows. None where one is of another type than float32, all zeros, not finite or holds denormal
        numbers: then each needs `scale_row`.
    """
    if any(raw.dtype != np.float32 for raw in raws):
        return None
    exponents = [_plain_exponent(raw, single=True) for raw in raws]
    found = [exponent for exponent in exponents if exponent is not None]
    if len(found) < len(exponents):
        return None
    for raw, exponent, values in zip(raws, found, out, strict=True):
        np.multiply(raw, np.ldexp(np.float32(1.0), -exponent), out=values)
    return np.array(found, dtype=np.int64)


def _scaled_plainly(raw: NDArray[np.float32], *, single: bool) -> ScaledRow | None:
    """Scale as it is what can be scaled without meeting a number that is denormal or not finite."""
    exponent = _plain_exponent(raw, single=single)
    if exponent is None:
        return None
    if single:
        return ScaledRow(raw * np.ldexp(np.float32(1.0), -exponent), exponent)
    values = raw.astype(np.float64)
    values *= np.ldexp(1.0, -exponent)
    return ScaledRow(values, exponent)


def _plain_exponent(raw: NDArray[np.float32], *, single: bool) -> int | None:
    """Exponent of a row that has no number that is denormal or not finite."""
    peak = max(float(raw.max()), -float(raw.min()))
    if not 0.0 < peak < np.inf:
        return None
    exponent = math.frexp(peak)[1]
    # Without their sign, and with zero wrapped round to the largest, the smallest integer tells. They come in
    # flocks, where a response has died away, and a few that are missed cost next to nothing.
    magnitude = raw[:, ::LOOKED_AT].view(np.uint32) << np.uint32(1)
    magnitude -= np.uint32(1)
    least_exponent = max(exponent, 0) if single else 0
    return exponent if int(magnitude.min()) >= ((least_exponent + 1) << 24) - 1 else None


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
    # Zero wraps round to the largest integer, so that the smallest one tells whether there is a denormal.
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
