"""Keeping raw recordings, as durably as the bank: recordings, sync, ledger row, sync."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage import durable, hdf5_safety
from storage.closing import Closing
from storage.durable import PAGE
from storage.errors import FileLostError, InputError
from storage.file_creation import create_reserved
from storage.owned_file import OwnedFile
from storage.raw import layout as raw_layout
from storage.raw.header import RawHeader
from storage.raw.layout import RawLayout
from storage.raw.ledger import (
    RawRow,
    decode_raw_journal,
    decode_raw_row,
    encode_raw_journal,
    encode_raw_row,
    raw_journal_bytes,
)
from storage.rescue import rescue
from storage.row_journal import RowJournal

Float32Array = NDArray[np.float32]


def create_raw(path: str | Path, header: RawHeader, *, open_file: durable.OpenFile = durable.open_file) -> None:
    """Make an empty raw file with all its space reserved; an existing file is never touched.

    Parameters
    ----------
    path : str or Path
        A file that does not exist, in a folder that does.
    header : RawHeader
        What the file says about itself.
    open_file : durable.OpenFile
        How the file is opened when its space is reserved.

    Raises
    ------
    ExistsError
        When the path exists.
    InputError
        When the folder is missing, or the disk is too small; nothing is left behind.
    """
    create_reserved(Path(path), header.file_bytes, lambda new: raw_layout.lay_out(new, header), open_file)


class RawWriter(Closing):
    """The one process that records into a raw file; a context manager, made by :meth:`open`."""

    def __init__(self, file: OwnedFile, layout: RawLayout) -> None:
        self.path = file.path
        self.header: RawHeader = layout.header
        self._file = file
        self._layout = layout
        self._journal = RowJournal(file, layout.journal_offset, raw_journal_bytes(layout.chunk_bytes))
        with self._file.writing("recovering what a crash left"):
            self._replay_journal()
            pages = self._file.read(layout.ledger_offset, self.header.positions * PAGE)
        self._recorded = np.array([self._row(pages, position) is not None for position in range(self.header.positions)])
        file.watch(min(offset for offset, _ in layout.extents()))

    @classmethod
    def open(
        cls,
        path: str | Path,
        *,
        plan_sha256: str | None = None,
        open_file: durable.OpenFile = durable.open_file,
    ) -> RawWriter:
        """Own a raw file and bring it into order.

        Parameters
        ----------
        path : str or Path
            A file that :func:`create_raw` made.
        plan_sha256 : str, optional
            The plan about to be recorded; any plan is accepted when None.
        open_file : durable.OpenFile
            How the file is opened.

        Raises
        ------
        InputError
            When the file is no such file, damaged beyond its rows, or belongs to another plan.
        BankBusyError
            When another process owns it.
        WavefocusError
            When it cannot be written.
        """
        path = Path(path)

        def read() -> RawLayout:
            with hdf5_safety.opened(path) as content:
                layout = raw_layout.read_raw_layout(content, path)
            found = layout.header.plan_sha256
            if plan_sha256 is not None and plan_sha256 != found:
                raise InputError(
                    f"{path} belongs to another plan ({found[:12] or 'it names none'}, not {plan_sha256[:12]}); "
                    "undo the change, or name a new file"
                )
            return layout

        return OwnedFile.bring_into_order(path, "raw file", open_file, read, cls)

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """Which positions (P,) are kept; a row that is damaged is not."""
        return self._recorded.copy()

    def commit(self, position: int, reference_v: Float32Array, response_v: Float32Array) -> None:
        """Keep the recordings of one position for good; when this returns, no crash loses them.

        Parameters
        ----------
        position : int
            Row of the file, 0 to P - 1.
        reference_v, response_v : float32 array, shape (records, samples)
            The two DAQ channels in volts, a record per row; whole multiples of the header's volts per count,
            within the range of 16 bits.

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
        if not 0 <= position < self.header.positions:
            raise InputError(
                f"position {position} is not in raw file {self.path}; 0 to {self.header.positions - 1} are"
            )
        counts = [
            self._counts(name, volts, step)
            for name, volts, step in zip(
                ("reference", "response"), (reference_v, response_v), self.header.volts_per_count, strict=True
            )
        ]
        shape = (self.header.records, self.header.samples)
        row = encode_raw_row(RawRow(position, *shape, zlib.crc32(counts[0]), zlib.crc32(counts[1])))
        reference, response = (one.ljust(self._layout.chunk_bytes, b"\0") for one in counts)
        under_way = (position, reference, response, row)
        with self._rescuing(under_way), self._file.writing(f"writing position {position}"):
            if self._file.read(self._row_offset(position), PAGE).count(0) < PAGE:
                self._journal.keep(encode_raw_journal(position, reference, response, row))
                self._write_row(position, reference, response, row)
                self._journal.clear()
            else:
                self._write_row(position, reference, response, row)
        self._recorded[position] = True

    def close(self) -> None:
        """Sync, take the owner's name away and release the file; closing twice does nothing.

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
    def _rescuing(self, under_way: tuple[int, bytes, bytes, bytes] | None) -> Iterator[None]:
        try:
            yield
        except FileLostError as lost:
            copy_to = partial(self._copy_to, under_way)
            raise rescue(lost, self.path, self._file.folder, copy_to) from lost

    def _copy_to(self, under_way: tuple[int, bytes, bytes, bytes] | None, path: Path) -> int:
        """Make a raw file of all recordings that are still whole, and of those being written."""
        rows = {} if under_way is None else {under_way[0]: under_way[1:]}
        create_raw(path, self.header)
        with RawWriter.open(path) as copy:
            for position in np.flatnonzero(self._recorded).tolist():
                if position not in rows and (row := self._whole_row(position)) is not None:
                    copy._write_row(position, *row)
                    copy._recorded[position] = True
            for position, row in rows.items():
                copy._write_row(position, *row)
                copy._recorded[position] = True
            return int(np.count_nonzero(copy.recorded))

    def _whole_row(self, position: int) -> tuple[bytes, bytes, bytes] | None:
        """Both channels and ledger row as they lie in the file; None where they do not hold."""
        try:
            page = self._file.read(self._row_offset(position), PAGE)
            reference, response = (
                bytes(self._file.read(int(offsets[position]), self._layout.chunk_bytes))
                for offsets in self._layout.channel_offset
            )
        except OSError:
            return None
        row = decode_raw_row(page, position, self.header.records, self.header.samples)
        size = self.header.chunk_bytes
        whole = row is not None and row.holds(memoryview(reference)[:size], memoryview(response)[:size])
        return (reference, response, bytes(page)) if whole else None

    def _counts(self, name: str, volts: Float32Array, step_v: float) -> bytes:
        shape = (self.header.records, self.header.samples)
        if np.shape(volts) != shape:
            raise InputError(f"the {name} has shape {np.shape(volts)}; {shape} is needed")
        counts = np.multiply(volts, 1 / step_v, dtype=np.float64)
        rounded = np.rint(counts)
        if not (np.isfinite(counts).all() and rounded.min() >= -32768 and rounded.max() <= 32767):
            raise InputError(
                f"the {name} holds values that are not finite or beyond {32768 * step_v:g} V; "
                "those of the header's converter are needed"
            )
        return rounded.astype("<i2").tobytes()

    def _write_row(self, position: int, reference: bytes, response: bytes, row: bytes) -> None:
        for offsets, content in zip(self._layout.channel_offset, (reference, response), strict=True):
            self._file.write(int(offsets[position]), content)
        self._file.sync()
        self._file.write(self._row_offset(position), row)
        self._file.sync()

    def _replay_journal(self) -> None:
        content = self._journal.entry()
        if content is None:
            return
        entry = decode_raw_journal(content, self._layout.chunk_bytes)
        if entry is not None and entry[0] < self.header.positions:
            self._write_row(*entry)
        self._journal.clear()

    def _row(self, pages: bytearray, position: int) -> RawRow | None:
        page = memoryview(pages)[position * PAGE : (position + 1) * PAGE]
        return decode_raw_row(page, position, self.header.records, self.header.samples)

    def _row_offset(self, position: int) -> int:
        return self._layout.ledger_offset + position * PAGE
