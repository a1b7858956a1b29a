"""A bank as named arrays: for MATLAB, Octave and NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rendering.export.bank_rows import BankRows, OnProgress
from storage.errors import InputError
from storage.output_files import replacement

MOST_MAT_BYTES = 2**31 - 2**20
"""A variable of a MATLAB file of level 5 ends here."""


def write_npz(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a NumPy archive, to be read without pickle.

    Parameters
    ----------
    path : Path
        The file.
    rows : BankRows
        What to export.
    on_progress : callable, optional
        Told rows read and rows in all.
    """
    with replacement(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **_arrays(rows, on_progress))


def write_mat(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a MATLAB file of level 5, as `write_npz` has it; rows are numbered from 0 there too.

    Raises
    ------
    InputError
        The Green's functions take more than 2 GiB.
    """
    from scipy.io import savemat

    needed = 4 * len(rows.row) * rows.bank.actuators * rows.bank.taps
    if needed > MOST_MAT_BYTES:
        raise InputError(
            f"{path}: {len(rows.row)} positions take {needed / 2**30:.3g} GiB, and a variable of a MATLAB file holds 2;"
            " export some --positions at a time, or as npz"
        )
    with replacement(path) as temporary, temporary.open("wb") as file:
        savemat(file, _arrays(rows, on_progress), oned_as="column")  # type: ignore[arg-type]


def _arrays(rows: BankRows, on_progress: OnProgress | None) -> dict[str, Any]:
    bank = rows.bank
    arrays: dict[str, Any] = {
        "green": rows.green(np.float32, on_progress),
        "position": rows.row,
        "position_mm": rows.position_mm,
        "actuator_mm": bank.actuator_mm,
        "time_s": bank.time_s,
        "sample_rate_hz": np.float64(bank.sample_rate_hz),
        "band_hz": np.array([np.nan, np.nan] if bank.band_hz is None else bank.band_hz),
        "status": rows.status,
        "response_unit": bank.response_unit,
        "drive_unit": bank.drive_unit,
    }
    return arrays | {f"quality_{name}": figures[rows.row] for name, figures in bank.quality.items()}
