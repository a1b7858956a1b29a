"""A file in memory that holds what was written and nothing for what was not."""

from __future__ import annotations

import io
from collections.abc import Iterator

from storage.durable import PAGE


class SparseMemory(io.RawIOBase):
    """A seekable file whose unwritten pages read as zeros and take no memory.

    HDF5 lays files out here and never on the disk: when a disk fails under it, it loses what it could not write
    without a word, or ends the process (HDF5 2.0 through h5py 3.16).
    """

    def __init__(self) -> None:
        super().__init__()
        self.size = 0
        self._at = 0
        self._pages: dict[int, bytearray] = {}

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence]
        self._at = start + offset
        return self._at

    def truncate(self, size: int | None = None) -> int:
        self.size = self._at if size is None else size
        return self.size

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self.size - self._at))
        view[:count] = self.content(self._at, count)
        self._at += count
        return count

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view):
            page, start = divmod(self._at, PAGE)
            part = view[done : done + PAGE - start]
            self._pages.setdefault(page, bytearray(PAGE))[start : start + len(part)] = part
            done += len(part)
            self._at += len(part)
        self.size = max(self.size, self._at)
        return done

    def content(self, offset: int, size: int) -> bytes:
        """Return bytes from `offset` on; past the end they are zeros."""
        first, last = offset // PAGE, -(-(offset + size) // PAGE)
        pages = b"".join(self._pages.get(page) or bytes(PAGE) for page in range(first, last))
        return pages[offset - first * PAGE :][:size]

    def written(self) -> Iterator[tuple[int, bytes]]:
        """Yield (offset, page) of every page that was written, in order, none past the end."""
        for page in sorted(self._pages):
            if page * PAGE < self.size:
                yield page * PAGE, bytes(self._pages[page][: self.size - page * PAGE])
