"""What the window reads of a rig file by itself, for a picture; the commands read it whole and judge it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gui.shell.toml_files import is_virtual, tables_of
from storage.errors import InputError
from storage.text_file import read_text

Pair = tuple[float, float]

# As the configuration has them where the file says nothing.
_LENGTH_MM, _WIDTH_MM = 250.0, 150.0


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig file, seen from outside.

    Parameters
    ----------
    path : Path
        The file.
    is_virtual : bool
        Whether its instruments are in software, so that several programs can have them at once.
    length_mm, width_mm : float
        Of the surface.
    actuator_mm : list of (float, float)
        Actuators, where it lists them.
    """

    path: Path
    is_virtual: bool = True
    length_mm: float = _LENGTH_MM
    width_mm: float = _WIDTH_MM
    actuator_mm: list[Pair] = field(default_factory=list)


def read_rig_file(path: Path) -> RigFile:
    """Read what a picture needs; a value that is wrong is passed over here, for the commands tell it better.

    Raises
    ------
    InputError
        The file cannot be read, or is no TOML.
    """
    content = tables_of(path)
    surface, places = _table(content, "surface"), _table(content, "actuators").get("position_mm")
    length_mm, width_mm = _size(surface, "length_mm", _LENGTH_MM), _size(surface, "width_mm", _WIDTH_MM)
    return RigFile(
        path,
        is_virtual=is_virtual(content),
        length_mm=length_mm if length_mm >= width_mm else _LENGTH_MM,
        width_mm=width_mm if length_mm >= width_mm else _WIDTH_MM,
        actuator_mm=[pair for one in places if (pair := _pair(one)) is not None] if isinstance(places, list) else [],
    )


def line_of(path: Path, key: str) -> int:
    """The line, from 1, at which a key such as ``player.channels`` stands, or else its table; 0 where neither does."""
    table, _, name = key.rpartition(".")
    table = table or name
    try:
        lines = read_text(path).splitlines()
    except InputError:
        return 0
    inside, found = False, 0
    for number, line in enumerate(lines, start=1):
        if heading := re.match(r"\s*\[+\s*([\w.\-]+)\s*\]+", line):
            inside = heading.group(1) == table
            found = number if inside and not found else found
        elif inside and re.match(rf"\s*{re.escape(name)}\s*=", line):
            return number
    return found


def _table(content: Mapping[str, object], key: str) -> Mapping[str, object]:
    value = content.get(key)
    return value if isinstance(value, dict) else {}


def _size(table: Mapping[str, object], key: str, default: float) -> float:
    value = table.get(key, default)
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e6
    return float(value) if good and isinstance(value, int | float) else default


def _pair(value: object) -> Pair | None:
    if isinstance(value, list) and len(value) == 2 and all(isinstance(one, int | float) for one in value):
        return float(value[0]), float(value[1])
    return None
