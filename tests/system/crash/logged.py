"""Files that note what is written and synced, without a library that is loaded before the program."""

from typing import ClassVar

from tests.system.crash.power_cuts import Call, Kind
from wavefocus.storage.durable import PosixFile

INODE = 1


class LoggedFile(PosixFile):
    """A file of the program's own that notes its writes and barriers."""

    log: ClassVar[list[Call]] = []

    def __init__(self, path, *, write=False):
        super().__init__(path, write=write)
        self._name = str(path)

    def write(self, offset, data):
        LoggedFile.log.append(Call(Kind.WRITE, self._name, "", offset, INODE, bytes(data)))
        super().write(offset, data)

    def sync(self):
        LoggedFile.log.append(Call(Kind.SYNC, self._name, "", 0, INODE, b""))


class WithoutSecondBarrier(LoggedFile):
    """Leaves out every second barrier: that after a ledger row."""

    def __init__(self, path, *, write=False):
        super().__init__(path, write=write)
        self._syncs = 0

    def sync(self):
        self._syncs += 1
        if self._syncs % 2:
            super().sync()


class WithoutFirstBarrier(WithoutSecondBarrier):
    """Leaves out the barrier between Green's functions and ledger row."""

    def __init__(self, path, *, write=False):
        super().__init__(path, write=write)
        self._syncs = 1
