"""Kind of a TOML file, and the rig that it names."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from enum import Enum, auto
from pathlib import Path
from typing import Any

from storage.errors import InputError
from storage.text_file import read_text


class TomlKind(Enum):
    """What a TOML file is for."""

    SCENE = auto()
    RIG = auto()
    RUN = auto()
    OTHER = auto()
    UNREADABLE = auto()


def tables_of(path: Path) -> dict[str, Any]:
    """Read a TOML file as the commands do.

    Raises
    ------
    InputError
        It cannot be read, or is no TOML.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (RecursionError, ValueError) as wrong:
        raise InputError(f"{path}: is no TOML file: {wrong}") from None


def toml_kind(path: Path) -> TomlKind:
    """What a TOML file is for, by its tables."""
    try:
        tables = tables_of(path)
    except InputError:
        return TomlKind.UNREADABLE
    if "source" in tables or "scene" in tables:
        return TomlKind.SCENE
    if isinstance(tables.get("rig"), dict) or ("mirror" in tables and "player" in tables):
        return TomlKind.RIG
    # What a calibration measured has tables of instruments, too.
    return TomlKind.OTHER if {"mirror", "player"} & tables.keys() else TomlKind.RUN


VIRTUAL = "virtual"


def is_virtual(rig: Mapping[str, object]) -> bool:
    """Whether a rig's tables name virtual instruments; either all of a rig are, or none."""
    mirror = rig.get("mirror")
    return not isinstance(mirror, Mapping) or mirror.get("driver", VIRTUAL) == VIRTUAL


def names_virtual_rig(rig: str | Path) -> bool:
    """Whether ``virtual``, or a rig file, is a virtual rig; a file that nobody can read opens no instruments either."""
    if str(rig) == VIRTUAL:
        return True
    try:
        return is_virtual(tables_of(Path(rig)))
    except InputError:
        return True


def rig_of_run(run: Path) -> Path | None:
    """The rig file that a run file names, None where it names none.

    Raises
    ------
    InputError
        The run file cannot be read, or is no TOML.
    """
    named = tables_of(run).get("rig")
    return run.parent / named if isinstance(named, str) and named != VIRTUAL else None


def runs_on_virtual_rig(run: Path) -> bool:
    """Whether a run file's campaign needs no instruments; the capture reports one that cannot be read."""
    try:
        rig = rig_of_run(run)
    except InputError:
        return True
    return rig is None or names_virtual_rig(rig)
