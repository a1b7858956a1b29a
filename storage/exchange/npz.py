"""A bank as a NumPy archive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.storage.exchange.bank_rows import BankRows, OnProgress
from wavefocus.storage.output_files import replacement


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write an archive that is read without pickle."""
    with replacement(path) as temporary, temporary.open("wb") as file:
        texts = {f"publication_{key}": text for key, text in rows.publication.items()}
        np.savez(file, **(named_arrays(rows, on_progress) | texts))


def named_arrays(rows: BankRows, on_progress: OnProgress | None) -> dict[str, Any]:
    """Rows with all that describes them; their numbers in the bank begin at 0."""
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
        "response_unit": rows.units[0],
        "drive_unit": bank.drive_unit,
    }
    return arrays | {f"quality_{name}": figures[rows.row] for name, figures in bank.quality.items()}
