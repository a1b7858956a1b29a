"""What lies beside a bank: names, and small files that one process writes whole and others read whole."""

from __future__ import annotations

import errno
import glob
import json
import secrets
import time
from collections.abc import Mapping
from pathlib import Path

from storage.sidecar_files import create, is_replaceable

# A file that somebody reads just now cannot be replaced on Windows; the reader is done at once.
_TRIES = 5
_PAUSE_S = 0.02
# More than any of these files ever is.
_MOST_BYTES = 65536


def raw_path(bank: Path) -> Path:
    """Where the raw recordings of a bank are kept: ``plate.h5`` -> ``plate.raw.h5``."""
    return bank.with_name(f"{bank.stem if bank.suffix == '.h5' else bank.name}.raw.h5")


def log_path(bank: Path) -> Path:
    """Where the events of a bank are logged: ``plate.h5`` -> ``plate.events.jsonl``."""
    return bank.with_suffix(".events.jsonl")


def write_whole(path: Path, content: Mapping[str, object], *, by_many: bool = False) -> None:
    """Write a JSON object so that a reader finds the old one or the new one and nothing in between.

    Parameters
    ----------
    path : Path
        The file.
    content : mapping
        What it shall hold.
    by_many : bool
        Whether several processes may write it at once. A file that one process writes leaves nothing behind that the
        next one does not take over, however it ends.

    Raises
    ------
    OSError
        It cannot be written.
    """
    if not is_replaceable(path):
        raise FileExistsError(errno.EEXIST, "a file of another program has this name", str(path))
    new = path.with_name(f".{path.name}.{secrets.token_hex(8)}.new")
    try:
        with create(new) as file:
            file.write((json.dumps(content) + "\n").encode())
        for left in reversed(range(_TRIES)):
            try:
                new.replace(path)
                break
            except PermissionError:
                if left == 0:
                    raise
                time.sleep(_PAUSE_S)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    if not by_many:
        for left_behind in path.parent.glob(f".{glob.escape(path.name)}.*.new"):  # by processes that were killed
            left_behind.unlink(missing_ok=True)


def read_whole(path: Path) -> dict[str, object] | None:
    """The JSON object in a file; None where there is no such file or none in it."""
    try:
        with path.open("rb") as file:
            content = json.loads(file.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None
