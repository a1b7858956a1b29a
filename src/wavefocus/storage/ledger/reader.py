"""Reading the rows of a ledger file straight from their offsets, without locks, also while it is written."""

import errno
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.durable import PositionedFile
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.layout import LedgerLayout
from wavefocus.storage.ledger.owner import owner_path
from wavefocus.storage.ledger.pages import LedgerFormat, Replacement, is_empty

# A reader may meet a position that is just being measured again; that takes milliseconds.
_TRIES = 4
_PAUSE_S = 0.01


class DamagedError(InputError):
    """A position is not what was written; others may be."""


class LedgerReader:
    """Positions of a file of this program, checked against its ledger.

    file: What the layout's offsets are in, read as a `PositionedFile` is; by default the file itself.
    """

    def __init__(self, path: Path, layout: LedgerLayout, file: Any = None) -> None:
        self._path, self._layout, self._shape = path, layout, layout.shape
        self._tries = _TRIES if file is None else 1  # what is given is not being written
        try:
            self._file = file or PositionedFile(path)
        except OSError as error:
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        try:
            # Before the ledger: a status stands in the file only after its ledger row.
            has_status = "/status" in layout.figures
            noted = self.figure("/status") if has_status else bytes(layout.positions)
            for attempt in range(self._tries):
                if attempt:
                    time.sleep(_PAUSE_S)
                self._read_ledger()
                if not self.ledger.damaged.any():  # else a row may just be being written
                    break
        except OSError as error:
            self._file.close()
            raise InputError(f"{path} may not be read: {error.strerror}") from error
        self._erased = self.ledger.empty & (np.frombuffer(noted, np.uint8) != 0)
        self._has_status = has_status

    def broken(self) -> NDArray[np.bool_]:
        """Positions (P,) that were measured and whose ledger row does not hold or is zeros."""
        return np.asarray(self.ledger.damaged | self._erased)

    def chunks(self, position: int) -> tuple[memoryview, ...] | None:
        """Data of a position in each dataset; None where the ledger holds nothing for it.

        Raises DamagedError: a checksum does not hold. InputError: the file cannot be read.
        """
        if self._replacing and self._replacing.position == position:
            return self._replaced(self._replacing)  # as its ledger row was taken from the journal
        try:
            for attempt in range(self._tries):
                if attempt:
                    time.sleep(_PAUSE_S)
                found = self._chunks_once(position)
                if found is not None:
                    return found or None
        except OSError as error:
            cause = "the file is closed; open it again" if error.errno == errno.EBADF else error.strerror
            raise InputError(f"{self._path}: position {position} is not readable: {cause}") from error
        raise DamagedError(damage_of(self._path, self._shape.format, position))

    def damaged(self) -> tuple[int, ...]:
        """Positions whose checksums do not hold."""
        damaged = []
        for position in np.flatnonzero(~self.ledger.empty | self._erased).tolist():
            try:
                self.chunks(position)
            except InputError:
                damaged.append(position)
        return tuple(damaged)

    def differing(self) -> NDArray[np.bool_]:
        """Positions (P,) whose figures in the file are not those of the ledger; earlier versions have fewer figures."""
        differs = np.zeros(self._layout.positions, bool)
        for name, values in self._shape.format.figures(self.ledger.rows, self.ledger.holds, self._shape).items():
            if name in self._layout.figures:
                # Byte by byte, so that NaN is as good as any other value.
                noted, held = (np.frombuffer(both, np.uint8) for both in (self.figure(name), values.tobytes()))
                differs |= (noted != held).reshape(len(differs), -1).any(axis=1)
        return differs

    def torn(self) -> list[int]:
        """Positions that hold data and whose ledger row is zeros: a writer was between the two, or ended there."""
        return [position for position in np.flatnonzero(self.ledger.empty).tolist() if self._holds_data(position)]

    def journal_state(self) -> str:
        """Return "empty", "whole" (a replacement is under way or was cut off), or "torn"."""
        content = self._file.read(self._layout.journal_offset, self._shape.journal_bytes)
        return "empty" if is_empty(content) else "whole" if self._shape.decode_journal(content) else "torn"

    def figure(self, name: str) -> bytearray:
        """Bytes of a dataset that follows from the ledger, as they lie in the file."""
        offset, size = self._layout.figures[name]
        return self._file.read(offset, size * self._layout.positions)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _data(self, position: int) -> tuple[memoryview, ...]:
        chunks = tuple(np.empty(self._shape.data_bytes, np.uint8).data for _ in self._layout.chunk_offset)
        for offsets, chunk in zip(self._layout.chunk_offset, chunks, strict=True):
            self._file.read_into(int(offsets[position]), chunk)
        return chunks

    def _read_ledger(self) -> None:
        size = self._shape.row_bytes
        rows = self._file.read(self._layout.ledger_offset, self._layout.positions * size)
        self._replacing = self._read_journal()
        if self._replacing:
            rows[self._replacing.position * size : (self._replacing.position + 1) * size] = self._replacing.row
        self.ledger = self._shape.decode(rows)

    def _chunks_once(self, position: int) -> tuple[memoryview, ...] | None:
        """Data of a position, nothing (an empty tuple) where none was committed, None where they do not hold."""
        row = self._file.read(self._layout.row_offset(position), self._shape.row_bytes)
        crcs = self._shape.crcs(row, position)
        if crcs is None and is_empty(row):
            return None if self._erased[position] or self._is_lost(position) else ()
        chunks = self._data(position)
        if crcs is not None and self._shape.holds(crcs, chunks):
            return chunks
        replacing = self._read_journal()
        return self._replaced(replacing) if replacing is not None and replacing.position == position else None

    def _replaced(self, replacing: Replacement) -> tuple[memoryview, ...]:
        return tuple(memoryview(bytearray(chunk))[: self._shape.data_bytes] for chunk in replacing.chunks)

    def _is_lost(self, position: int) -> bool:
        # Without a status that says that a position was measured, its data do, unless a writer just wrote them.
        return not self._has_status and not owner_path(self._path).exists() and self._holds_data(position)

    def _holds_data(self, position: int) -> bool:
        return not all(map(is_empty, self._data(position)))

    def _read_journal(self) -> Replacement | None:
        """The row that is just replacing an older one, or that a crash kept from doing so."""
        entry = self._shape.decode_journal(self._file.read(self._layout.journal_offset, self._shape.journal_bytes))
        return entry if entry and entry.position < self._layout.positions else None


def damage_of(path: Path, form: LedgerFormat, position: int, more: str = "") -> str:
    """Say that a position's checksum does not hold, and what to do."""
    remedy = form.remedy.format(path=path)
    return f"{path}: position {position} is damaged, its checksum does not hold{more}; {remedy}"
