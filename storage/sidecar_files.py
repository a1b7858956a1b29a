"""Small files beside a bank, written by name: never through links and never over a file of somebody else."""

from __future__ import annotations

import errno
import io
import os
import stat
from pathlib import Path

# What only POSIX has; Windows opens no links unasked.
_NOT_THROUGH_LINKS = getattr(os, "O_NOFOLLOW", 0)
_NOT_WAITING = getattr(os, "O_NONBLOCK", 0)
_BINARY = getattr(os, "O_BINARY", 0)
_SECTOR_BYTES = 512


def is_replaceable(path: Path) -> bool:
    """Whether a name is free, a link, or a file that begins as this program's own do: with an object of JSON.

    A power cut may leave it empty, with zeros at its beginning, or as one sector of garbage.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return True
    return stat.S_ISLNK(mode) or (stat.S_ISREG(mode) and _begins_as_ours(path))


def create(path: Path) -> io.FileIO:
    """Create a file for writing under a name that is free, readable as the umask allows.

    Raises OSError: something of that name exists, a link included, or it cannot be made.
    """
    return io.FileIO(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | _NOT_THROUGH_LINKS | _BINARY, 0o666), "w")


class Log:
    """A log of lines that are appended, unbuffered; made where missing.

    A name that is a link, no regular file, or a file that holds something else is left alone: each write fails then.

    Raises OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file: io.FileIO | None = None
        flags = os.O_CREAT | os.O_APPEND | os.O_WRONLY | _NOT_THROUGH_LINKS | _NOT_WAITING | _BINARY
        try:
            file = io.FileIO(os.open(path, flags, 0o666), "a")
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EMLINK, errno.ENXIO):  # a link; a pipe without a reader
                raise
            return
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode) and _begins_as_ours(path):
            self._file = file
        else:
            file.close()

    def write(self, line: str) -> None:
        """Append a line with its end.

        Raises OSError: it cannot be written.
        """
        if self._file is None:
            raise OSError(errno.EEXIST, "it is a link or a file of another program")
        self._file.write(line.encode())

    def close(self) -> None:
        """Close it."""
        if self._file is not None:
            self._file.close()


def _begins_as_ours(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            begin = file.read(_SECTOR_BYTES + 1)
        if begin[:1] in (b"", b"{", b"\0"):
            return True
        begin.decode()
    except FileNotFoundError:  # removed since
        return True
    except UnicodeDecodeError:
        return len(begin) <= _SECTOR_BYTES
    return False
