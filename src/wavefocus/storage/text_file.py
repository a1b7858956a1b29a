"""Regular files, sound files and small text files that people write: whole ones are read, with errors in one line."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from wavefocus.storage.errors import InputError

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""HDF5 file format specification, version 3.0, section II.A: the first bytes of a file without a user block."""

MAX_BYTES = 16 * 2**20
"""More than any position list or configuration needs; beyond it the wrong file was named."""


def read_text(path: Path) -> str:
    """Read a UTF-8 text file, with or without a byte-order mark.

    path: The file; at most `MAX_BYTES` long.

    Raises InputError: the file is missing, not a regular file, not readable, too large or not UTF-8.
    """
    try:
        if not path.is_file():  # a pipe or a device could block for ever or never end
            what = "is a folder" if path.is_dir() else "is not a regular file" if path.exists() else "no such file"
            raise InputError(f"{path}: {what}; a text file is needed")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(f"{path}: has {size} bytes; at most {MAX_BYTES} are read")
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValueError as error:  # a path that no file can have, such as one with a null byte
        if isinstance(error, InputError):
            raise
        raise InputError(f"{str(path)!r}: cannot be a file name: {error}") from None
    try:
        return content.decode("utf-8-sig")  # Windows editors put a byte-order mark in front
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{path}: line {line}: not UTF-8 text; save the file as UTF-8") from None


def require_regular(path: Path) -> None:
    """Refuse a path that is missing or not a regular file; raises InputError."""
    if not path.exists():
        raise InputError(f"{path} does not exist")
    if not path.is_file():
        raise InputError(f"{path} is not a regular file")


def permission_words(path: Path) -> str:
    """Whose file it is that this user may not use, and what to do; empty where the system does not say."""
    try:
        maker = path.owner()
    except (OSError, KeyError, NotImplementedError):
        return ""
    return f"; it belongs to user {maker}: ask for chmod a+rw {path.name}, or name another folder"


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; a pipe or a device, which could block for ever, is not waited for.

    Raises OSError: it is missing, cannot be read or is not a regular file.
    """
    # O_NONBLOCK and O_BINARY: each exists only where it is needed. A pipe without a writer opens at once, then.
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_regular(path: Path) -> bytes:
    """A regular file's whole content; raises OSError as `open_regular`."""
    with open_regular(path) as file:
        return file.read()


def require_whole_sound(path: Path) -> None:
    """Refuse a WAV file that is shorter than it says, which libraries read as far as it goes.

    The size stands in bytes 4 to 7 (RIFF WAVE, 1991). Programs that do not know it beforehand write 0 or about the
    largest one, and some leave out the byte that makes it even.

    Raises InputError: it was cut off, is missing, cannot be read or is not a regular file.
    """
    try:
        with open_regular(path) as file:
            head, held = file.read(8), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read as a sound file: {error.strerror or error}") from None
    declared = int.from_bytes(head[4:], "little") + 8
    if head.startswith(b"RIFF") and held + 1 < declared < 0x7FFF0000:
        raise InputError(f"{path} is truncated: it holds {held} of {declared} bytes; restore a copy")
