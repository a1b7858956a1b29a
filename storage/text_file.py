"""Small text files that people write: read whole, with errors in one line."""

from __future__ import annotations

from pathlib import Path

from wavefocus.storage.errors import InputError

LARGEST_BYTES = 16 * 2**20
"""More than any position list or configuration needs; beyond it the wrong file was named."""


def read_text(path: Path) -> str:
    """Read a UTF-8 text file, with or without a byte-order mark.

    path: The file; at most `LARGEST_BYTES` long.

    Raises InputError: the file is missing, not a regular file, not readable, too large or not UTF-8.
    """
    try:
        if not path.exists():
            raise InputError(f"{path}: no such file")
        if path.is_dir():
            raise InputError(f"{path}: is a folder; a text file is needed")
        if not path.is_file():  # a pipe or a device could block for ever or never end
            raise InputError(f"{path}: is not a regular file; a text file is needed")
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise InputError(f"{path}: has {size} bytes; at most {LARGEST_BYTES} are read")
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
