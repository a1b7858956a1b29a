"""Output files: what they may replace, and how they are written.

An output is written under another name in a hidden folder next to it, synced and renamed. Until then the older file of
its name stays, whatever happens.
"""

import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from wavefocus.storage import durable
from wavefocus.storage.errors import InputError
from wavefocus.storage.sidecar_files import StagingDir, clear_leftovers, staging_dir
from wavefocus.storage.text_file import HDF5_SIGNATURE

EXPORT_MARK = "wavefocus_export"
"""Root attribute of exports that are read as banks, too; being copies, they may be replaced."""
_STAGED = "results"
# The metadata of a bank lie in front of its data.
_HEAD_BYTES = 2 << 20


@contextmanager
def replacement(path: Path, *, new: bool = False) -> Iterator[Path]:
    """Write a file whole: yields a path that does not exist yet and gets the name `path` when the block ends well.

    path: The file; an older one of that name is replaced at the end, but never a bank, raw recordings or a link.
    new: Whether an older one stays, and FileExistsError is raised.

    Raises InputError: it must stay, or cannot be written; an older file of that name is there as before.
    """
    with _named_failures(path):
        if not new:
            _require_replaceable(path, ())
        clear_leftovers(path.parent)
        with staging_dir(path) as place:
            yield place.temporary
            durable.sync_path(place.temporary)
            if new:
                place.complete()
                durable.publish_new(place.temporary, path)
                return
            _keep_mode(path, place.temporary)
            place.publish()


@contextmanager
def staged_folder(folder: Path, last: str, owned: Collection[str]) -> Iterator[Path]:
    """Write files into a folder together: yields a hidden folder whose files are moved when the block ends well.

    Other files of the folder stay. The file named `last` never stands among files of another making: who finds it
    finds all others of the same.

    folder: Where they belong; it exists.
    owned: Names of files that are gone afterwards unless the block has written them.

    Raises InputError: they cannot be written; older files may be gone then, the one named `last` before all others.
    """
    publish = partial(StagingDir.publish_files, last=last, owned=owned)
    with _named_failures(folder), _staged(folder / _STAGED, folder, publish) as staging:
        yield staging


@contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """Write a folder whole: yields a hidden folder that gets the name `folder` when the block ends well.

    An older folder of that name is replaced then. Its parent folders are made where missing.

    Raises InputError: it cannot be written; an older folder of that name is there as before.
    """
    with _named_failures(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with _staged(folder, folder, StagingDir.publish_folder) as staging:
            yield staging


@contextmanager
def _staged(path: Path, folder: Path, publish: Callable[[StagingDir], None]) -> Iterator[Path]:
    """Yield a hidden folder next to `path`, synced and published when the block ends well; errors name `folder`.

    What replaces a file has that file's permissions.
    """
    clear_leftovers(path.parent)
    with staging_dir(path) as staging:
        staging.temporary.mkdir()
        try:
            yield staging.temporary
        except InputError as error:
            raise InputError(str(error).replace(str(staging.temporary), str(folder))) from error
        for made in staging.temporary.rglob("*"):
            (durable.sync_folder if made.is_dir() else durable.sync_path)(made)
            _keep_mode(folder / made.relative_to(staging.temporary), made)
        durable.sync_folder(staging.temporary)
        publish(staging)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file's whole content, as :func:`replacement` does."""
    with replacement(path) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode())


def require_room(path: Path, size: int) -> None:
    """Refuse a file that the disk, a quota or a limit of the process has no room for; `path` stays missing.

    Raises OSError: there is no room for `size` bytes.
    """
    path.touch(0o600, exist_ok=False)
    try:
        with durable.PositionedFile(path, write=True) as file:
            file.reserve(size)
    finally:
        path.unlink()


def require_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | None], *, force: bool) -> None:
    """Refuse output files that would replace what must stay, before anything is computed.

    outputs: Files that are to be written; None for those that are not.
    inputs: Files that are read.
    force: Whether older files may be replaced; inputs, banks and raw recordings never are.

    Raises InputError: an output is an input, a bank, a raw file, another output, no regular file or write-protected, or
    exists and may not be replaced; or its folder is missing.
    """
    wanted = [path for path in outputs if path is not None]
    read = [path for path in inputs if path is not None]
    for number, path in enumerate(wanted):
        for other in wanted[:number]:
            if _same(path, other):
                raise InputError(f"{path} is asked for as two outputs; name two files")
        _require_output(path, read, force=force)


