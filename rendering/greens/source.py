"""The read interface of a bank, and its rows scaled by powers of two so that squares neither vanish nor overflow."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavefocus.rendering.arrays import BoolArray, Float32Array, Float64Array
from wavefocus.storage.argument_types import bank_row, check_fields, real_array, reals, whole_array
from wavefocus.storage.errors import InputError
from wavefocus.storage.point_status import DOUBTFUL, USABLE, Status
from wavefocus.storage.point_status import usable as usable_rows
from wavefocus.storage.units import drive_of

RealArray = Float32Array | Float64Array

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


DOUBTFUL_BITS = int(DOUBTFUL)


class GreenSource(Protocol):
    """The read interface of a bank: `wavefocus.storage.bank.reading.Bank`, or an array in memory."""

    @property
    def position_mm(self) -> Float64Array:
        """Grid, float64 (positions, 2), millimetres."""

    @property
    def actuator_mm(self) -> Float64Array:
        """Actuator positions, float64 (actuators, 2), millimetres, NaN where unknown."""

    @property
    def sample_rate_hz(self) -> float:
        """Rate of the Green's functions in Hz."""

    @property
    def taps(self) -> int:
        """Length L of a Green's function in samples."""

    @property
    def actuators(self) -> int:
        """Number N of actuators."""

    @property
    def positions(self) -> int:
        """Number P of positions."""

    @property
    def band_hz(self) -> tuple[float, float] | None:
        """Measured band in Hz, None where unknown."""

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits of each position, uint8 (positions,)."""

    @property
    def response_unit(self) -> str:
        """Unit of the response, by default m/s/V per volt of drive."""

    def green(self, position: int) -> NDArray[Any]:
        """Green's functions of one row, (actuators, taps)."""


def require_source(bank: object) -> None:
    """Raise InputError where an object is not a bank."""
    if missing := [name for name in vars(GreenSource) if not name.startswith("_") and not hasattr(bank, name)]:
        raise InputError(
            f"bank is of type {type(bank).__name__}; a bank, or its path, is needed: it has no {missing[0]}"
        )


@dataclass(frozen=True, slots=True)
class GreenArray:
    """A bank held in memory.

    values, (positions, actuators, taps): Green's functions, any real number type, response unit per volt.
    position_mm, float64 (positions, 2): Grid in millimetres.
    sample_rate_hz: Rate in Hz, > 0.
    status, uint8 (positions,): Status bits; all rows valid where not given.
    actuator_mm, float64 (actuators, 2): Actuator positions in millimetres; NaN where not given.
    """

    values: NDArray[Any]
    position_mm: Float64Array
    sample_rate_hz: float
    status: NDArray[np.uint8] = field(default=None)  # type: ignore[arg-type]  # made below
    actuator_mm: Float64Array = field(default=None)  # type: ignore[arg-type]
    band_hz: tuple[float, float] | None = None
    response_unit: str = "m/s/V"

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", reals("green", self.values))
        if self.values.ndim != 3 or 0 in self.values.shape:
            raise InputError(f"green has shape {self.values.shape}; allowed is (positions, actuators, taps), none 0")
        positions, actuators, _ = self.values.shape
        object.__setattr__(self, "position_mm", _table(self.position_mm, positions, "position_mm"))
        if self.status is None:
            object.__setattr__(self, "status", np.ones(positions, np.uint8))
        status = whole_array("status", self.status)
        if status.shape != (positions,) or ((status < 0) | (status > 255)).any():
            raise InputError(f"status has shape {status.shape}; status bits of {positions} positions are needed")
        object.__setattr__(self, "status", status.astype(np.uint8))
        if self.actuator_mm is None:
            object.__setattr__(self, "actuator_mm", np.full((actuators, 2), np.nan))
        object.__setattr__(self, "actuator_mm", _table(self.actuator_mm, actuators, "actuator_mm"))
        check_fields(self)
        if self.band_hz is not None:
            low_hz, high_hz = self.band_hz
            if not 0 <= low_hz < high_hz < np.inf:
                raise InputError(f"band_hz is {self.band_hz}; two frequencies are needed, the lower one first")
            object.__setattr__(self, "band_hz", (float(low_hz), float(high_hz)))
        if not (np.isfinite(self.sample_rate_hz) and self.sample_rate_hz > 0):
            raise InputError(f"sample_rate_hz is {self.sample_rate_hz}; it must be a finite number above 0")

    @property
    def positions(self) -> int:
        return int(self.values.shape[0])

    @property
    def actuators(self) -> int:
        return int(self.values.shape[1])

    @property
    def taps(self) -> int:
        return int(self.values.shape[2])

    def green(self, position: int) -> NDArray[Any]:
        return np.asarray(self.values[bank_row(position, self.positions)])


def read_row(bank: GreenSource, position: int) -> ScaledRow:
    """Read one row as float64, scaled by a power of two.

    bank: The bank, of any real number type, byte order or layout.

    Raises InputError: the row is not real, has the wrong shape, or holds NaN or infinity.
    """
    return scale_row(fetch_row(bank, position), position)


def read_rows(bank: GreenSource, positions: Sequence[int]) -> Float32Array:
    """Read some rows as float32, each scaled by a power of two, (rows, actuators, taps). Raises as `read_row` does."""
    return np.stack([scale_row(fetch_row(bank, row), row, single=True).values for row in positions])


def fetch_row(bank: GreenSource, position: int) -> NDArray[Any]:
    """Read one row as the bank has it, (actuators, taps).

    Raises InputError: the row is not real or has the wrong shape.
    """
    raw = np.asarray(bank.green(position))
    if raw.shape != (bank.actuators, bank.taps):
        raise InputError(f"row {position} of the bank has shape {raw.shape}; expected {(bank.actuators, bank.taps)}")
    if raw.dtype.kind not in "fiu":
        raise InputError(f"row {position} of the bank is of type {raw.dtype}; allowed are real numbers")
    return raw


class RowReader:
    """Reads scaled rows of a bank for several threads; the bank itself is asked by one at a time."""

    def __init__(self, bank: GreenSource) -> None:
        self._bank = bank
        self._asking = threading.Lock()

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return self._bank.actuators

    @property
    def taps(self) -> int:
        """Taps of a Green's function."""
        return self._bank.taps

    def read(self, position: int, *, single: bool) -> ScaledRow:
        """Read one row, as float32 or as float64. Raises InputError where it cannot be used."""
        with self._asking:
            raw = fetch_row(self._bank, position)
        return scale_row(raw, position, single=single)


def usable(bank: GreenSource) -> BoolArray:
    """Which rows hold a measurement that may be used, bool (positions,)."""
    return usable_rows(np.asarray(bank.status))


def drive_unit(bank: GreenSource) -> str:
    """Unit of the drives that a bank takes: its own word, else that of its `response_unit`; volts where neither says.

    Raises InputError: the two contradict each other.
    """
    measured = getattr(bank, "measured", bank)
    return drive_of(str(getattr(measured, "response_unit", "")), getattr(measured, "drive_unit", None))


def refusal(status: int) -> str | None:
    """Why a row of this status may not be used, or None."""
    if status & Status.DISABLED:
        return "disabled"
    if status & Status.FAILED:
        return "marked as failed"
    if not status & USABLE:
        return "not measured"
    return None


def _table(values: ArrayLike, rows: int, name: str) -> Float64Array:
    table = real_array(name, values)
    if table.shape != (rows, 2):
        raise InputError(f"{name} has shape {table.shape}; expected {(rows, 2)}")
    return table
