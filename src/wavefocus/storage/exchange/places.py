"""CSV tables of places: the positions of a bank with status and quality, and the places of measured files."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.options import ImportOptions
from wavefocus.storage.bank.ledger import status_words
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import Float64Array, from_spherical, length_unit, require_plain
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.text_file import read_text
from wavefocus.storage.units import METRES


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write a table with a line per position; figures per actuator are their medians, empty where unknown."""
    write_whole(path, table(rows))
    if on_progress is not None:
        on_progress(len(rows.row), len(rows.row))


def table(rows: ExportedRows, name: str = "", column: Sequence[object] = ()) -> str:
    """The table as text; a first column may be added under a name, such as each position's file."""
    columns: dict[str, Sequence[object]] = {name: column} if name else {}
    columns |= {
        "index": rows.row.tolist(),
        "x_mm": rows.position_mm[:, 0].tolist(),
        "y_mm": rows.position_mm[:, 1].tolist(),
        "status": [status_words(status) for status in rows.status.tolist()],
    }
    for figure, values in rows.bank.quality.items():
        columns[figure] = [_median(figures) for figures in np.atleast_2d(values[rows.row].T).T]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def _median(figures: np.ndarray) -> str:
    known = figures[np.isfinite(figures)]
    return f"{np.median(known):.6g}" if known.size else ""


_SPHERICAL = ("azimuth_deg", "elevation_deg")
_SEPARATOR = re.compile(r"\ufeff?sep=([,;\t])\s*")
_WANTED = "x_mm,y_mm[,z_mm] (or _m, _um, _in), or azimuth_deg,elevation_deg,radius_m"


@dataclass(frozen=True, slots=True)
class Place:
    """A line of the table.

    m, float64 (3,): Coordinates in metres; NaN where the line leaves them empty.
    words: Its other columns by name; empty where a line has none.
    line: Its number in the file.
    """

    m: Float64Array
    words: dict[str, str]
    line: int

    @property
    def is_actuator(self) -> bool:
        """Whether it is the place of an actuator."""
        return self.words.get("role") == "actuator"


def read_places(path: Path, options: ImportOptions) -> list[Place]:
    """Read a table with a header line, its columns apart by commas, semicolons or tabs.

    Coordinates are columns named `_WANTED`; ``x``, ``y``, ``z`` are in --length-unit. Column ``role`` is ``position``
    (or empty) or ``actuator``. Where semicolons or tabs are between the columns, numbers may have decimal commas, and
    the first line may name the separator (``sep=;``), as spreadsheets write it.

    Raises InputError: no such columns, or several that contradict each other, a line with more cells than the header,
    a coordinate that is not a number, a role that is neither.
    """
    content = read_text(path).splitlines()
    skipped = 0
    if content and (named := _SEPARATOR.fullmatch(content[0])):
        skipped, delimiter = 1, named[1]
    else:
        first = content[0] if content else ""
        delimiter = max(",;\t", key=first.count)  # as spreadsheets of several countries write it
    lines = csv.reader(content[skipped:], delimiter=delimiter)
    try:
        header = [re.sub("[µμ]", "u", name.strip().lower()) for name in next(lines, [])]
        number_of = _Numbers(path, has_decimal_commas=delimiter != ",")
        columns, is_spherical = _columns(header, path, options)
        places = []
        for number, cells in enumerate(lines, start=2 + skipped):
            if not any(cell.strip() for cell in cells):
                continue
            if any(cell.strip() for cell in cells[len(header) :]):
                raise InputError(
                    f"{path}: line {number}: has {len(cells)} cells and the header {len(header)}; decimal commas need"
                    " semicolons between the cells"
                )
            words = {name: cell.strip() for name, cell in zip(header, cells, strict=False)}
            found = _place(columns, words, number_of, number)
            found = from_spherical(found[None])[0] if is_spherical else found
            if words.get("role", "") not in ("", "position", "actuator"):
                raise InputError(f"{path}: line {number}: role is {words['role']!r}; position or actuator is needed")
            for name, word in words.items():
                require_plain(word, path, f"line {number}: {name}")
            places.append(Place(found, words, number))
    except csv.Error as error:
        raise InputError(f"{path}: is not a CSV table ({error})") from None
    if not any(not place.is_actuator for place in places):
        raise InputError(f"{path}: holds no position; one line each is needed, with the columns {_WANTED}")
    for place in places:
        if not place.is_actuator and not np.isfinite(place.m).all():
            raise InputError(f"{path}: line {place.line}: a position needs all its coordinates")
    return places


