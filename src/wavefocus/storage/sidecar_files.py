"""Small files and hidden folders next to a bank, written by name: never through links, never over a foreign file.

The maker locks a file named `owner` in its folder for as long as it lives, makes it before anything else there and
removes it after everything else. A folder whose `owner` nobody locks was left behind.
"""

import contextlib
import errno
import glob
import io
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

from wavefocus.storage import durable
from wavefocus.storage.durable import PositionedFile
from wavefocus.storage.text_file import open_regular

# What only POSIX has; Windows opens no links unasked.
_NOT_THROUGH_LINKS = getattr(os, "O_NOFOLLOW", 0)
_NOT_WAITING = getattr(os, "O_NONBLOCK", 0)
_BINARY = getattr(os, "O_BINARY", 0)
_SECTOR_BYTES = 512
_SECOND_LINE = b'\n{"at": "'


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

    What a power cut left of a last line is ended by the first line that is written after it.

    A name that is a link, no regular file, or a file that holds something else is left alone: each write fails then.

    Raises OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._file: io.FileIO | None = None
        self._torn = False
        flags = os.O_CREAT | os.O_APPEND | os.O_WRONLY | _NOT_THROUGH_LINKS | _NOT_WAITING | _BINARY
        try:
            file = io.FileIO(os.open(path, flags, 0o666), "a")
        except OSError as error:
            if error.errno not in (errno.ELOOP, errno.EMLINK, errno.ENXIO):  # a link; a pipe without a reader
                raise
            return
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode) and _begins_as_ours(path):
            self._file = file
            self._torn = _ends_within_line(path)
        else:
            file.close()

    def write(self, line: str) -> None:
        """Append a line with its end.

        Raises OSError: it cannot be written.
        """
        if self._file is None:
            raise OSError(errno.EEXIST, "it is a link or a file of another program")
        # As one write, for another process may append, too; a blank line from both of them does no harm.
        content, self._torn = b"\n" * self._torn + line.encode(), False
        self._file.write(content)

    def close(self) -> None:
        """Close it."""
        if self._file is not None:
            self._file.close()


def _begins_as_ours(path: Path) -> bool:
    try:
        with open_regular(path) as file:
            begin = file.read(_SECTOR_BYTES + len(_SECOND_LINE))
        if begin[:1] in (b"", b"{", b"\0"):
            return True
        begin.decode()
    except FileNotFoundError:  # removed since
        return True
    except PermissionError:  # another user's
        return False
    except UnicodeDecodeError:
        return len(begin) <= _SECTOR_BYTES or _SECOND_LINE in begin  # a log goes on after its sector of garbage
    return False


def _ends_within_line(path: Path) -> bool:
    with contextlib.suppress(OSError), open_regular(path) as file:  # OSError: it is empty
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"
    return False


_OWNER = "owner"
_PREVIOUS = "previous"
_COMPLETE = b"complete"
_TRIES = 10


class StagingDir:
    """A hidden folder next to `path`, its maker's alone until :func:`staging_dir` ends."""

    def __init__(self, path: Path, folder: Path, owner: PositionedFile) -> None:
        self.temporary = folder / path.name
        self._path = path
        self._previous = folder / _PREVIOUS
        self._owner = owner

    def complete(self) -> None:
        """Note that the temporary file is whole and on the disk, and only lacks its name."""
        self._owner.write(0, _COMPLETE)
        self._owner.sync()

    def publish(self) -> None:
        """Give the synced temporary file its name; after an OSError an older file of that name is there as before."""
        durable.sync_folder(self._path.parent)
        with contextlib.suppress(OSError, NotImplementedError):  # no older file, or no hard links
            os.link(self._path, self._previous, follow_symlinks=False)
        self.temporary.replace(self._path)
        try:
            durable.sync_folder(self._path.parent)
        except OSError:
            if self._previous.exists():
                self._previous.replace(self._path)
            raise

    def publish_files(self, last: str, owned: Collection[str]) -> None:
        """Move the files of a synced temporary folder into the folder around it, where older ones make way.

        An older file named `last` goes first and the new one comes last, so that it never stands among files of
        another making, also where this ends halfway.

        owned: Names of older files that go, too.

        Raises OSError: the files cannot be moved.
        """
        folder = self._path.parent
        for name in (last, *owned):
            (folder / name).unlink(missing_ok=True)
        durable.sync_folder(folder)  # a power cut keeps no older record beside newer files
        for file in sorted(self.temporary.iterdir(), key=lambda file: (file.name == last, file.name)):
            if file.name == last:
                durable.sync_folder(folder)
            file.replace(folder / file.name)
        durable.sync_folder(folder)

    def publish_folder(self) -> None:
        """Give a synced temporary folder its name; an older folder of that name is removed with the staging folder."""
        self.complete()  # killed between the two renames, the next command finishes the second
        if self._path.exists():
            self._path.replace(self._previous)
        try:
            self.temporary.replace(self._path)
        except OSError:
            if self._previous.exists():
                self._previous.replace(self._path)
            raise
        durable.sync_folder(self._path.parent)


