"""What a file that is dropped on the tab is: told by its content, not by its name."""

from __future__ import annotations

from enum import Enum, auto
from pathlib import Path

from gui.shell.toml_files import TomlKind, toml_kind
from gui.verification.results import record_of


class Dropped(Enum):
    """Kinds of files."""

    RECORD = auto()
    SCENE = auto()
    RIG = auto()
    BANK = auto()
    FOLDER = auto()
    STRANGE = auto()


def kind_of(path: Path) -> Dropped:
    """What a file or folder is to a verification."""
    if record_of(path) is not None:
        return Dropped.RECORD
    if path.is_dir():
        return Dropped.FOLDER
    name = path.name.lower()
    if name.endswith(".h5") and not name.endswith(".raw.h5"):
        return Dropped.BANK
    if not name.endswith(".toml"):
        return Dropped.STRANGE
    return {TomlKind.SCENE: Dropped.SCENE, TomlKind.RIG: Dropped.RIG}.get(toml_kind(path), Dropped.STRANGE)
