"""A file that one process writes at stated offsets, and what becomes of it when the disk fails."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self, TypeVar

from storage import durable, hdf5_safety
from storage.bank import owner as bank_owner
from storage.durable import PositionedFile
from storage.errors import FileLostError, InputError, WavefocusError
from storage.staging_dir import clear_leftovers

L = TypeVar("L")
W = TypeVar("W")


class OwnedFile:
    """An open file that this process alone writes; made by :meth:`lock`.

    A failed write closes the way for further ones: opening the file again repairs it.
    """

    def __init__(self, path: Path, file: PositionedFile, kind: str) -> None:
        self.path = path
        self._file = file
        self._kind = kind
        self._failure: str | None = None
        self._closed = False
        self._head: tuple[int, int] | None = None
        self._least_bytes = 0
        self.folder = path.parent.stat()
        self.renamed = False
        # Some network drives number a file anew each time it is asked for: there only the name can be watched.
        self._has_identity = file.is_named(path)

    def watch(self, head_bytes: int) -> None:
        """From now on every write first finds the file by its name, of its present size and with its header.

        Parameters
        ----------
        head_bytes : int
            So many bytes from the beginning are never written again.
        """
        self._least_bytes = self._file.size()
        self._head = (head_bytes, zlib.crc32(self.read(0, head_bytes)))

    def require_place(self) -> None:
        """Find the file by its name; one that was renamed gets its name back where the platform can do so.

        Raises
        ------
        FileLostError
            It was deleted, renamed, replaced, truncated or overwritten, or its folder is gone.
        """
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
        if self._head is None:
            return ""
        size = self._file.size()
        if size < self._least_bytes:
            return f"was truncated to {size} of {self._least_bytes} bytes"
        head_bytes, crc = self._head
        return "" if zlib.crc32(self.read(0, head_bytes)) == crc else "was overwritten in its header"

    @classmethod
    def lock(cls, path: Path, kind: str, open_file: durable.OpenFile = durable.open_file) -> Self:
        """Own a file until it is closed.

        Parameters
        ----------
        path : Path
            The file.
        kind : str
            What it is called in messages, as ``"bank"``.
        open_file : durable.OpenFile
            How the file is opened.

        Raises
        ------
        InputError
            When it is missing, no regular file, a link, or may not be written.
        BankBusyError
            When another process owns it.
        """
        if path.is_symlink():
            raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the {kind} file itself")
        hdf5_safety.require_regular(path)
        clear_leftovers(path)
        try:
            file = open_file(path, write=True)
        except OSError as error:
            raise InputError(f"{path} may not be written: {error.strerror}") from error
        try:
            bank_owner.take_ownership(path, file, kind)
        except BaseException:
            file.close()
            raise
        return cls(path, file, kind)

    @classmethod
    def bring_into_order(
        cls, path: Path, kind: str, open_file: durable.OpenFile, read: Callable[[], L], make: Callable[[Self, L], W]
    ) -> W:
        """Own a file, read how it is laid out, and only then name this process beside it and repair it.

        Parameters
        ----------
        path, kind, open_file
            As :meth:`lock`.
        read : callable
            Reads the layout; what it raises leaves the file untouched.
        make : callable
            From the owned file and its layout to what writes it; repairs what a crash left.

        Raises
        ------
        InputError, BankBusyError, WavefocusError
            As :meth:`lock`, and as `read` and `make` do; the file is released.
        """
        file = cls.lock(path, kind, open_file)
        try:
            layout = read()
            bank_owner.write_owner(path)  # for people who meet the lock
            return make(file, layout)
        except BaseException:
            file.give_up()
            raise

    @contextmanager
    def writing(self, what: str) -> Iterator[None]:
        """Turn a failure of the disk into one sentence, and let nothing be written after it.

        Raises
        ------
        FileLostError
            As `require_place`, before or after the write.
        WavefocusError
            The disk failed, now or earlier.
        """
        if self._failure:
            raise WavefocusError(
                f"{self._kind} {self.path} takes no more commits after an earlier failure ({self._failure})"
            )
        try:
            self.require_place()
            yield
            self.require_place()
        except OSError as error:
            # After a failed sync the kernel may drop what it could not write: nothing in flight can be
            # trusted.
            self._failure = f"{what}: {error.strerror or error}"
            raise WavefocusError(
                f"{self._kind} {self.path}: {self._failure}; what was measured before is safe; "
                "make the disk writable and resume"
            ) from error

    def read(self, offset: int, size: int) -> bytearray:
        """Read bytes."""
        content = bytearray(size)
        self.read_into(offset, memoryview(content))
        return content

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill a buffer."""
        self._file.read_into(offset, buffer)

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Write bytes."""
        self._file.write(offset, data)

    def sync(self) -> None:
        """Return when all that was written is on the disk."""
        self._file.sync()

    def finish(self) -> None:
        """Sync, and find the file in its place once more; nothing after a failure.

        Raises
        ------
        FileLostError, WavefocusError
            As `writing`.
        """
        if self._failure is None and not self._closed:
            with self.writing("closing"):
                self._file.sync()

    def close(self) -> None:
        """Finish, take the owner's name away and release the file; closing twice does nothing."""
        try:
            self.finish()
        finally:
            self.give_up()

    def give_up(self) -> None:
        """Release the file as it is, without a sync."""
        if not self._closed:
            self._closed = True
            if self._file.is_named(self.path) or not self.path.exists():  # else another process may own it
                bank_owner.remove_owner(self.path)
            self._file.close()
