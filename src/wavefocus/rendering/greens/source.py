"""The read interface of a bank, and a reader of its rows."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavefocus.rendering.arrays import BoolArray, Float32Array, Float64Array
from wavefocus.storage.argument_types import bank_row, check_fields, real_array, reals, truths, whole_array
from wavefocus.storage.bank.ledger import DOUBTFUL, USABLE, Status
from wavefocus.storage.bank.ledger import usable as usable_rows
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import drive_of

RealArray = Float32Array | Float64Array

LARGEST = 1e100
"""Squares of larger values, and of those below its reciprocal, and their sums are beyond the range of numbers."""

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
    check, bool (positions,): Positions off the grid that only judge what is interpolated; none where not given.
    """

    values: NDArray[Any]
    position_mm: Float64Array
    sample_rate_hz: float
    status: NDArray[np.uint8] = field(default=None)  # type: ignore[arg-type]  # made below
    actuator_mm: Float64Array = field(default=None)  # type: ignore[arg-type]
    band_hz: tuple[float, float] | None = None
    response_unit: str = "m/s/V"
    check: BoolArray | None = None

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
        if self.check is not None:
            object.__setattr__(self, "check", truths("check", self.check))
            if self.check.shape != (positions,):
                raise InputError(
                    f"check has shape {self.check.shape}; one value for each of {positions} positions is needed"
                )
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
        if self.band_hz is not None and self.band_hz[1] > 0.5 * self.sample_rate_hz * (1 + 1e-9):
            raise InputError(
                f"band_hz ends at {self.band_hz[1]:g} Hz; half the rate is {0.5 * self.sample_rate_hz:g} Hz"
            )

    def __repr__(self) -> str:
        size = f"{self.positions} positions, {self.actuators} actuators, {self.taps} taps"
        return f"GreenArray({size} at {self.sample_rate_hz:g} Hz, {self.response_unit})"

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


class RowReader:
    """Reads rows of a bank; several threads may read, the bank itself is asked by one at a time.

    bank: The bank, of any real number type, byte order or layout.
    """

    def __init__(self, bank: GreenSource) -> None:
        self.bank = bank
        self._asking = threading.Lock()

    def read(self, position: int) -> Float64Array:
        """Read one row, (actuators, taps).

        Raises InputError: the row is not real, has the wrong shape, or holds NaN or infinity.
        """
        with self._asking:
            raw = np.asarray(self.bank.green(position))
        expected = (self.bank.actuators, self.bank.taps)
        if raw.shape != expected:
            raise InputError(f"row {position} of the bank has shape {raw.shape}; expected {expected}")
        if raw.dtype.kind not in "fiu":
            raise InputError(f"row {position} of the bank is of type {raw.dtype}; allowed are real numbers")
        values = np.array(raw, dtype=np.float64, order="C")
        # Without an array of magnitudes: NaN goes through largest and least alike.
        largest = max(float(values.max()), -float(values.min()))
        if not np.isfinite(largest):
            actuator = int(np.argmin(np.isfinite(values).all(axis=1)))
            raise InputError(
                f"position {position}, actuator {actuator} of the bank holds NaN or infinity; remeasure or disable"
                " the position"
            )
        if largest and not 1.0 / LARGEST <= largest <= LARGEST:
            raise InputError(
                f"position {position} of the bank holds values of up to {largest:.3g}, beyond {1.0 / LARGEST:g} to"
                f" {LARGEST:g}; give the bank a unit in which its values are nearer to 1"
            )
        return values


def usable(bank: GreenSource) -> BoolArray:
    """Which rows hold a measurement that may be used, bool (positions,)."""
    return usable_rows(np.asarray(bank.status))


def is_check(bank: GreenSource) -> BoolArray:
    """Which positions lie off the grid and only judge what is interpolated between it, bool (positions,)."""
    check = getattr(bank, "check", None)
    return np.zeros(bank.positions, dtype=bool) if check is None else np.asarray(check, dtype=bool)


def well_measured(bank: GreenSource) -> BoolArray:
    """Which rows an interpolation may be made of, bool (positions,): usable, not doubtful, and no check positions."""
    doubtful = (np.asarray(bank.status) & DOUBTFUL_BITS) != 0
    return np.asarray(usable(bank) & ~doubtful & ~is_check(bank))


def usable_checks(bank: GreenSource) -> BoolArray:
    """Which rows judge an interpolation, bool (positions,): usable check positions."""
    return np.asarray(is_check(bank) & usable(bank))


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
