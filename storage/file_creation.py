"""Making a file whose space is all there from the beginning, without touching anything that exists."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from storage import durable
from storage.durable import PAGE
from storage.errors import ExistsError, InputError
from storage.staging_dir import Workplace, clear_leftovers, workplace


def create_reserved(
    path: Path, about_bytes: int, lay_out: Callable[[Path], int], open_file: durable.OpenFile = durable.open_file
) -> None:
    """Make a file with all its space reserved; an existing one is never touched.

    Parameters
    ----------
    path : Path
        A file that does not exist, in a folder that does.
    about_bytes : int
        How large it will be, a little rounded up.
    lay_out : callable
        Writes what the file begins with to a path and returns how many bytes it will need.
    open_file : durable.OpenFile
        How the file is opened when its space is reserved.

    Raises
    ------
    ExistsError
        When the path exists.
    InputError
        When the folder is missing, or the disk is too small; nothing is left behind.
    """
    clear_leftovers(path)
    if path.exists():
        raise ExistsError(f"{path} exists already; choose another name, or resume it")
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the file itself")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    _require_space(path, about_bytes, None)
    try:
        with workplace(path) as place:
            _make(path, place, about_bytes, lay_out, open_file)
    except InputError:
        raise
    except OSError as error:
        _require_space(path, about_bytes, error)
        raise InputError(f"{path} may not be written: {error.strerror or error}") from error


def _make(
    path: Path, place: Workplace, about_bytes: int, lay_out: Callable[[Path], int], open_file: durable.OpenFile
) -> None:
    try:
        _fill(place.temporary, lay_out, open_file)
        place.complete()
        durable.publish_new(place.temporary, path)
    except FileExistsError as error:
        raise ExistsError(f"{path} exists already; choose another name, or resume it") from error
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        _require_space(path, about_bytes, error)
        raise InputError(f"{path} cannot be made: {error}") from error


def _fill(temporary: Path, lay_out: Callable[[Path], int], open_file: durable.OpenFile) -> None:
    needed = lay_out(temporary)
    file = open_file(temporary, write=True)
    try:
        file.reserve(max(-(-file.size() // PAGE) * PAGE, needed))
        file.sync()
    finally:
        file.close()


def _require_space(path: Path, needed: int, error: Exception | None) -> None:
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise InputError(
            f"{path} needs {needed} bytes and its disk has {free} free; make room or use another"
        ) from error
