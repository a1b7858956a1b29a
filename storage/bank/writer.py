"""Measuring into a bank, so that a crash at any instant loses nothing that was acknowledged.

The order of writes is the design: Green's functions, sync, ledger row, sync. A position that is measured
again goes through the journal first. ``/status`` and ``/quality`` follow from the ledger and are rebuilt
from it on opening.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage import durable, hdf5_safety
from storage.bank import layout as bank_layout
from storage.bank.creation import create_bank
from storage.bank.header import BankHeader
from storage.bank.layout import BankLayout
from storage.bank.ledger import (
    DISABLED,
    QUALITY_NAMES,
    VALID,
    Ledger,
    PointRecord,
    decode_journal,
    decode_rows,
    encode_journal,
    encode_row,
    green_crc_of_row,
    journal_bytes,
    ledger_row_bytes,
    round_to_page,
)
from storage.closing import Closing
from storage.errors import FileLostError, InputError
from storage.owned_file import OwnedFile
from storage.rescue import rescue
from storage.row_journal import RowJournal

Float32Array = NDArray[np.float32]

# So many positions say how loud the reference is: an output's level moves within a night.
LATEST = 30


class BankWriter(Closing):
    """The one process that measures into a bank; a context manager.

    Made by :meth:`open`. A failed write closes the way for further commits: opening the bank again repairs
    it.
    """

    def __init__(self, file: OwnedFile, layout: BankLayout) -> None:
        self.path = file.path
        self.header: BankHeader = layout.header
        self._file = file
        self._layout = layout
        size = journal_bytes(self.header.actuators, self.header.taps)
        self._journal = RowJournal(file, layout.journal_offset, size)
        with self._file.writing("recovering what a crash left"):
            self._replay_journal()
            self._read_ledger()
            self._clear_torn_rows()
            self._rebuild_derived()
        file.watch(min(offset for offset, _ in layout.extents()))

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        plan_sha256: str | None = None,
        open_file: durable.OpenFile = durable.open_file,
    ) -> BankWriter:
        """Own a bank and bring it into order.

        Parameters
        ----------
        path : str or Path
            A bank that ``bank_creation.create_bank`` made.
        plan_sha256 : str, optional
            The plan about to be measured; any plan is accepted when None.
        open_file : durable.OpenFile
            How the file is opened.

        Raises
        ------
        InputError
            When the file is no such bank, damaged beyond its rows, or belongs to another plan; it is left
            untouched.
        BankBusyError
            When another process owns it.
        WavefocusError
            When it cannot be written.
        """
        path = Path(path)

        def read() -> BankLayout:
            with hdf5_safety.opened(path) as content:
                layout = bank_layout.read_layout(content, path)
            _require_plan(path, layout.header, plan_sha256)
            return layout

        return OwnedFile.bring_into_order(path, "bank", open_file, read, cls)

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,), 0 where a position is still to be measured; every row was verified."""
        return self._status.copy()

    @property
    def attempts(self) -> NDArray[np.int64]:
        """How often each position was measured (P,)."""
        return self._attempts.copy()

    @property
    def renamed(self) -> bool:
        """Whether the file was renamed while it was open; it has its first name again, beside the other."""
        return self._file.renamed

    @property
    def damaged(self) -> tuple[int, ...]:
        """Positions that were measured once and whose checksum no longer held on opening."""
        return self._damaged

    def commit(self, position: int, green: Float32Array, record: PointRecord) -> None:
        """Keep one position for good; when this returns, no crash loses it.

        Parameters
        ----------
        position : int
            Row of the bank, 0 to P - 1.
        green : float32 array (N, L)
            Its Green's functions, finite; zeros where nothing could be measured.
        record : PointRecord
            Its status and quality.

        Raises
        ------
        InputError
            When position, shape or values are outside what is stated here; nothing is written.
        FileLostError
            When the file was deleted, replaced, truncated or overwritten; what it still held, and this
            position, are in a file that the message names.
        WavefocusError
            When the disk failed; positions committed earlier are intact.
        """
        self._require_position(position)
        shape = (self.header.actuators, self.header.taps)
        if np.shape(green) != shape:
            raise InputError(f"green of position {position} has shape {np.shape(green)}; {shape} is needed")
        values = np.ascontiguousarray(green, "<f4")
        if not np.isfinite(values).all():
            raise InputError(
                f"green of position {position} holds values that are not finite; zeros mark what is missing"
            )
        chunk = values.tobytes().ljust(round_to_page(self.header.chunk_bytes), b"\0")
        row = encode_row(position, record, values)
        with self._rescuing((position, chunk, row)), self._file.writing(f"writing position {position}"):
            if self._status[position]:
                self._replace(position, chunk, row)
            else:
                self._write_row(position, chunk, row)
            self._note(position, record)

    def disable(self, position: int) -> None:
        """Exclude a position: its status loses the valid bit and gains 16; what was measured stays.

        Raises
        ------
        InputError
            When there is no such position.
        WavefocusError
            When the disk failed.
        """
        self._require_position(position)
        if not self._status[position]:
            unknown = np.full(self.header.actuators, np.nan, np.float32)
            record = PointRecord(DISABLED, int(self._attempts[position]), unknown, unknown, unknown, unknown)
            self.commit(position, np.zeros((self.header.actuators, self.header.taps), np.float32), record)
            return
        kept = self.record(position)
        self.commit(position, self.green(position), replace(kept, status=(kept.status & ~VALID) | DISABLED))

    def set_status(self, position: int, status: int, judged: int = 0) -> None:
        """Keep all that is in a measured position's row but for its status bits and `PointRecord.judged`.

        Raises
        ------
        InputError
            When there is no such position, or it is not measured.
        WavefocusError
            When the disk failed.
        """
        self._require_position(position)
        if not self._status[position]:
            raise InputError(f"position {position} is not measured; commit it first")
        self.commit(position, self.green(position), replace(self.record(position), status=status, judged=judged))

    def count_attempts(self, position: int, attempts: int) -> None:
        """Keep all that is known of a measured position but for how often it was tried.

        Raises
        ------
        InputError
            When there is no such position, or it is not measured.
        WavefocusError
            When the disk failed.
        """
        self._require_position(position)
        if not self._status[position]:
            raise InputError(f"position {position} is not measured; commit it first")
        self.commit(position, self.green(position), replace(self.record(position), attempts=attempts))

    def green(self, position: int) -> Float32Array:
        """Read one position's Green's functions, float32 (N, L); zeros where it is not measured."""
        self._require_position(position)
        green = np.zeros((self.header.actuators, self.header.taps), "<f4")
        if self._status[position]:
            self._file.read_into(int(self._layout.chunk_offset[position]), green.data.cast("B"))
        return green.astype(np.float32, copy=False)

    def record(self, position: int) -> PointRecord:
        """Status and quality of a measured position, as its ledger row has them."""
        content = self._file.read(self._row_offset(position), ledger_row_bytes(self.header.actuators))
        kept = decode_rows(content, self.header.actuators, self.header.taps, position)
        figures = {name: kept.quality[name][0] for name in QUALITY_NAMES if name != "attempts"}
        attempts, judged = int(kept.quality["attempts"][0]), int(kept.judged[0])
        return PointRecord(int(kept.status[0]), attempts, **figures, judged=judged)

    def reference_before_db(self, position: int) -> float | None:
        """Median level of the reference at the latest valid positions before one; after it, where there are none.

        None where no valid position says.
        """
        known = (self._status == VALID) & np.isfinite(self._reference_db)
        known[position] = False
        rows = np.flatnonzero(known)
        before = rows[rows < position][-LATEST:]
        chosen = before if before.size else rows[:LATEST]
        return float(np.median(self._reference_db[chosen])) if chosen.size else None

    def close(self) -> None:
        """Sync, take the owner's name away and release the bank; closing twice does nothing.

        Raises
        ------
        FileLostError, WavefocusError
            As :meth:`commit`.
        """
        try:
            with self._rescuing(None):
                self._file.finish()
        finally:
            self._file.close()

    @contextmanager
    def _rescuing(self, under_way: tuple[int, bytes, bytes] | None) -> Iterator[None]:
        try:
            yield
        except FileLostError as lost:
            copy_to = partial(self._copy_to, under_way)
            raise rescue(lost, self.path, self._file.folder, copy_to) from lost

    def _copy_to(self, under_way: tuple[int, bytes, bytes] | None, path: Path) -> int:
        """Make a bank of all rows that are still whole, and of the one being written."""
        rows = {} if under_way is None else {under_way[0]: under_way[1:]}
        create_bank(path, self.header)
        with BankWriter.open(path) as copy:
            for position in np.flatnonzero(self._status).tolist():
                if position not in rows and (row := self._whole_row(position)) is not None:
                    copy._write_row(position, *row)
            for position, row in rows.items():
                copy._write_row(position, *row)
        with BankWriter.open(path) as copy:  # which makes /status and /quality from the rows
            return int(np.count_nonzero(copy.status))

    def _whole_row(self, position: int) -> tuple[bytes, bytes] | None:
        """Green's functions and ledger row as they lie in the file; None where they do not hold."""
        size = ledger_row_bytes(self.header.actuators)
        try:
            row = self._file.read(self._row_offset(position), size)
            chunk = self._file.read(int(self._layout.chunk_offset[position]), round_to_page(self.header.chunk_bytes))
        except OSError:
            return None
        crc = green_crc_of_row(row, position, self.header.actuators, self.header.taps)
        whole = crc is not None and zlib.crc32(memoryview(chunk)[: self.header.chunk_bytes]) == crc
        return (bytes(chunk), bytes(row)) if whole else None

    def _write_row(self, position: int, chunk: bytes, row: bytes) -> None:
        self._file.write(int(self._layout.chunk_offset[position]), chunk)
        self._file.sync()
        self._file.write(self._row_offset(position), row)
        self._file.sync()

    def _replace(self, position: int, chunk: bytes, row: bytes) -> None:
        self._journal.keep(encode_journal(position, chunk, row))
        self._write_row(position, chunk, row)
        self._journal.clear()

    def _note(self, position: int, record: PointRecord) -> None:
        """Write the derived figures of one position; no sync, since the ledger can give them back."""
        kept = self.record(position)  # rounded as the ledger rounds them
        self._file.write(self._layout.status_offset + position, bytes([record.status]))
        for name, offset in self._layout.quality_offset.items():
            figure = np.asarray(getattr(kept, name), "<f4")
            self._file.write(offset + position * figure.nbytes, figure.tobytes())
        self._reference_db[position] = kept.reference_db
        self._status[position] = record.status
        self._attempts[position] = record.attempts

    def _replay_journal(self) -> None:
        content = self._journal.entry()
        if content is None:
            return
        entry = decode_journal(content, self.header.actuators, self.header.taps)
        if entry and entry[0] < self.header.positions:
            self._write_row(*entry)
        self._journal.clear()

    def _read_ledger(self) -> None:
        rows = self._file.read(
            self._layout.ledger_offset, self.header.positions * ledger_row_bytes(self.header.actuators)
        )
        self._ledger: Ledger = decode_rows(rows, self.header.actuators, self.header.taps)
        trusted = self._ledger.holds.copy()
        chunk = bytearray(round_to_page(self.header.chunk_bytes))
        self._torn: list[int] = []
        for position, offset in enumerate(self._layout.chunk_offset.tolist()):
            self._file.read_into(offset, memoryview(chunk))
            if trusted[position]:
                crc = zlib.crc32(memoryview(chunk)[: self.header.chunk_bytes])
                trusted[position] = crc == self._ledger.green_crc[position]
            elif self._ledger.empty[position] and np.frombuffer(chunk, np.uint64).any():
                self._torn.append(position)
        self._status = np.where(trusted, self._ledger.status, 0).astype(np.uint8)
        self._attempts = np.where(trusted, self._ledger.quality["attempts"], 0).astype(np.int64)
        self._reference_db = np.where(trusted, self._ledger.quality["reference_db"], np.nan)
        self._damaged = tuple(int(position) for position in np.flatnonzero(~trusted & ~self._ledger.empty))

    def _clear_torn_rows(self) -> None:
        """Make rows that a crash left half-written read as zeros again, as all rows not yet measured do."""
        for position in self._torn:
            zeros = bytes(round_to_page(self.header.chunk_bytes))
            self._file.write(int(self._layout.chunk_offset[position]), zeros)

    def _rebuild_derived(self) -> None:
        known = self._status > 0
        derived = {self._layout.status_offset: self._status.tobytes()}
        for name in self._layout.quality_offset:
            figures = self._ledger.quality[name].astype("<f4")
            figures[~known] = 0 if name == "attempts" else np.nan
            derived[self._layout.quality_offset[name]] = figures.tobytes()
        for offset, content in derived.items():
            if self._file.read(offset, len(content)) != content:
                self._file.write(offset, content)
        del self._ledger, self._torn

    def _row_offset(self, position: int) -> int:
        return self._layout.ledger_offset + position * ledger_row_bytes(self.header.actuators)

    def _require_position(self, position: int) -> None:
        if not 0 <= position < self.header.positions:
            raise InputError(f"position {position} is not in bank {self.path}; 0 to {self.header.positions - 1} are")


def _require_plan(path: Path, header: BankHeader, plan_sha256: str | None) -> None:
    if plan_sha256 is not None and plan_sha256 != header.plan_sha256:
        raise InputError(
            f"{path} belongs to another plan ({header.plan_sha256[:12]}, not {plan_sha256[:12]});"
            " resume it from the bank alone, undo the change, or name a new bank"
        )
