"""Follows an event log as it grows, whoever writes it."""

from __future__ import annotations

import json
from pathlib import Path

# What is read at once: larger blocks leave the memory of their many small objects behind.
_BLOCK_BYTES = 1 << 17


class LogTail:
    """Reads what was appended since the last look; the file is never held open.

    Parameters
    ----------
    path : Path
        A file of JSON lines; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._identity: tuple[int, int] | None = None
        self._offset = 0

    def read(self) -> tuple[list[dict[str, object]], bool]:
        """Return new records, at most a block of them, and whether the file has begun anew.

        A line without its end is left for later; one that is no JSON object (torn by a power cut) is passed over.
        A file that is gone, or cannot be read just now, has nothing new.
        """
        try:
            found = self._path.stat()
        except OSError:
            return [], False
        identity = (found.st_dev, found.st_ino)
        anew = self._identity is not None and (identity != self._identity or found.st_size < self._offset)
        if anew or self._identity is None:
            self._offset = 0
        self._identity = identity
        if found.st_size == self._offset:
            return [], anew
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                block = file.read(_BLOCK_BYTES)
        except OSError:
            return [], anew
        end = block.rfind(b"\n") + 1
        if end == 0 and len(block) == _BLOCK_BYTES:
            end = len(block)  # no event is that long; do not wait for its end for ever
        self._offset += end
        return [record for line in block[:end].splitlines() if (record := _record(line)) is not None], anew


def _record(line: bytes) -> dict[str, object] | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None
