"""Positions that the laser measures: a grid on the surface, or a file."""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from wavefocus.calibration import Float64Array
from wavefocus.config.outline import EDGE_TOLERANCE_MM, Outline
from wavefocus.storage.errors import InputError
from wavefocus.storage.text_file import read_text

MAX_POSITIONS = 1_000_000
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
    Raises InputError: no position is left inside the margin, or there would be more than `MAX_POSITIONS`.
    """
    left, bottom, right, top = outline.box_mm
    length_mm, width_mm = right - left, top - bottom
    if margin_mm >= min(length_mm, width_mm) / 2 - EDGE_TOLERANCE_MM:
        raise InputError(
            f"margin_mm = {margin_mm:g}: leaves no position on a surface of {length_mm:g} x {width_mm:g} mm; "
            f"must be below {min(length_mm, width_mm) / 2:g}"
        )
    if outline.area_mm2 / spacing_mm > MAX_POSITIONS * spacing_mm:
        raise InputError(
            f"spacing_mm = {spacing_mm:g}: gives more than {MAX_POSITIONS:,} positions; "
            f"must be at least {math.sqrt(outline.area_mm2 / MAX_POSITIONS):.2g} on this surface"
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


CHECK_SEED = 31
CHECK_TRIES = 20_000
CHECKS_APART = 0.5
"""Least distance of two check positions at first, over that of as many on a square grid."""
CHECK_STEP_MM = 1e-3
"""Check positions lie on multiples of this, so that they are equal in every file."""
MIN_CHECK_SHARE = 0.1
"""Least distance of a check position from the grid, in spacings; it judges what lies between."""


def check_grid(
    outline: Outline, margin_mm: float, spacing_mm: float, position_mm: Float64Array, count: int
) -> Float64Array:
    """Place positions off a grid, which are measured to judge what is interpolated between its positions.

    They are the same for the same surface and grid, and random, so that they stand for all places; those that crowd are
    passed over while there is room elsewhere.

    margin_mm: Distance kept from the outline in millimetres, >= 0.
    spacing_mm: Distance of neighbouring positions in millimetres, > 0.
    position_mm, float64 (positions, 2): The grid.
    count: How many, >= 0.

    Returns float64 (count, 2): x and y in millimetres. Raises InputError: the surface has no room for them.
    """
    rng = np.random.default_rng(CHECK_SEED)
    low_mm, high_mm = position_mm.min(axis=0) - spacing_mm / 2, position_mm.max(axis=0) + spacing_mm / 2
    apart_mm = CHECKS_APART * math.sqrt(len(position_mm) / max(count, 1)) * spacing_mm
    found = np.zeros((0, 2))
    for tried in range(CHECK_TRIES):
        if len(found) == count:
            break
        place_mm = np.round(rng.uniform(low_mm, high_mm, (1, 2)) / CHECK_STEP_MM) * CHECK_STEP_MM
        away_mm = float(_nearest_mm(place_mm, position_mm)[0])
        crowded = len(found) and _nearest_mm(place_mm, found)[0] < apart_mm * (1.0 - tried / CHECK_TRIES)
        between = MIN_CHECK_SHARE * spacing_mm <= away_mm <= spacing_mm
        if between and not crowded and outline.contains(place_mm, margin_mm)[0]:
            found = np.concatenate([found, place_mm])
    if len(found) < count:
        raise InputError(f"check_positions = {count}: only {len(found)} places between the grid's positions were found")
    return found


def _nearest_mm(places_mm: Float64Array, others_mm: Float64Array) -> Float64Array:
    gap_mm = places_mm[:, None] - others_mm[None]
    return np.asarray(np.hypot(gap_mm[..., 0], gap_mm[..., 1]).min(axis=1))


def read_positions_file(path: Path, outline: Outline) -> Float64Array:
    """Read positions from a CSV file with the header ``x_mm,y_mm``, in the order of its lines.

    outline: Of the surface; every position must lie on it.

    Returns float64 (positions, 2): x and y in millimetres.
    Raises InputError: the file cannot be read, or a line is not two finite numbers, lies outside the surface or repeats
    another line; the message names file and line.
    """
    _, rows = read_rows(path, ["x_mm", "y_mm"])
    if not rows:
        raise InputError(f"{path}: holds no position; must have at least one line after the header")
    if len(rows) > MAX_POSITIONS:
        raise InputError(f"{path}: has {len(rows):,} positions; at most {MAX_POSITIONS:,} are allowed")
    line_of: dict[tuple[float, ...], int] = {}
    for number, point in rows:
        if point in line_of:
            raise InputError(f"{path}: line {number}: ({point[0]:g}, {point[1]:g}) mm repeats line {line_of[point]}")
        line_of[point] = number
    position_mm = np.array(list(line_of), dtype=np.float64)
    outside = np.flatnonzero(~outline.contains(position_mm))
    if len(outside):
        number, (x_mm, y_mm) = rows[int(outside[0])]
        raise InputError(f"{path}: line {number}: ({x_mm:g}, {y_mm:g}) mm lies outside the surface")
    return position_mm


def read_rows(path: Path, *headers: list[str]) -> tuple[list[str], list[tuple[int, tuple[float, ...]]]]:
    """Read a CSV file of numbers; blank lines and lines that start with ``#`` are passed over.

    headers: Names of the columns that the file may have.

    Returns the names that it has, and line number and numbers of each row.
    Raises InputError: the file cannot be read, has none of these headers, or a line is not as many finite numbers; the
    message names file and line.
    """
    lines = [
        (number, line.strip())
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    names = [cell.strip() for cell in lines[0][1].split(",")] if lines else []
    if names not in headers:
        wanted = " or ".join(",".join(header) for header in headers)
        raise InputError(f"{path}: line {lines[0][0] if lines else 1}: must be the header {wanted}")
    rows: list[tuple[int, tuple[float, ...]]] = []
    for number, line in lines[1:]:
        try:
            # + 0.0 turns -0 into 0, so that equal positions hash equally.
            values = tuple(float(cell) + 0.0 for cell in line.split(","))
        except ValueError:
            values = ()
        if len(values) != len(names) or not all(map(math.isfinite, values)):
            allowed = f"must be {len(names)} finite numbers with commas between and decimal points, such as -2.0,4.0"
            raise InputError(f"{path}: line {number}: {line[:40]!r}: {allowed}")
        rows.append((number, values))
    return names, rows
