"""Writing that survives a crash: the one module that knows which calls a platform has.

Two implementations stand behind :class:`PositionedFile`: :class:`PosixFile` with the calls that Linux and
macOS offer, and :class:`PortableFile` with what Python has everywhere.
"""

from __future__ import annotations

import errno
import io
import os
import sys
import threading
import weakref
from pathlib import Path
from typing import Protocol

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

PAGE = 4096
# A byte that no file reaches: Windows locks are mandatory, and readers must not meet them.
_FAR_BYTE = 1 << 62
_COPY_BYTES = 1 << 20


class PositionedFile(Protocol):
    """An open file that is read and written at stated offsets, unbuffered; failures are ``OSError``."""

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill all of ``buffer`` from byte ``offset`` on."""

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Write all of ``data`` from byte ``offset`` on."""

    def sync(self) -> None:
        """Return when all that was written is on the disk."""

    def reserve(self, size: int) -> None:
        """Claim disk space for ``size`` bytes; what the file holds stays."""

    def size(self) -> int:
        """Bytes in the file."""

    def is_named(self, path: Path) -> bool:
        """Tell whether a path leads to this very file."""

    def name_again(self, path: Path) -> bool:
        """Give a file that was renamed a free name as well; False where that is not possible."""

    def try_lock(self) -> bool:
        """Become the one owner until closed; False when another process is."""

    def locked_elsewhere(self) -> bool:
        """Tell whether some other open file owns it."""

    def close(self) -> None:
        """Close, and release the lock."""


class PosixFile:
    """A file through ``pread``, ``pwrite``, ``fdatasync``, ``posix_fallocate`` and ``flock``.

    Parameters
    ----------
    path : Path
        An existing file; it is never created and never truncated.
    write : bool
        Whether it is opened for writing.
    """

    def __init__(self, path: Path, *, write: bool = False) -> None:
        self._fd = os.open(path, os.O_RDWR if write else os.O_RDONLY)

    if sys.platform != "win32":

        def read_into(self, offset: int, buffer: memoryview) -> None:
            view = buffer.cast("B")
            while view:
                if hasattr(os, "preadv"):
                    count = os.preadv(self._fd, [view], offset)
                else:
                    part = os.pread(self._fd, len(view), offset)
                    count = len(part)
                    view[:count] = part
                if count == 0:
                    raise _short_file(offset)
                view, offset = view[count:], offset + count

        def write(self, offset: int, data: bytes | memoryview) -> None:
            view = memoryview(data).cast("B")
            while view:
                count = os.pwrite(self._fd, view, offset)
                view, offset = view[count:], offset + count

    def try_lock(self) -> bool:
        locked = _lock_open_file(self._fd, exclusive=True)
        if locked:
            _locked_files.add(self)
        return locked

    def locked_elsewhere(self) -> bool:
        if not _lock_open_file(self._fd, exclusive=False):
            return True
        _unlock_open_file(self._fd)
        return False

    def sync(self) -> None:
        _sync_data(self._fd)

    def reserve(self, size: int) -> None:
        if not hasattr(os, "posix_fallocate"):  # macOS
            _reserve_by_rewriting(self, size)
            return
        try:
            os.posix_fallocate(self._fd, 0, size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL):
                raise
            _reserve_by_rewriting(self, size)

    def size(self) -> int:
        return os.fstat(self._fd).st_size

    def is_named(self, path: Path) -> bool:
        return _same_file(path, self._fd)

    def name_again(self, path: Path) -> bool:
        try:
            os.link(Path(f"/proc/self/fd/{self._fd}").readlink(), path)  # where Linux keeps the present name
        except OSError:
            return False
        return self.is_named(path)

    def close(self) -> None:
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


class PortableFile:
    """A file through seek, read and write alone, for platforms without the calls of :class:`PosixFile`.

    Parameters
    ----------
    path : Path
        An existing file; it is never created and never truncated.
    write : bool
        Whether it is opened for writing.
    """

    def __init__(self, path: Path, *, write: bool = False) -> None:
        self._file = io.FileIO(path, "r+" if write else "r")
        self._cursor = threading.Lock()  # seek and read are two steps

    def read_into(self, offset: int, buffer: memoryview) -> None:
        view = buffer.cast("B")
        with self._cursor:
            self._file.seek(offset)
            while view:
                count = self._file.readinto(view)
                if not count:
                    raise _short_file(offset)
                view = view[count:]

    def write(self, offset: int, data: bytes | memoryview) -> None:
        view = memoryview(data).cast("B")
        with self._cursor:
            self._file.seek(offset)
            while view:
                view = view[self._file.write(view) or 0 :]

    def sync(self) -> None:
        os.fsync(self._file.fileno())

    def reserve(self, size: int) -> None:
        _reserve_by_rewriting(self, size)

    def size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def is_named(self, path: Path) -> bool:
        return _same_file(path, self._file.fileno())

    def name_again(self, path: Path) -> bool:
        return False  # Windows keeps an open file from being renamed

    def try_lock(self) -> bool:
        locked = _lock_open_file(self._file.fileno(), exclusive=True)
        if locked:
            _locked_files.add(self)
        return locked

    def locked_elsewhere(self) -> bool:
        if not _lock_open_file(self._file.fileno(), exclusive=False):
            return True
        _unlock_open_file(self._file.fileno())
        return False

    def close(self) -> None:
        self._file.close()


