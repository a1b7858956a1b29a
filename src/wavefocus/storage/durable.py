"""Files read and written at stated offsets, names that survive a power cut: the calls that a platform has."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Self

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

PAGE = 4096
# A byte that no file reaches: Windows locks are mandatory, and readers must not meet them.
_FAR_BYTE = 1 << 62
_COPY_BYTES = 1 << 20
_NETWORK_TYPES = frozenset({
    "9p", "afs", "beegfs", "ceph", "cifs", "davfs", "fuse.ceph", "fuse.davfs", "fuse.glusterfs", "fuse.rclone",
    "fuse.sshfs", "glusterfs", "lustre", "ncpfs", "nfs", "nfs4", "smb3", "smbfs", "virtiofs",
})  # fmt: skip


class Closing:
    """A context manager that calls its own `close`."""

    __slots__ = ()

    def close(self) -> None:
        """Release what is open."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class PositionedFile(Closing):
    """An open file that is read and written at stated offsets, unbuffered; failures are ``OSError``; a context manager.

    path: An existing file; it is never created and never truncated.
    write: Whether it is opened for writing.
    """

    def __init__(self, path: Path, *, write: bool = False) -> None:
        self._path = path
        self._fd = os.open(path, (os.O_RDWR if write else os.O_RDONLY) | getattr(os, "O_BINARY", 0))
        self._cursor = threading.Lock()  # where seek and read are two steps

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill all of ``buffer`` from byte ``offset`` on."""
        view = buffer.cast("B")
        while view:
            if hasattr(os, "preadv"):
                count = os.preadv(self._fd, [view], offset)
            else:
                with self._cursor:
                    os.lseek(self._fd, offset, os.SEEK_SET)
                    part = os.read(self._fd, len(view))
                count = len(part)
                view[:count] = part
            if count == 0:
                raise OSError(errno.EIO, f"the file ends before byte {offset}")
            view, offset = view[count:], offset + count

    def read(self, offset: int, size: int) -> bytearray:
        """Read ``size`` bytes from byte ``offset`` on."""
        content = bytearray(size)
        self.read_into(offset, memoryview(content))
        return content

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Write all of ``data`` from byte ``offset`` on."""
        view = memoryview(data).cast("B")
        while view:
            if hasattr(os, "pwrite"):
                count = os.pwrite(self._fd, view, offset)
            else:
                with self._cursor:
                    os.lseek(self._fd, offset, os.SEEK_SET)
                    count = os.write(self._fd, view)
            view, offset = view[count:], offset + count

    def sync(self) -> None:
        """Return when all that was written is on the disk."""
        if sys.platform == "darwin":
            # fsync on macOS stops at the drive's own cache (fsync(2), macOS manual page).
            with contextlib.suppress(OSError):
                fcntl.fcntl(self._fd, fcntl.F_FULLFSYNC)
                return
        getattr(os, "fdatasync", os.fsync)(self._fd)

    def reserve(self, size: int) -> None:
        """Claim disk space for ``size`` bytes: holes are filled with zeros, what the file holds stays."""
        if hasattr(os, "posix_fallocate"):  # on Linux
            try:
                os.posix_fallocate(self._fd, 0, size)
            except OSError as error:
                if error.errno not in (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL):
                    raise
            else:
                return
        held = self.size()
        for offset in range(0, size, _COPY_BYTES):
            block = bytearray(min(_COPY_BYTES, size - offset))
            readable = max(0, min(len(block), held - offset))
            if readable:
                self.read_into(offset, memoryview(block)[:readable])
            self.write(offset, memoryview(block))

    def truncate(self, size: int) -> None:
        """Drop what lies beyond ``size`` bytes."""
        os.ftruncate(self._fd, size)

    def size(self) -> int:
        """Bytes in the file."""
        return os.fstat(self._fd).st_size

    def is_named(self, path: Path) -> bool:
        """Whether a path leads to this very file."""
        try:
            return os.path.samestat(path.stat(), os.fstat(self._fd))
        except OSError:
            return False

    def name_again(self, path: Path) -> bool:
        """Give a file that was renamed a free name as well; False where the platform cannot."""
        try:
            os.link(Path(f"/proc/self/fd/{self._fd}").readlink(), path)  # where Linux keeps the present name
        except OSError:
            return False
        return self.is_named(path)

    def try_lock(self) -> bool:
        """Become the one owner until closed; False when another process is."""
        locked = self._lock(exclusive=True)
        if locked:
            _locked_files.add(self)
        return locked

    def locked_elsewhere(self) -> bool:
        """Whether some other open file owns it."""
        if not self._lock(exclusive=False):
            return True
        if sys.platform == "win32":
            os.lseek(self._fd, _FAR_BYTE, os.SEEK_SET)
            msvcrt.locking(self._fd, msvcrt.LK_UNLCK, 1)
        else:
            fcntl.flock(self._fd, fcntl.LOCK_UN)
        return False

    def close(self) -> None:
        """Close, and release the lock."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)

    def _lock(self, *, exclusive: bool) -> bool:
        """Lock the file; never by ``lockf``, whose lock is lost as soon as HDF5 reads the same file."""
        try:
            if sys.platform == "win32":
                os.lseek(self._fd, _FAR_BYTE, os.SEEK_SET)
                msvcrt.locking(self._fd, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._fd, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN, errno.EDEADLK):
                return False
            words = f"{error.strerror}: its drive keeps no locks; use a folder of this computer, or mount it with locks"
            raise OSError(error.errno, words, str(self._path)) from None
        return True


_locked_files: weakref.WeakSet[PositionedFile] = weakref.WeakSet()


def _close_in_forked_child() -> None:
    # A forked child shares the lock, and would keep it when its parent is killed.
    for file in list(_locked_files):
        file.close()
    _locked_files.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_forked_child)


OpenFile = Callable[..., PositionedFile]
"""As `PositionedFile`; tests watch or break writes by another."""


def publish_new(temporary: Path, final: Path) -> None:
    """Give a finished, synced temporary file its name, and never replace a file of that name.

    Raises FileExistsError: when ``final`` exists; both files stay as they are.
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
    final.touch(exist_ok=False)
    temporary.replace(final)


def sync_path(path: Path) -> None:
    """Return when a closed file's bytes are on the disk."""
    with PositionedFile(path, write=True) as file:
        file.sync()


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


def is_network_mount(path: Path) -> bool:
    """Whether a path lies on a network drive, where locks and syncs are unreliable; False without ``/proc/mounts``."""
    mounts = Path("/proc/mounts")
    return mounts.exists() and is_network_mount_in(mounts.read_text(), path.absolute())


def is_network_mount_in(mounts: str, path: Path) -> bool:
    """As :func:`is_network_mount`, for a table in the form of ``/proc/mounts`` (fstab(5))."""
    best, kind = -1, ""
    for line in mounts.splitlines():
        fields = line.split()
        if len(fields) < 3:
            continue
        folder = Path(fields[1].replace("\\040", " "))
        if path.is_relative_to(folder) and len(folder.parts) >= best:
            best, kind = len(folder.parts), fields[2]
    return kind in _NETWORK_TYPES
