"""A file that one process writes at stated offsets, and what becomes of it when the disk fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self, TypeVar

from calibration import bank_owner, durable, hdf5_safety
from calibration.durable import PositionedFile
from calibration.errors import InputError, WavefocusError
from calibration.workplace import clear_leftovers

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
        """Turn a failure of the disk into one sentence, and let nothing be written after it."""
        if self._failure:
            raise WavefocusError(
                f"{self._kind} {self.path} takes no more commits after an earlier failure ({self._failure})"
            )
        try:
            yield
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

    def close(self) -> None:
        """Sync, take the owner's name away and release the file; closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._failure is None:
                with self.writing("closing"):
                    self._file.sync()
        finally:
            bank_owner.remove_owner(self.path)
            self._file.close()

    def give_up(self) -> None:
        """Release the file as it is, without a sync."""
        if not self._closed:
            self._closed = True
            bank_owner.remove_owner(self.path)
            self._file.close()
