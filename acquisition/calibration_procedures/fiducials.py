"""A file of marks on the surface, with or without the angles at which the beam meets them."""

from __future__ import annotations

import math
from pathlib import Path

from storage.errors import InputError
from storage.text_file import read_text

PLACES = ["x_mm", "y_mm"]
PLACES_AND_ANGLES = [*PLACES, "x_mrad", "y_mrad"]
MOST_MARKS = 1000

Pair = tuple[float, float]


def read_fiducials(path: Path) -> tuple[tuple[Pair, ...], tuple[Pair, ...] | None]:
    """Read marks from a CSV file with the header ``x_mm,y_mm`` or ``x_mm,y_mm,x_mrad,y_mrad``.

    Blank lines and lines that start with ``#`` are passed over.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    tuple
        Places in millimetres, and angles in milliradians or None where the file has none.

    Raises
    ------
    InputError
        The file cannot be read, or a line is not as many finite numbers as the header; the message names the line.
    """
    rows = [
        (number, line.strip())
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    header = [cell.strip() for cell in rows[0][1].split(",")] if rows else []
    if header not in (PLACES, PLACES_AND_ANGLES):
        number = rows[0][0] if rows else 1
        raise InputError(f"{path}: line {number}: must be the header x_mm,y_mm or x_mm,y_mm,x_mrad,y_mrad")
    if not 4 <= len(rows) - 1 <= MOST_MARKS:
        raise InputError(f"{path}: has {len(rows) - 1} marks; a mirror map needs at least 4, and at most {MOST_MARKS}")
    marks = [_numbers(path, number, line, len(header)) for number, line in rows[1:]]
    places = tuple((mark[0], mark[1]) for mark in marks)
    return places, tuple((mark[2], mark[3]) for mark in marks) if len(header) == len(PLACES_AND_ANGLES) else None


def _numbers(path: Path, number: int, line: str, count: int) -> list[float]:
    try:
        values = [float(cell) for cell in line.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        allowed = f"must be {count} finite numbers with commas between and decimal points"
        raise InputError(f"{path}: line {number}: {line[:40]!r}: {allowed}")
    return values