def require_output_folder(
    folder: Path, names: Iterable[str], inputs: Sequence[Path], *, force: bool, may_exist: Iterable[str] = ()
) -> None:
    """Refuse a folder of outputs whose files of the given names must stay; as :func:`require_outputs`.

    The folder may be missing; files of the names in `may_exist` are not results and are replaced without being asked.
    """
    if not folder.is_dir():
        if os.path.lexists(folder):
            raise InputError(f"{folder} is not a folder; name a folder")
        return
    for name in may_exist:
        _require_output(folder / name, inputs, force=True)
    for name in names:
        _require_output(folder / name, inputs, force=force)


def require_replaceable_folder(
    folder: Path, ours: Collection[str], inputs: Iterable[Path | None], *, by: str, force: bool
) -> None:
    """Refuse a folder of outputs, replaced as a whole, that must stay.

    ours: Files that an earlier run of the command `by` wrote into it; a folder with any other is never replaced.
    force: Whether one that holds files is replaced.

    Raises InputError: the folder must stay, or is a link or no folder.
    """
    if not os.path.lexists(folder):
        return
    if folder.is_symlink() or not folder.is_dir():
        raise InputError(f"{folder} is not a folder; name a new folder")
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir())
    if Path.cwd().is_relative_to(folder.resolve()):
        raise InputError(f"{folder} is the folder that this command runs in; name a new folder")
    if not files:
        return
    if not force:
        raise InputError(f"{folder} exists and holds files; name a new folder, or replace an earlier one with --force")
    if strangers := [name for name in files if name not in ours]:
        raise InputError(f"{folder} holds {strangers[0]}, which wavefocus {by} has not written; name a new folder")
    for path in inputs:
        if path is not None and path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{path} is an input of this command and lies in {folder}; name a new folder")


def _require_output(path: Path, inputs: Sequence[Path], *, force: bool) -> None:
    if not _require_replaceable(path, inputs):
        return
    if not force:
        raise InputError(f"{path} exists; name another file, or replace it with --force (in Python: force=True)")
    if not os.access(path, os.W_OK):
        raise InputError(f"{path} is write-protected; name another file")


def _require_replaceable(path: Path, inputs: Sequence[Path]) -> bool:
    """Refuse what is never replaced, whoever asks for it; returns whether there is a file that may be."""
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the file itself")
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{path}: there is no folder {folder}")
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return False
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "not a regular file"
        raise InputError(f"{path} is {kind}; an output is written to a regular file or a new name")
    for other in inputs:
        if _same(path, other):
            raise InputError(f"{path} is an input of this command and is never written over; name another file")
    if found := _precious(path):
        raise InputError(f"{path} {found} and is never written over; name another file")
    return True


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:  # one of them is not there
        return path.absolute() == other.absolute()


def _precious(path: Path) -> str:
    """Say what kind of measurement a file holds; empty where it holds none."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if HDF5_SIGNATURE not in head:
        return ""
    for name, words in (("wavefocus-bank", "is a bank"), ("wavefocus-raw", "holds raw recordings")):
        if name.encode() in head:
            return words
    from wavefocus.storage import hdf5_reading  # with it comes h5py, which the window does not load

    try:
        with hdf5_reading.opened(path) as file:
            if "green" in file:
                return "" if EXPORT_MARK in file.attrs else "is a bank"
            if "response" in file and "reference" in file:
                return "holds raw recordings"
    except InputError:
        return "is a damaged HDF5 file, perhaps a bank,"
    return ""


def _keep_mode(older: Path, made: Path) -> None:
    """Give a synced file the permissions of the one that it replaces: to be synced it must be writable."""
    if older.is_file():
        shutil.copymode(older, made)


@contextmanager
def _named_failures(path: Path) -> Iterator[None]:
    """Name the output in failures of the system that name no other file."""
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        if error.filename is not None:
            named = Path(str(error.filename))
            if named not in (path, path.parent) and not any(part.endswith(".partial") for part in named.parts):
                raise
        raise InputError(f"{path} cannot be written: {error.strerror or error}") from error