_locked_files: weakref.WeakSet[PosixFile | PortableFile] = weakref.WeakSet()


def _close_in_forked_child() -> None:
    # A forked child shares the lock, and would keep it when its parent is killed.
    for file in list(_locked_files):
        file.close()
    _locked_files.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_forked_child)


def open_file(path: Path, *, write: bool = False) -> PositionedFile:
    """Open an existing file with the best that this platform has."""
    return PortableFile(path, write=write) if sys.platform == "win32" else PosixFile(path, write=write)


class OpenFile(Protocol):
    """Opens an existing file at stated offsets; what tests use to watch or break writes."""

    def __call__(self, path: Path, *, write: bool = False) -> PositionedFile:
        """Open ``path``, for writing too when asked."""


def publish_new(temporary: Path, final: Path) -> None:
    """Give a finished, synced temporary file its name, and never replace a file of that name.

    Raises
    ------
    FileExistsError
        When ``final`` exists; both files stay as they are.
    """
    try:
        publish_by_link(temporary, final)
    except FileExistsError:
        raise
    except (OSError, AttributeError, NotImplementedError):  # exFAT, some network drives
        publish_by_claim(temporary, final)
    sync_folder(final.parent)


def publish_by_link(temporary: Path, final: Path) -> None:
    """Name a file by a hard link, in one step."""
    os.link(temporary, final)
    temporary.unlink()


def publish_by_claim(temporary: Path, final: Path) -> None:
    """Name a file where there are no hard links: claim the name with an empty file, then replace that."""
    os.close(os.open(final, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    temporary.replace(final)


def sync_path(path: Path) -> None:
    """Return when a closed file's bytes are on the disk."""
    file = open_file(path, write=True)
    try:
        file.sync()
    finally:
        file.close()


def sync_folder(folder: Path) -> None:
    """Return when the names in a folder are on the disk; Windows has no such call and needs none."""
    if sys.platform == "win32":
        return
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EBADF, errno.ENOTSUP):  # file systems without it
            raise
    finally:
        os.close(fd)


def _same_file(path: Path, fd: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(fd))
    except OSError:
        return False


def _sync_data(fd: int) -> None:
    if sys.platform == "darwin":
        # fsync on macOS stops at the drive's own cache (fsync(2), macOS manual page).
        try:
            fcntl.fcntl(fd, fcntl.F_FULLFSYNC)
        except OSError:
            os.fsync(fd)
    elif hasattr(os, "fdatasync"):
        os.fdatasync(fd)
    else:
        os.fsync(fd)


def _reserve_by_rewriting(file: PosixFile | PortableFile, size: int) -> None:
    """Write back what each block holds: where the file had holes, zeros now take space."""
    held = file.size()
    for offset in range(0, size, _COPY_BYTES):
        block = bytearray(min(_COPY_BYTES, size - offset))
        readable = max(0, min(len(block), held - offset))
        if readable:
            file.read_into(offset, memoryview(block)[:readable])
        file.write(offset, memoryview(block))


def _lock_open_file(fd: int, *, exclusive: bool) -> bool:
    """Lock an open file; never by ``lockf``, whose lock is lost as soon as HDF5 reads the same file."""
    try:
        if sys.platform == "win32":
            os.lseek(fd, _FAR_BYTE, os.SEEK_SET)
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(fd, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
            raise
        return False
    return True


def _unlock_open_file(fd: int) -> None:
    if sys.platform == "win32":
        os.lseek(fd, _FAR_BYTE, os.SEEK_SET)
        msvcrt.locking(fd, msvcrt.LK_UNLCK, 1)
    else:
        fcntl.flock(fd, fcntl.LOCK_UN)


def _short_file(offset: int) -> OSError:
    return OSError(errno.EIO, f"the file ends before byte {offset}")