def coordinates(places: list[Place]) -> Float64Array:
    """Places in metres, float64 (n, 3)."""
    return np.array([place.m for place in places]).reshape(-1, 3)


def table_of(options: ImportOptions, path: Path, count: int, actuators: int) -> tuple[Float64Array, Float64Array]:
    """Places of the positions and actuators of an array that holds none itself, in metres.

    Raises InputError: no table is named, or it has other numbers of positions or actuators.
    """
    if options.places is None:
        raise InputError(f"{path} holds no places; name a CSV table with --places, with the columns {_WANTED}")
    places = read_places(options.places, options)
    position_m = coordinates([place for place in places if not place.is_actuator])
    actuator_m = coordinates([place for place in places if place.is_actuator])
    if len(position_m) != count:
        raise InputError(
            f"{options.places}: has {len(position_m)} positions, and {path} responses at {count}; one line each is"
            " needed, or another order of the axes with --axes"
        )
    if len(actuator_m) not in (0, actuators):
        raise InputError(
            f"{options.places}: has {len(actuator_m)} actuators, and {path} has {actuators}; all or none are needed"
        )
    return position_m, actuator_m if len(actuator_m) else np.full((actuators, 3), np.nan)


_Columns = tuple[list[tuple[str, float]], ...]
"""Of each coordinate, its columns and the size of their units: in metres, or 1 for angles in degrees.

Of several columns all must agree. None: the coordinate is 0.
"""


def _columns(header: list[str], path: Path, options: ImportOptions) -> tuple[_Columns, bool]:
    """Columns of coordinates, and whether they are spherical."""
    twice = [name for name in header if header.count(name) > 1 and any(map(str.isalpha, name))]
    if twice:
        raise InputError(f"{path}: its header names the column {twice[0]!r} twice; each may be there once")
    named = {
        axis: [(f"{axis}_{unit}", metres) for unit, metres in METRES.items() if f"{axis}_{unit}" in header]
        for axis in ("x", "y", "z", "radius")
    }
    if named["x"] and named["y"]:
        return (named["x"], named["y"], named["z"]), False
    if {*_SPHERICAL} <= set(header) and named["radius"]:
        return (*([(name, 1.0)] for name in _SPHERICAL), named["radius"]), True
    if {"x", "y"} <= set(header):
        metres = length_unit(options, path)
        third = named["z"] or ([("z", metres)] if "z" in header else [])
        return ([("x", metres)], [("y", metres)], third), False
    raise InputError(f"{path}: its header is {','.join(header)[:200]!r}; columns {_WANTED} are needed")


def _place(columns: _Columns, words: dict[str, str], number_of: _Numbers, line: int) -> Float64Array:
    """Coordinates of a line in the units of its columns' sizes, (3,)."""
    found = np.zeros(3)
    for axis, named in enumerate(columns):
        values = [number_of(words.get(name, ""), line, name) * size for name, size in named]
        known = [value for value in values if not np.isnan(value)]
        if known and max(known) - min(known) > 1e-6 * max(map(abs, known)) + 1e-9:
            raise InputError(
                f"{number_of.path}: line {line}: {' and '.join(name for name, _ in named)} are different places; leave"
                " one of the columns out"
            )
        found[axis] = known[0] if known else np.nan if named else 0.0
    return found


class _Numbers:
    """Reads numbers of a table: with a decimal point, or a decimal comma where that is not between the cells."""

    def __init__(self, path: Path, *, has_decimal_commas: bool) -> None:
        self.path, self._may_have_commas = path, has_decimal_commas
        self._marks = dict[str, int]()

    def __call__(self, text: str, line: int, name: str) -> float:
        """The number of a cell, NaN of an empty one."""
        written = text
        if mark := next((mark for mark in ",." if mark in text), ""):
            if mark == "," and self._may_have_commas and text.count(",") == 1 and "." not in text:
                written = text.replace(",", ".")
            self._marks.setdefault(mark, line)
        try:
            value = float(written) if written else np.nan
        except ValueError:
            value = np.inf
        if np.isinf(value) or "_" in text:
            raise InputError(f"{self.path}: line {line}: {name} is {text[:40]!r}; a number is needed")
        if len(self._marks) > 1:
            raise InputError(
                f"{self.path}: has decimal points (line {self._marks['.']}) and decimal commas (line"
                f" {self._marks[',']}); write all numbers in one way"
            )
        return value
