"""Files that note what is written and synced, without a library that is loaded before the program."""

from __future__ import annotations

import io
from pathlib import Path
from typing import ClassVar

from storage.durable import PosixFile
from tests.system.crash.power_cuts import Call, Kind

INODE = 1


class LoggedFile(PosixFile):
    """A file of the program's own that notes its writes and barriers."""

    log: ClassVar[list[Call]] = []

    def __init__(self, path: Path, *, write: bool = False) -> None:
        super().__init__(path, write=write)
        self._name = str(path)

    def write(self, offset: int, data: bytes | memoryview) -> None:
        LoggedFile.log.append(Call(Kind.WRITE, self._name, "", offset, INODE, bytes(data)))
        super().write(offset, data)

    def sync(self) -> None:
        LoggedFile.log.append(Call(Kind.SYNC, self._name, "", 0, INODE, b""))


class WithoutSecondBarrier(LoggedFile):
    """Leaves out every second barrier: that after a ledger row."""

    def __init__(self, path: Path, *, write: bool = False) -> None:
        super().__init__(path, write=write)
        self._syncs = 0

    def sync(self) -> None:
        self._syncs += 1
        if self._syncs % 2:
            super().sync()


class WithoutFirstBarrier(WithoutSecondBarrier):
    """Leaves out the barrier between Green's functions and ledger row."""

    def __init__(self, path: Path, *, write: bool = False) -> None:
        super().__init__(path, write=write)
        self._syncs = 1


class LoggedMemory(io.BytesIO):
    """What h5py writes a file of its own into; a flush counts as a barrier, which is more than it is on a disk."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.log: list[Call] = []

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        self.log.append(Call(Kind.WRITE, str(self.path), "", self.tell(), INODE, bytes(data)))
        return super().write(data)

    def truncate(self, size: int | None = None) -> int:
        wanted = self.tell() if size is None else size
        self.log.append(Call(Kind.RESIZE, str(self.path), "", wanted, INODE, b""))
        held = len(self.getvalue())
        if wanted > held:  # BytesIO does not grow
            at = self.tell()
            self.seek(held)
            super().write(bytes(wanted - held))
            self.seek(at)
            return wanted
        return super().truncate(wanted)

    def barrier(self) -> None:
        """Have all that was written on the disk."""
        self.log.append(Call(Kind.SYNC, str(self.path), "", 0, INODE, b""))
