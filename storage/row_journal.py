"""The place in a file where a row that replaces an older one stands until it is in."""

from __future__ import annotations

from storage.owned_file import OwnedFile


class RowJournal:
    """One entry, or nothing: zeros.

    Parameters
    ----------
    file : OwnedFile
        Where it stands.
    offset, size : int
        Where in the file, in bytes.
    """

    def __init__(self, file: OwnedFile, offset: int, size: int) -> None:
        self._file = file
        self._offset = offset
        self._size = size

    def entry(self) -> bytearray | None:
        """What stands there, whole or torn; None for nothing."""
        content = self._file.read(self._offset, self._size)
        return None if content.count(0) == self._size else content

    def keep(self, entry: bytes) -> None:
        """Write an entry; when this returns, no crash loses it."""
        self._file.write(self._offset, entry)
        self._file.sync()

    def clear(self) -> None:
        """Forget the entry for good."""
        self._file.write(self._offset, bytes(self._size))
        self._file.sync()
