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
    """Refuse a sound file that is shorter than its header says, which libraries read as far as it goes.

    WAV (RIFF WAVE, 1991), RF64 (EBU Tech 3306), Wave64, AIFF (1.3, and AIFF-C) and AU state a size. Programs that do
    not know it beforehand write 0 or about the largest one; some leave out padding, or count the first 8 bytes twice.

    Raises InputError: it was cut off, is missing, cannot be read or is not a regular file.
    """
    try:
        with open_regular(path) as file:
            head, held = file.read(28), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise InputError(f"{path} cannot be read as a sound file: {error.strerror or error}") from None
    allowed, unknown = 8, 1 << 62  # bytes that may be missing; sizes from here on mean nothing
    match head[:4]:
        case b"RIFF":
            declared, allowed, unknown = int.from_bytes(head[4:8], "little") + 8, 1, 0x7FFF0000
        case b"RIFX" | b"FORM":  # SoX writes 0x7F000000, in whole frames, where it does not know the size of an AIFF
            declared, unknown = int.from_bytes(head[4:8], "big") + 8, 0x7EFF0000
        case b"RF64" if head[4:8] == b"\xff\xff\xff\xff" and head[12:16] == b"ds64":
            declared = int.from_bytes(head[20:28], "little") + 8
        case b"riff":  # Wave64: the size of the whole file
            declared = int.from_bytes(head[16:24], "little")
        case b".snd":
            declared, unknown = int.from_bytes(head[4:8], "big") + int.from_bytes(head[8:12], "big"), 0x7FFF0000
        case _:
            return
    if held + allowed < declared < unknown:
        raise InputError(f"{path} is truncated: it holds {held} of {declared} bytes; restore a copy")
