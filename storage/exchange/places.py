"""Positions of a bank as a table in CSV: places, status and quality, without Green's functions."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavefocus.storage.exchange.bank_rows import BankRows, OnProgress
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.point_status import status_words


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a table with a line per position; figures per actuator are their medians, empty where unknown."""
    write_whole(path, table(rows))
    if on_progress is not None:
        on_progress(len(rows.row), len(rows.row))


def table(rows: BankRows, name: str = "", column: Sequence[object] = ()) -> str:
    """The table as text; a first column may be added under a name, such as each position's file."""
    columns: dict[str, Sequence[object]] = {name: column} if name else {}
    columns |= {
        "index": rows.row.tolist(),
        "x_mm": rows.position_mm[:, 0].tolist(),
        "y_mm": rows.position_mm[:, 1].tolist(),
        "status": [status_words(one) for one in rows.status.tolist()],
    }
    for figure, values in rows.bank.quality.items():
        columns[figure] = [_median(one) for one in np.atleast_2d(values[rows.row].T).T]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _median(figures: np.ndarray) -> str:
    known = figures[np.isfinite(figures)]
    return f"{np.median(known):.6g}" if known.size else ""
