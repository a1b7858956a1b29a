"""Positions that the laser measures: a grid on the surface, or a file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from calibration import Float64Array
from config.outline import EDGE_TOLERANCE_MM, Outline
from storage.errors import InputError
from storage.text_file import read_text

MOST_POSITIONS = 1_000_000
"""A bound against slips of the decimal point: a million positions take years to measure."""


Lattice = Literal["square", "hexagonal"]


def surface_grid(outline: Outline, margin_mm: float, spacing_mm: float, lattice: Lattice = "square") -> Float64Array:
    """Place a grid on a surface, in serpentine order from the bottom row up.

    Columns lie at ``(i + 1/2) * spacing_mm`` and rows at ``j * spacing_mm``, i and j whole numbers, wherever
    that is inside the outline and at least the margin away from it. On a hexagonal grid rows are closer by a factor of
    ``sqrt(3) / 2``, and every other one is moved by half a spacing, so that all six neighbours of a position are
    equally far. Even rows, counted from the bottom, run to the right and odd rows to the left, so that the
    mirror moves by one spacing at a time.

    margin_mm: Distance kept from the outline in millimetres, >= 0.
    spacing_mm: Distance of neighbouring positions in millimetres, > 0.
    lattice, {"square", "hexagonal"}: Kind of grid.

    Returns float64 (positions, 2): x and y in millimetres.
    Raises InputError: no position is left inside the margin, or there would be more than `MOST_POSITIONS`.
    """
    left, bottom, right, top = outline.box_mm
    length_mm, width_mm = right - left, top - bottom
    if margin_mm >= min(length_mm, width_mm) / 2 - EDGE_TOLERANCE_MM:
        raise InputError(
            f"margin_mm = {margin_mm:g}: leaves no position on a surface of {length_mm:g} x {width_mm:g} mm; "
            f"must be below {min(length_mm, width_mm) / 2:g}"
        )
    if outline.area_mm2 / spacing_mm > MOST_POSITIONS * spacing_mm:
        raise InputError(
            f"spacing_mm = {spacing_mm:g}: gives more than {MOST_POSITIONS:,} positions; "
            f"must be at least {math.sqrt(outline.area_mm2 / MOST_POSITIONS):.2g} on this surface"
        )
    row_spacing_mm = spacing_mm * (1.0 if lattice == "square" else math.sqrt(0.75))
    column_mm = (np.arange(math.floor(left / spacing_mm), math.ceil(right / spacing_mm)) + 0.5) * spacing_mm
    row = np.arange(math.ceil((bottom + margin_mm) / row_spacing_mm - 1e-6),
                    math.floor((top - margin_mm) / row_spacing_mm + 1e-6) + 1)  # fmt: skip
    x_mm, y_mm = np.meshgrid(column_mm, row * row_spacing_mm)
    if lattice == "hexagonal":
        x_mm[row % 2 == 1] -= spacing_mm / 2
    x_mm[1::2] = x_mm[1::2, ::-1]
    position_mm = np.column_stack([x_mm.ravel(), y_mm.ravel()])
    position_mm = position_mm[outline.contains(position_mm, margin_mm)]
    if not len(position_mm):
        raise InputError(
            f"spacing_mm = {spacing_mm:g}: leaves no position inside the margin of {margin_mm:g} mm; "
            f"must be smaller on this surface of {length_mm:g} x {width_mm:g} mm"
        )
    return position_mm


def read_positions_file(path: Path, outline: Outline) -> Float64Array:
    """Read positions from a CSV file with the header ``x_mm,y_mm``, in the order of its lines.

    Blank lines and lines that start with ``#`` are passed over.

    outline: Of the surface; every position must lie on it.

    Returns float64 (positions, 2): x and y in millimetres.
    Raises InputError: the file cannot be read, or a line is not two finite numbers, lies outside the surface or repeats
    another line; the message names file and line.
    """
    rows = [
        (number, line)
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows or [cell.strip() for cell in rows[0][1].split(",")] != ["x_mm", "y_mm"]:
        number = rows[0][0] if rows else 1
        raise InputError(f"{path}: line {number}: must be the header x_mm,y_mm")
    if len(rows) == 1:
        raise InputError(f"{path}: holds no position; must have at least one line after the header")
    if len(rows) - 1 > MOST_POSITIONS:
        raise InputError(f"{path}: has {len(rows) - 1:,} positions; at most {MOST_POSITIONS:,} are allowed")
    line_of: dict[tuple[float, float], int] = {}
    for number, line in rows[1:]:
        point = _point(path, number, line)
        if point in line_of:
            raise InputError(f"{path}: line {number}: ({point[0]:g}, {point[1]:g}) mm repeats line {line_of[point]}")
        line_of[point] = number
    position_mm = np.array(list(line_of), dtype=np.float64)
    outside = np.flatnonzero(~outline.contains(position_mm))
    if len(outside):
        number = rows[1 + int(outside[0])][0]
        x_mm, y_mm = position_mm[outside[0]]
        raise InputError(f"{path}: line {number}: ({x_mm:g}, {y_mm:g}) mm lies outside the surface")
    return position_mm


def _point(path: Path, number: int, line: str) -> tuple[float, float]:
    allowed = "must be two finite numbers in mm with a comma between and a decimal point, such as -2.0,4.0"
    shown = line.strip()[:40]
    try:
        x_mm, y_mm = (float(cell) for cell in line.split(","))
    except ValueError:
        raise InputError(f"{path}: line {number}: {shown!r}: {allowed}") from None
    if not (math.isfinite(x_mm) and math.isfinite(y_mm)):
        raise InputError(f"{path}: line {number}: {shown!r}: {allowed}")
    return x_mm + 0.0, y_mm + 0.0  # + 0.0 turns -0 into 0, so that equal positions hash equally
