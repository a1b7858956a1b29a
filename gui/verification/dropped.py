"""What a file that is dropped on the tab is: told by its content, not by its name."""

from __future__ import annotations

import tomllib
from enum import Enum, auto
from pathlib import Path

from PyQt5.QtCore import QUrl
from PyQt5.QtGui import QDropEvent

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
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return Dropped.STRANGE
    if "source" in content or "scene" in content:
        return Dropped.SCENE
    return Dropped.RIG if isinstance(content.get("rig"), dict) else Dropped.STRANGE


def dropped_paths(event: QDropEvent) -> list[Path]:
    """Files of this machine in a drop."""
    content = event.mimeData()
    urls: list[QUrl] = [] if content is None else content.urls()
    return [Path(url.toLocalFile()) for url in urls if url.isLocalFile()]
