"""A bank as a MATLAB file of level 5, with the arrays of `storage.exchange.npz`."""

from __future__ import annotations

from pathlib import Path

from storage.errors import InputError
from storage.exchange.bank_rows import BankRows, OnProgress
from storage.exchange.npz import named_arrays
from storage.output_files import replacement

MOST_BYTES = 2**31 - 2**20
"""Largest variable of the format."""


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write the file; raises InputError where the Green's functions take more than 2 GiB."""
    from scipy.io import savemat

    needed = 4 * len(rows.row) * rows.bank.actuators * rows.bank.taps
    if needed > MOST_BYTES:
        raise InputError(
            f"{path}: {len(rows.row)} positions take {needed / 2**30:.3g} GiB, and a variable of a MATLAB file holds 2;"
            " export some --positions at a time, or as npz"
        )
    with replacement(path) as temporary, temporary.open("wb") as file:
        savemat(file, named_arrays(rows, on_progress), oned_as="column")  # type: ignore[arg-type]
