"""The hidden folder where a file is made before it has its name, and what a killed maker leaves of it.

The maker locks a file named `owner` in its folder for as long as it lives, makes it before anything else there and
removes it after everything else. A folder whose `owner` nobody locks was left behind.
"""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from storage import durable
from storage.durable import PositionedFile

_OWNER = "owner"
_PREVIOUS = "previous"
_COMPLETE = b"complete"
_TRIES = 10


class Workplace:
    """A hidden folder beside `path`, its maker's alone until :func:`workplace` ends."""

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


@contextlib.contextmanager
def workplace(path: Path) -> Iterator[Workplace]:
    """Have a hidden folder beside `path` to make it in; it is gone afterwards. OSError where it cannot be made."""
    folder, owner = _new_folder(path)
    try:
        yield Workplace(path, folder, owner)
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
    raise OSError(f"another process removes what is made beside {path}")


def _claim(name: Path) -> PositionedFile | None:
    """Lock a folder's owner file; None when the folder was taken for a leftover before it was locked."""
    os.close(os.open(name, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    owner = durable.open_file(name, write=True)
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
    owner = durable.open_file(folder / _OWNER, write=True)
    if not owner.try_lock():
        owner.close()
        return
    _finish(folder, path, owner)
    _clear(folder, path.name, owner)


def _finish(folder: Path, path: Path, owner: PositionedFile) -> None:
    """Give a complete file the name that its maker had claimed, where there are no hard links."""
    claimed = path.is_file() and path.stat().st_size == 0
    if not claimed or not (folder / path.name).exists() or owner.size() != len(_COMPLETE):
        return
    noted = bytearray(len(_COMPLETE))
    owner.read_into(0, memoryview(noted))
    if noted == _COMPLETE:
        (folder / path.name).replace(path)
        durable.sync_folder(path.parent)


def _clear(folder: Path, name: str, owner: PositionedFile | None) -> None:
    """Remove a folder, its owner's file last."""
    try:
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
    return name in {_OWNER, _PREVIOUS} or name.startswith(made)
