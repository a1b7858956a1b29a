"""Names a calibration file in a rig file, and leaves every other line of it as a person wrote it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from storage.errors import InputError
from storage.output_files import write_whole
from storage.text_file import read_text

_TABLE = re.compile(r"^\s*\[\s*calibration\s*\]\s*(#.*)?$")
_ANY_TABLE = re.compile(r"^\s*\[")
_KEY = re.compile(r"^\s*file\s*=")


def name_calibration(rig_file: Path, name: str) -> None:
    """Write ``file = "NAME"`` into the ``[calibration]`` table of a rig file; the table is made where there is none.

    Parameters
    ----------
    rig_file : Path
        The rig file; its mode and every other line stay.
    name : str
        The calibration file, relative to the rig file's folder.

    Raises
    ------
    InputError
        The table is written in a way that only a person can change, or the file cannot be written.
    """
    text = read_text(rig_file)
    before = tomllib.loads(text)
    new = _named(text, name)
    wanted = {**before, "calibration": {**before.get("calibration", {}), "file": name}}
    try:
        right = tomllib.loads(new) == wanted
    except ValueError:
        right = False
    if not right:
        raise InputError(
            f'{rig_file}: the table calibration is written in a way of its own; write file = "{name}" into it by hand'
        )
    write_whole(rig_file.resolve(), new)


def _named(text: str, name: str) -> str:
    line = f'file = "{name}"'
    lines = text.splitlines()
    start = next((number for number, one in enumerate(lines) if _TABLE.match(one)), None)
    if start is None:
        return "\n".join([*lines, "", "[calibration]", line, ""])
    end = next((number for number in range(start + 1, len(lines)) if _ANY_TABLE.match(lines[number])), len(lines))
    old = next((number for number in range(start + 1, end) if _KEY.match(lines[number])), None)
    if old is None:
        lines.insert(start + 1, line)
    else:
        lines[old] = line
    return "\n".join([*lines, ""])
