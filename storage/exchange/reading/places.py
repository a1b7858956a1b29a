"""CSV tables of places: coordinates with their units, and which files, channels and nodes were measured there."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.reading.measured import (
    METRES,
    Float64Array,
    ImportOptions,
    from_spherical,
    length_unit,
    require_plain,
)
from wavefocus.storage.text_file import read_text

_SPHERICAL = ("azimuth_deg", "elevation_deg")
WANTED = "x_mm,y_mm[,z_mm] (or _m, _um, _in), or azimuth_deg,elevation_deg,radius_m"


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

    Coordinates are columns named `WANTED`; ``x``, ``y``, ``z`` are in --length-unit. Column ``role`` is ``position``
    (or empty) or ``actuator``.

    Raises InputError: no such columns, a coordinate that is no number, a role that is neither.
    """
    content = read_text(path).splitlines()
    first = content[0] if content else ""
    lines = csv.reader(content, delimiter=max(",;\t", key=first.count))  # as spreadsheets of several countries write it
    try:
        header = [name.strip().lower() for name in next(lines, [])]
        axes, metres = _columns(header, path, options)
        places = []
        for number, cells in enumerate(lines, start=2):
            if not any(cell.strip() for cell in cells):
                continue
            words = {name: cell.strip() for name, cell in zip(header, cells, strict=False)}
            found = np.array([_number(words.get(name, ""), path, number, name) if name else 0.0 for name in axes])
            found = from_spherical((found * [1, 1, metres])[None])[0] if axes[0] in _SPHERICAL else found * metres
            if words.get("role", "") not in ("", "position", "actuator"):
                raise InputError(f"{path}: line {number}: role is {words['role']!r}; position or actuator is needed")
            for name, word in words.items():
                require_plain(word, path, f"line {number}: {name}")
            places.append(Place(found, words, number))
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV table ({error})") from None
    if not any(not place.is_actuator for place in places):
        raise InputError(f"{path}: holds no position; one line each is needed, with the columns {WANTED}")
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
        raise InputError(f"{path} holds no places; name a CSV table with --places, with the columns {WANTED}")
    places = read_places(options.places, options)
    position_m = coordinates([one for one in places if not one.is_actuator])
    actuator_m = coordinates([one for one in places if one.is_actuator])
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


def _columns(header: list[str], path: Path, options: ImportOptions) -> tuple[tuple[str, ...], float]:
    """Names of the three columns of coordinates, empty for one that is 0, and metres of a unit of length."""
    if len(set(header)) < len(header):
        raise InputError(f"{path}: its header names a column twice; each may be there once")
    for unit, metres in METRES.items():
        if f"x_{unit}" in header and f"y_{unit}" in header:
            return (f"x_{unit}", f"y_{unit}", f"z_{unit}" if f"z_{unit}" in header else ""), metres
        if {*_SPHERICAL, f"radius_{unit}"} <= set(header):
            return (*_SPHERICAL, f"radius_{unit}"), metres
    if {"x", "y"} <= set(header):
        return ("x", "y", "z" if "z" in header else ""), length_unit(options, path)
    raise InputError(f"{path}: its header is {','.join(header)[:200]!r}; columns {WANTED} are needed")


def _number(text: str, path: Path, line: int, name: str) -> float:
    try:
        value = float(text) if text else np.nan
    except ValueError:
        value = np.inf
    if np.isinf(value):
        raise InputError(f"{path}: line {line}: {name} is {text[:40]!r}; a number is needed")
    return value
