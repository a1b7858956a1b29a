"""Which rows of a bank are exported, and how they are read one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.greens.source import usable
from storage.bank.reading import Bank
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
OnProgress = Callable[[int, int], None]

MOST_BYTES = 4 * 2**30
"""What a format that takes a bank in one piece may hold in memory."""


@dataclass(frozen=True, slots=True)
class BankRows:
    """The rows of a bank that are exported.

    Parameters
    ----------
    bank : Bank
        Where they are.
    row : int64 array, shape (rows,)
        Their numbers in the bank.
    known : bool array, shape (rows,)
        Which of them hold a measurement; the others are exported as NaN.
    left_out : int
        How many rows of the bank were asked for and are not exported.
    """

    bank: Bank
    row: Int64Array
    known: NDArray[np.bool_]
    left_out: int

    @property
    def position_mm(self) -> Float64Array:
        """Their places, (rows, 2)."""
        return np.asarray(self.bank.position_mm[self.row])

    @property
    def status(self) -> NDArray[np.uint8]:
        """Their status bits, (rows,)."""
        return np.asarray(self.bank.status[self.row])

    def each(self, on_progress: OnProgress | None = None) -> Iterator[tuple[int, NDArray[Any]]]:
        """Give the number and the Green's functions (actuators, taps) of each row; NaN where it is not known."""
        nothing = np.full((self.bank.actuators, self.bank.taps), np.nan, np.float32)
        for place, (row, known) in enumerate(zip(self.row.tolist(), self.known.tolist(), strict=True)):
            yield row, self.bank.green(row) if known else nothing
            if on_progress is not None:
                on_progress(place + 1, len(self.row))

    def green(self, dtype: type[np.floating[Any]], on_progress: OnProgress | None = None) -> NDArray[Any]:
        """Give all Green's functions at once, (rows, actuators, taps).

        Raises
        ------
        InputError
            They would take more than 4 GiB.
        """
        shape = (len(self.row), self.bank.actuators, self.bank.taps)
        needed = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if needed > MOST_BYTES:
            raise InputError(
                f"{self.bank.path}: {shape[0]} positions take {needed / 2**30:.3g} GiB at once in this format, and"
                f" {MOST_BYTES / 2**30:.3g} GiB are allowed; export some --positions at a time, or as wav"
            )
        green = np.empty(shape, dtype)
        for place, (_, values) in enumerate(self.each(on_progress)):
            green[place] = values
        return green


def choose_rows(bank: Bank, positions: Sequence[int] | None, *, missing_as_nan: bool) -> BankRows:
    """Settle which rows are exported.

    Parameters
    ----------
    bank : Bank
        The bank.
    positions : sequence of int, optional
        Rows asked for; by default all.
    missing_as_nan : bool
        Whether rows that are not measured, failed or disabled are exported as NaN, or left out.

    Raises
    ------
    InputError
        No row is left.
    """
    wanted = np.arange(bank.positions) if positions is None else np.asarray(positions, dtype=np.int64)
    known = usable(bank)[wanted]
    if not known.any():
        raise InputError(f"{bank.path}: none of these positions holds a measurement; there is nothing to export")
    if missing_as_nan:
        return BankRows(bank, wanted.astype(np.int64), known, 0)
    kept = wanted[known].astype(np.int64)
    return BankRows(bank, kept, np.ones(len(kept), bool), int(np.count_nonzero(~known)))
