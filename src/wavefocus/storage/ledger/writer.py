"""The one process that writes a ledger file: ownership, recovery, commits, and what becomes of a lost file."""

import os
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable, hdf5_reading
from wavefocus.storage.durable import Closing, PositionedFile
from wavefocus.storage.errors import FileLostError, InputError, WavefocusError
from wavefocus.storage.ledger import owner
from wavefocus.storage.ledger.layout import LedgerLayout
from wavefocus.storage.ledger.pages import Bytes, Ledger, LedgerFormat, Replacement, is_empty


class LedgerWriter(Closing):
    """The one process that writes into a bank or a raw file; a context manager.

    A failed write closes the way for further commits: opening the file again repairs it.
    """

    header: Any
    _format: ClassVar[LedgerFormat]

    def __init__(self, path: Path, file: PositionedFile, layout: LedgerLayout) -> None:
        self.path = path
        self.header = layout.header
        self.renamed = False
        """Whether the file was renamed while it was open; it has its first name again, in addition to the other."""
        self._file = file
        self._layout = layout
        self._shape = layout.shape
        self._kind = self._format.kind
        self._failure = ""
        self._closed = False
        self._folder = path.parent.stat()
        # Some network drives number a file anew each time it is asked for: there only the name can be watched.
        self._has_identity = file.is_named(path)
        self._head_crc = self._least_bytes = self._head_bytes = 0
        with self._writing("recovering what a crash left"):
            self._finish_replacement()
            self._measured = self._recover()
        self._head_bytes = int(layout.extents()[:, 0].min())  # what lies before is never written again
        self._head_crc = zlib.crc32(self._file.read(0, self._head_bytes))
        self._least_bytes = file.size()

    @classmethod
    def open(
        cls, path: str | Path, *, plan_sha256: str | None = None, open_file: durable.OpenFile = durable.PositionedFile
    ) -> Self:
        """Own a file and bring it into order.

        path: A file that this program made.
        plan_sha256: The plan about to be measured; any plan is accepted when None.
        open_file: How the file is opened.

        Raises InputError: when it is no such file, damaged beyond its rows, or belongs to another plan; it is left
        untouched. BankBusyError: when another process owns it. WavefocusError: when it cannot be written.
        """
        path, kind = Path(path), cls._format.kind
        file = owner.opened_as_owner(path, kind, open_file)
        try:
            with hdf5_reading.opened(path) as content:
                layout = cls._read_layout(content, path)
            found = layout.header.plan_sha256
            if plan_sha256 is not None and plan_sha256 != found:
                raise InputError(
                    f"{path} belongs to another plan ({found[:12] or 'it names none'}, not {plan_sha256[:12]});"
                    f" resume it from the bank alone, undo the change, or name a new {kind}"
                )
            owner.write_owner(path)  # for people who meet the lock
            try:
                return cls(path, file, layout)
            except BaseException:
                owner.remove_owner(path)
                raise
        except BaseException:
            file.close()
            raise

    def close(self) -> None:
        """Sync, take the owner's name away and release the file; closing twice does nothing.

        Raises FileLostError, WavefocusError: as a commit.
        """
        if self._closed:
            return
        try:
            if not self._failure:
                with self._rescuing(None), self._writing("closing"):
                    self._file.sync()
        finally:
            self._closed = True
            if self._file.is_named(self.path) or not self.path.exists():  # else another process may own it
                owner.remove_owner(self.path)
            self._file.close()

    @staticmethod
    def _read_layout(file: h5py.File, path: Path) -> LedgerLayout:
        raise NotImplementedError

    @staticmethod
    def _create(path: Path, header: Any) -> LedgerLayout:
        raise NotImplementedError

    def _recover(self) -> NDArray[np.bool_]:
        """Bring the file into order after a crash; return which positions count as measured."""
        raise NotImplementedError

    def _noted(self, position: int) -> None:
        """Write what follows from a position's ledger row; no sync, since the ledger can give it back."""
        figures = self._format.figures(self._row(position), np.ones(1, bool), self._shape)
        for name, (offset, size) in self._layout.figures.items():
            self._file.write(offset + position * size, figures[name].tobytes())

    def _read_ledger(self) -> Ledger:
        layout = self._layout
        return self._shape.decode(self._file.read(layout.ledger_offset, layout.positions * self._shape.row_bytes))

    def _restore_figures(self, rows: Bytes, holds: NDArray[np.bool_]) -> None:
        """Rewrite figures that are not those of the ledger rows that hold."""
        figures = self._format.figures(rows, holds, self._shape)
        for name, (offset, _) in self._layout.figures.items():
            content = figures[name].tobytes()
            if self._file.read(offset, len(content)) != content:
                self._file.write(offset, content)

    def _commit(self, position: int, chunks: Sequence[bytes], row: bytes) -> None:
        padded = tuple(chunk.ljust(self._shape.chunk_bytes, b"\0") for chunk in chunks)
        new = Replacement(position, padded, row)
        with self._rescuing(new), self._writing(f"writing position {position}"):
            if self._measured[position]:
                self._file.write(self._layout.journal_offset, self._shape.encode_journal(new))
                self._file.sync()
                self._write_row(new)
                self._clear_journal()
            else:
                self._write_row(new)
            self._noted(position)
            self._measured[position] = True

    def _require_position(self, position: int) -> None:
        if not 0 <= position < self._layout.positions:
            raise InputError(
                f"position {position} is not in {self._kind} {self.path}; 0 to {self._layout.positions - 1} are"
            )

    def _write_row(self, new: Replacement) -> None:
        for offsets, chunk in zip(self._layout.chunk_offset, new.chunks, strict=True):
            self._file.write(int(offsets[new.position]), chunk)
        self._file.sync()
        self._file.write(self._layout.row_offset(new.position), new.row)
        self._file.sync()

    def _clear_journal(self) -> None:
        self._file.write(self._layout.journal_offset, bytes(self._shape.journal_bytes))
        self._file.sync()

    def _finish_replacement(self) -> None:
        content = self._file.read(self._layout.journal_offset, self._shape.journal_bytes)
        if is_empty(content):
            return
        entry = self._shape.decode_journal(content)
        if entry is not None and entry.position < self._layout.positions:
            self._write_row(entry)
        self._clear_journal()

    def _row(self, position: int) -> bytearray:
        return self._file.read(self._layout.row_offset(position), self._shape.row_bytes)

    @contextmanager
    def _writing(self, what: str) -> Iterator[None]:
        """Turn a failure of the disk into one sentence, and let nothing be written after it."""
        if self._failure:
            raise WavefocusError(
                f"{self._kind} {self.path} takes no more commits after an earlier failure ({self._failure})"
            )
        try:
            self._require_place()
            yield
            self._require_place()
        except OSError as error:
            # After a failed sync the kernel may drop what it could not write: nothing in flight can be trusted.
            self._failure = f"{what}: {error.strerror or error}"
            raise WavefocusError(
                f"{self._kind} {self.path}: {self._failure}; what was measured before is safe; "
                "make the disk writable and resume"
            ) from error

    def _require_place(self) -> None:
        """Find the file by its name, of its size and with its header; a renamed one gets its name back if possible."""
        fault = self._displacement() or self._damage()
        if fault:
            self._failure = fault
            raise FileLostError(f"{self._kind} {self.path} {fault} while it was measured")

    def _displacement(self) -> str:
        if self._file.is_named(self.path) or (self.path.exists() and not self._has_identity):
            return ""
        if self.path.exists() or self.path.is_symlink():
            return "was replaced by another file"
        if self._file.name_again(self.path):
            self.renamed = True
            return ""
        return "was deleted or renamed, or its folder is gone,"

    def _damage(self) -> str:
        size = self._file.size()
        if size < self._least_bytes:
            return f"was truncated to {size} of {self._least_bytes} bytes"
        whole = zlib.crc32(self._file.read(0, self._head_bytes)) == self._head_crc
        return "" if whole else "was overwritten in its header"

    @contextmanager
    def _rescuing(self, under_way: Replacement | None) -> Iterator[None]:
        """Keep what a lost file still holds, and the position under way, under another name."""
        try:
            yield
        except FileLostError as lost:
            failures = []
            for place in self._other_folders():
                name = _free_name(place / self.path.name)
                try:
                    kept = self._copy_to(name, under_way)
                except (WavefocusError, OSError) as failure:
                    failures.append(str(failure))
                    continue
                raise FileLostError(
                    f"{lost}; {kept} positions are kept in {name}; rename it to {self.path},"
                    " then go on with wavefocus resume"
                ) from lost
            raise FileLostError(
                f"{lost}; what it still held could not be kept elsewhere: {'; '.join(failures)}"
            ) from lost

    def _other_folders(self) -> Iterator[Path]:
        """The file's own folder, unless that is gone or another one is mounted there; then others."""
        try:
            if os.path.samestat(self.path.parent.stat(), self._folder):
                yield self.path.parent
        except OSError:
            pass
        yield from (Path.cwd(), Path.home(), Path(tempfile.gettempdir()))

    def _copy_to(self, path: Path, under_way: Replacement | None) -> int:
        """Make a file of all rows that are still whole, and of the one being written; return how many."""
        self._create(path, self.header)
        with type(self).open(path) as copy:
            for position in np.flatnonzero(self._measured).tolist():
                if (under_way is None or position != under_way.position) and (row := self._whole_row(position)):
                    copy._write_row(row)
            if under_way is not None:
                copy._write_row(under_way)
        with type(self).open(path) as copy:  # which makes what follows from the rows
            return int(np.count_nonzero(copy._measured))

    def _whole_row(self, position: int) -> Replacement | None:
        """A position as it lies in the file; None where its checksums do not hold."""
        try:
            row = self._row(position)
            offsets = self._layout.chunk_offset[:, position].tolist()
            chunks = tuple(bytes(self._file.read(offset, self._shape.chunk_bytes)) for offset in offsets)
        except OSError:
            return None
        crcs = self._shape.crcs(row, position)
        return Replacement(position, chunks, bytes(row)) if crcs and self._shape.holds(crcs, chunks) else None


def _free_name(path: Path) -> Path:
    number = 1
    while (name := path.with_name(f"{path.stem}.rescue{number if number > 1 else ''}{path.suffix}")).exists():
        number += 1
    return name
