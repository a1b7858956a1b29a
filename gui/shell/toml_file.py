"""TOML files as the window looks at them: what one is for; the commands tell what is wrong with it."""

from __future__ import annotations

import tomllib
from enum import Enum, auto
from pathlib import Path
from typing import Any

from acquisition.text_file import read_text
from storage.errors import InputError


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
