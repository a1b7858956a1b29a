"""The positions of a scan that have a record, kept one by one, so that an interrupted scan goes on where it was.

A line of JSON, filled up to one page, then entries of one size, each with its checksum. What a crash left unfinished
at the end is written over.
"""

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable
from wavefocus.storage.durable import PAGE, Closing
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.storage.sidecar_files import create

FORMAT = "wavefocus-scan-journal"


@dataclass(frozen=True, slots=True, eq=False)
class ScannedPosition:
    """One position: bank row, status bits, records taken, figures of its record, and its response (samples,)."""

    row: int
    status: int
    attempts: int
    noise_rms: float
    clock_ratio: float
    playback_gain: float
    response: NDArray[np.float32]


def identity_of(path: Path) -> str | None:
    """Identity of the scan that a journal holds; None where there is none that can be read."""
    try:
        with path.open("rb") as file:
            return str(json.loads(file.read(PAGE))["identity"])
    except (OSError, ValueError, TypeError, KeyError):
        return None


class ScanJournal(Closing):
    """The one process that scans into a journal; a context manager.

    path: The file; it is made where missing.
    identity: What was played on what: entries of another scan are refused.
    samples: Samples of a response.
    replace: Drop the entries of another scan instead.

    Raises InputError: the file is not a journal, or of another scan. BankBusyError: another process scans into it.
    """

    def __init__(self, path: Path, identity: str, samples: int, *, replace: bool = False) -> None:
        self.path = path
        self._entry = np.dtype([
            ("row", "<i8"), ("status", "<u4"), ("attempts", "<u4"), ("noise_rms", "<f8"), ("clock_ratio", "<f8"),
            ("playback_gain", "<f8"), ("response", "<f4", (samples,)), ("crc32", "<u4"),
        ])  # fmt: skip
        head = json.dumps({"format": FORMAT, "format_version": 1, "identity": identity, "samples": samples})
        self._head = head.encode().ljust(PAGE - 1) + b"\n"
        self._head_crc = zlib.crc32(self._head)
        if not path.exists():
            create(path).close()
        elif not path.is_file() or path.is_symlink():
            raise InputError(f"{path} is not a regular file; remove it, or name another folder")
        self._file = durable.PositionedFile(path, write=True)
        try:
            self._own(replace=replace)
        except BaseException:
            self._file.close()
            raise

    def __len__(self) -> int:
        return self._entries

    def entries(self) -> Iterator[ScannedPosition]:
        """All positions that are kept, in the order in which they were scanned."""
        for number in range(self._entries):
            entry = self._read(number)
            assert entry is not None
            figures: dict[str, Any] = {field.name: entry[field.name].item() for field in fields(ScannedPosition)[:-1]}
            yield ScannedPosition(**figures, response=entry["response"])

    def append(self, scanned: ScannedPosition) -> None:
        """Keep one more position for good. Raises OSError: it cannot be written."""
        entry = np.zeros((), self._entry)
        for field in fields(scanned):
            entry[field.name] = getattr(scanned, field.name)
        entry["crc32"] = zlib.crc32(entry.tobytes()[:-4], self._head_crc)
        self._file.write(self._offset(self._entries), entry.tobytes())
        self._file.sync()
        self._entries += 1

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def _own(self, *, replace: bool) -> None:
        if not self._file.try_lock():
            raise BankBusyError(
                f"{self.path}: another process scans into this folder; name another, or wait for its end"
            )
        self._entries = 0
        size = self._file.size()
        head = self._file.read(0, min(size, PAGE))
        # New, or killed or without power while it was made: sectors that were not yet written may be zeros.
        if size < PAGE or (size == PAGE and all(held in (0, own) for held, own in zip(head, self._head, strict=True))):
            self._begin()
            return
        if not head.startswith(b'{"format": "' + FORMAT.encode()):
            raise InputError(f"{self.path} is not what a scan left; remove it, or name another folder")
        if head != self._head:
            if not replace:
                raise InputError(
                    f"{self.path} holds an interrupted scan of another drive, bank or rig; finish that with its own"
                    " arguments, name another folder, or drop it with --force"
                )
            self._begin()
            return
        while self._offset(self._entries + 1) <= self._file.size() and self._read(self._entries) is not None:
            self._entries += 1

    def _begin(self) -> None:
        """Begin anew; entries of another scan no longer hold, for their checksums count the head."""
        self._file.write(0, self._head)
        self._file.sync()

    def _offset(self, number: int) -> int:
        return PAGE + number * self._entry.itemsize

    def _read(self, number: int) -> np.void | None:
        """An entry, or None where it is not whole."""
        content = self._file.read(self._offset(number), self._entry.itemsize)
        entry = np.frombuffer(content, self._entry)[0]
        return entry if zlib.crc32(content[:-4], self._head_crc) == entry["crc32"] else None