@contextlib.contextmanager
def staging_dir(path: Path) -> Iterator[StagingDir]:
    """Make a hidden folder next to `path` to make it in; it is gone afterwards. OSError where it cannot be made."""
    folder, owner = _new_folder(path)
    try:
        yield StagingDir(path, folder, owner)
    finally:
        _clear(folder, path.name, owner)


def clear_leftovers(folder: Path, only: str = "*") -> None:
    """Remove the hidden folders of makers that were killed, and finish what they all but finished.

    A folder whose maker lives, or that holds anything else, stays as it is.

    folder: Where the files belong.
    only: Name of the one file whose makers are meant; by default those of any.
    """
    pattern = "*" if only == "*" else glob.escape(only)
    for leftover in sorted(folder.glob(f".{pattern}.*.partial")):
        name = leftover.name[1:].removesuffix(".partial").rpartition(".")[0]
        # What cannot be removed costs nothing but its space.
        with contextlib.suppress(OSError):
            if only in ("*", name) and not leftover.is_symlink():
                _clear_leftover(leftover, folder / name)


def _new_folder(path: Path) -> tuple[Path, PositionedFile]:
    for _ in range(_TRIES):
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".partial", dir=path.parent))
        try:
            owner = _claim(folder / _OWNER)
        except FileNotFoundError:
            continue
        except BaseException:
            with contextlib.suppress(OSError):
                (folder / _OWNER).unlink(missing_ok=True)
                folder.rmdir()
            raise
        if owner is not None:
            return folder, owner
    raise OSError(f"another process removes what is made next to {path}")


def _claim(name: Path) -> PositionedFile | None:
    """Lock a folder's owner file; None when the folder was taken for a leftover before it was locked."""
    name.touch(0o600, exist_ok=False)
    owner = durable.PositionedFile(name, write=True)
    if owner.try_lock() and name.exists():
        return owner
    owner.close()
    return None


def _clear_leftover(folder: Path, path: Path) -> None:
    names = {entry.name for entry in folder.iterdir()}
    if not all(_is_ours(name, path.name) for name in names):
        return
    if _OWNER not in names:
        if not names:
            folder.rmdir()  # should its maker live, it makes another
        elif not (folder / _OWNER).exists():  # of two names that were not synced, power cuts may keep either
            _clear(folder, path.name, None)
        return
    owner = durable.PositionedFile(folder / _OWNER, write=True)
    if not owner.try_lock():
        owner.close()
        return
    _finish(folder, path, owner)
    _clear(folder, path.name, owner)


def _finish(folder: Path, path: Path, owner: PositionedFile) -> None:
    """Give a complete file or folder the name that its maker had claimed, or had just taken from an older folder."""
    if owner.size() != len(_COMPLETE) or not (folder / path.name).exists():
        return
    claimed = path.is_file() and path.stat().st_size == 0
    taken = (folder / _PREVIOUS).is_dir() and not os.path.lexists(path)
    if (claimed or taken) and owner.read(0, len(_COMPLETE)) == _COMPLETE:
        (folder / path.name).replace(path)
        durable.sync_folder(path.parent)


def _clear(folder: Path, name: str, owner: PositionedFile | None) -> None:
    """Remove a folder, its owner's file last."""
    try:
        # Once its owner's file is gone, another process may take the folder for a leftover and remove it first.
        with contextlib.suppress(FileNotFoundError):
            for left in folder.iterdir():
                if left.name == _OWNER or not _is_ours(left.name, name):
                    continue
                if left.is_dir() and not left.is_symlink():
                    shutil.rmtree(left)
                else:
                    left.unlink()
            if sys.platform == "win32" and owner is not None:  # no file is removed there while it is open
                owner.close()
            (folder / _OWNER).unlink(missing_ok=True)
            folder.rmdir()
    finally:
        if owner is not None:
            owner.close()


def _is_ours(name: str, made: str) -> bool:
    """Whether a maker's folder holds files of this name; libraries add endings to the one that is made."""
    return name in {_OWNER, _PREVIOUS, "last"} or name.startswith(made)  # "last" is of earlier versions
