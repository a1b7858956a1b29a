"""Parts of a rig file that the window draws; the commands read it whole and check it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from config.messages.operate import Numbers
from config.rig import Surface
from gui.shell.toml_files import is_virtual, tables_of
from gui.surface.surface import surface_from
from storage.errors import InputError
from storage.text_file import read_text


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig file: whether its instruments are virtual, its surface, and the actuators that it lists."""

    path: Path
    is_virtual: bool = True
    surface: Surface = field(default_factory=Surface)
    actuator_mm: list[Numbers] = field(default_factory=list)


def read_rig_file(path: Path) -> RigFile:
    """Read what a picture needs; wrong values are replaced by defaults.

    Raises InputError: the file cannot be read, or is not TOML.
    """
    content = tables_of(path)
    surface, actuators = (one if isinstance(one, dict) else {} for one in map(content.get, ("surface", "actuators")))
    places = actuators.get("position_mm")
    actuator_mm = [
        (float(place[0]), float(place[1]))
        for place in (places if isinstance(places, list) else ())
        if isinstance(place, list) and len(place) == 2 and all(type(one) in (int, float) for one in place)
    ]
    return RigFile(path, is_virtual(content), surface_from(surface), actuator_mm)


def line_of(path: Path, key: str) -> int:
    """Line, from 1, of a key such as ``player.channels``, or else of its table; 0 where there is neither."""
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
