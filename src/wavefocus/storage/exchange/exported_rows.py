"""Rows of a bank that are exported, read one after the other."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.argument_types import Positions, bank_rows
from wavefocus.storage.bank.ledger import usable
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import green_unit, response_unit

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
OnProgress = Callable[[int, int], None]

MAX_BYTES = 4 * 2**30
"""Largest array that a format which takes a bank in one piece may hold in memory."""


@dataclass(frozen=True, slots=True)
class ExportedRows:
    """The rows of a bank that are exported.

    row, int64 (rows,): Their numbers in the bank.
    known, bool (rows,): Rows that hold a measurement; the others are exported as NaN.
    left_out: Number of rows that were asked for and are not exported.
    publication: Texts by the keys of ``[publication]`` in the run file: ``title``, ``licence``, ``people``, ...; those
        that are given.
    binary: Whether universal files hold their functions in binary.
    """

    bank: Bank
    row: Int64Array
    known: NDArray[np.bool_]
    left_out: int
    publication: Mapping[str, str] = field(default_factory=dict)
    binary: bool = False

    @property
    def title(self) -> str:
        """Title of the publication, or one from the bank's name."""
        return self.publication.get("title", f"Green's functions of {self.bank_name}")

    @property
    def bank_name(self) -> str:
        """Name of the bank's file, as a text that every format holds."""
        return printable(self.bank.path.name)

    @property
    def units(self) -> tuple[str, str, str]:
        """Unit of the Green's functions as response over drive, ``"m/s/N"``; that of the response, and of the drive."""
        unit = green_unit(self.bank.response_unit, self.bank.drive_unit)
        return unit, response_unit(unit, self.bank.drive_unit), self.bank.drive_unit

    @property
    def position_mm(self) -> Float64Array:
        """Their positions, (rows, 2)."""
        return np.asarray(self.bank.position_mm[self.row])

    @property
    def status(self) -> NDArray[np.uint8]:
        """Their status bits, (rows,)."""
        return np.asarray(self.bank.status[self.row])

    def each(self, on_progress: OnProgress | None = None) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yield the number and the Green's functions (actuators, taps) of each row; NaN where unknown."""
        nothing = np.full((self.bank.actuators, self.bank.taps), np.nan, np.float32)
        for index, (row, known) in enumerate(zip(self.row.tolist(), self.known.tolist(), strict=True)):
            yield row, self.bank.green(row) if known else nothing
            if on_progress is not None:
                on_progress(index + 1, len(self.row))

    def green(self, on_progress: OnProgress | None) -> NDArray[np.float32]:
        """All Green's functions at once, (rows, actuators, taps); raises InputError beyond 4 GiB."""
        shape = (len(self.row), self.bank.actuators, self.bank.taps)
        needed = 4 * int(np.prod(shape, dtype=np.int64))
        if needed > MAX_BYTES:
            raise InputError(
                f"{self.bank.path}: {shape[0]} positions take {needed / 2**30:.3g} GiB at once in this format, and"
                f" {MAX_BYTES / 2**30:.3g} GiB are allowed; export some --positions at a time, or as wav"
            )
        green = np.empty(shape, np.float32)
        for index, (_, values) in enumerate(self.each(on_progress)):
            green[index] = values
        return green


def printable(text: str) -> str:
    """A text in one line of characters that every format holds; others become question marks."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def choose_rows(bank: Bank, positions: Positions | None, *, missing_as_nan: bool, **options: Any) -> ExportedRows:
    """Choose the rows of an export: those asked for, by default all.

    Rows that are not measured, failed or disabled are exported as NaN or left out. `options` are fields of
    `ExportedRows`. Raises InputError where no measured row is left.
    """
    wanted = np.arange(bank.positions) if positions is None else bank_rows(positions, bank.positions)
    known = usable(np.asarray(bank.status))[wanted]
    if not known.any():
        raise InputError(f"{bank.path}: none of these positions holds a measurement; there is nothing to export")
    kept = np.ones(len(wanted), bool) if missing_as_nan else known
    left_out = int(np.count_nonzero(~kept))
    return ExportedRows(bank, wanted[kept].astype(np.int64), known[kept], left_out, **options)
