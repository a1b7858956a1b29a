"""HDF5 files written through this program's own calls, so that a failing disk ends in an error.

When a disk fails under HDF5, it loses data without an error or ends the process (HDF5 2.0 through h5py 3.16).
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from storage import durable
from storage.durable import PositionedFile
from storage.labelled_hdf5 import LIBVER

# Object headers, attributes and dimension scales.
_METADATA_BYTES = 1 << 16


@contextmanager
def created(path: Path, data_bytes: int) -> Iterator[h5py.File]:
    """Make an HDF5 file whose space is reserved before anything is written.

    Parameters
    ----------
    path : Path
        A file that does not exist.
    data_bytes : int
        Bytes of all datasets together.

    Raises
    ------
    OSError
        There is no room, or the disk failed; the file is of no use then.
    """
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    disk = durable.open_file(path, write=True)
    try:
        disk.reserve(data_bytes + _METADATA_BYTES)
        target = _Target(disk)
        try:
            with h5py.File(target, "w", libver=LIBVER) as file:
                yield file
        finally:
            if target.failure is not None:
                raise target.failure
    finally:
        disk.close()
    os.truncate(path, target.size)


class _Target(io.RawIOBase):
    """A file for HDF5 that keeps the first failure in `failure` and goes on, for HDF5 does not survive one."""

    def __init__(self, disk: PositionedFile) -> None:
        super().__init__()
        self.size = 0
        self.failure: OSError | None = None
        self._disk = disk
        self._at = 0

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence] + offset
        return self._at

    def truncate(self, size: int | None = None) -> int:
        self.size = self._at if size is None else size
        try:
            if self.size > self._disk.size():  # what HDF5 has not written yet reads as zeros
                self._disk.write(self.size - 1, b"\0")
        except OSError as error:
            self.failure = self.failure or error
        return self.size

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self.size - self._at))
        try:
            self._disk.read_into(self._at, view[:count])
        except OSError as error:
            self.failure = self.failure or error
            view[:count] = bytes(count)
        self._at += count
        return count

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        view = memoryview(data).cast("B")
        try:
            self._disk.write(self._at, view)
        except OSError as error:
            self.failure = self.failure or error
        self._at += len(view)
        self.size = max(self.size, self._at)
        return len(view)
