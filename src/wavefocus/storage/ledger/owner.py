"""One process at a time: the writer of a file, and the holder of a name, such as an instrument or a rig."""

import contextlib
import hashlib
import io
import json
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from wavefocus.storage.durable import OpenFile, PositionedFile
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.storage.sidecar_files import clear_leftovers, create, is_replaceable
from wavefocus.storage.text_file import permission_words, read_regular, require_regular

# Asking for the owner holds a shared lock for microseconds; a writer that meets it tries again.
_TRIES = 5
_PAUSE_S = 0.05


@dataclass(frozen=True, slots=True)
class Owner:
    """The process that writes a file.

    host: Name of its machine, ``"unknown host"`` when it could not be read.
    pid: Its process id, 0 when it could not be read.
    started: When it opened the file, ISO 8601 with time zone, empty when it could not be read.
    """

    host: str
    pid: int
    started: str = ""


def owner_path(path: Path) -> Path:
    """Return the file next to a bank that names its owner."""
    return path.with_name(path.name + ".owner")


def bank_owner(path: str | Path) -> Owner | None:
    """Return the process that owns a file now, or None; a name that a dead process left counts for nothing.

    Raises InputError: when the file is missing or may not be read.
    """
    path = Path(path)
    require_regular(path)
    if not owner_path(path).exists():
        return None  # without touching the lock
    try:
        file = PositionedFile(path)
    except OSError as error:
        raise InputError(f"{path} may not be read: {error.strerror}") from error
    with file:
        return _named_owner(path) if file.locked_elsewhere() else None


def opened_as_owner(path: Path, kind: str, opening: OpenFile) -> PositionedFile:
    """Open a file, a `kind` in messages, for writing, and own it until it is closed; what a kill left beside it goes.

    Raises InputError: it is missing, a link or no regular file, or may not be written. BankBusyError: as
    `take_ownership`.
    """
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the file itself")
    require_regular(path)
    clear_leftovers(path.parent, path.name)
    for tries_left in reversed(range(_TRIES)):
        try:
            file = opening(path, write=True)
        except OSError as error:
            raise InputError(f"{path} may not be written: {error.strerror}") from error
        try:
            take_ownership(path, file, kind)
        except BaseException:
            file.close()
            raise
        # Its name may lead to a copy with a note by now; on drives that number files anew it never seems to be named.
        if file.is_named(path) or not tries_left:
            break
        file.close()
    return file


def take_ownership(path: Path, file: PositionedFile, kind: str) -> None:
    """Lock an open file, a `kind` in messages, until it is closed; BankBusyError where another process owns it."""
    if _locked(file):
        return
    owner = _named_owner(path)
    who = f"process {owner.pid} on {owner.host}" if owner.pid else "another process"
    raise BankBusyError(
        f"{kind} {path} is owned by {who}; wait until it has finished or stop it, then try again"
        " (reading and status are possible meanwhile)"
    )


def _locked(file: PositionedFile) -> bool:
    """Lock an open file until it is closed; False where another process keeps the lock."""
    for attempt in range(_TRIES):
        if attempt:
            time.sleep(_PAUSE_S)
        if file.try_lock():
            return True
    return False


def write_owner(path: Path) -> None:
    """Name this process in the file next to the one it has locked."""
    owner = Owner(socket.gethostname(), os.getpid(), datetime.now(UTC).astimezone().isoformat(timespec="seconds"))
    # The file's own space is reserved: a disk that is full but for that must not keep anyone from measuring.
    with contextlib.suppress(OSError):
        name = owner_path(path)
        replaceable = is_replaceable(name)  # of a process that was killed
        try:
            if replaceable:
                name.unlink(missing_ok=True)
            file = create(name)
            name.chmod(0o666)  # whoever meets the lock reads who holds it, and names itself later, whatever the umask
        except PermissionError:  # it was another user's, in a folder where each removes their own alone
            file = io.FileIO(os.open(name, os.O_WRONLY | os.O_TRUNC | getattr(os, "O_NOFOLLOW", 0)), "w")
        with file:
            file.write((json.dumps(asdict(owner)) + "\n").encode())


def remove_owner(path: Path) -> None:
    """Take this process's name away, before the lock is released."""
    if is_replaceable(owner_path(path)):
        with contextlib.suppress(PermissionError):  # as in `write_owner`; without the lock it names nobody
            owner_path(path).unlink(missing_ok=True)


def _named_owner(path: Path) -> Owner:
    try:
        entry = json.loads(read_regular(owner_path(path)))
        return Owner(str(entry["host"]), int(entry["pid"]), str(entry.get("started", "")))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        # Only the lock decides; the name is for people and may be missing for a moment.
        return Owner("unknown host", 0)


@contextlib.contextmanager
def claimed(name: str) -> Iterator[None]:
    """Hold a name while the block runs; the lock is the system's, so a process that is killed releases it.

    name: What is held, as messages state it, with full names of files.

    Raises BankBusyError: another process holds it; the message names host and process id.
    """
    path = Path(tempfile.gettempdir()) / f"wavefocus-{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock"
    with contextlib.suppress(FileExistsError):
        create(path).close()
        path.chmod(0o666)  # other users of this computer hold the same name, whatever the umask
    try:
        lock = PositionedFile(path)
    except PermissionError:
        raise InputError(f"{name}: its lock {path} may not be opened{permission_words(path)}") from None
    with lock as file:
        if not _locked(file):
            holder = bank_owner(path) or Owner("this computer", 0)
            raise BankBusyError(
                f"{name} is held by process {holder.pid or 'unknown'} on {holder.host}; wait until it has finished "
                "or stop it, then try again"
            )
        write_owner(path)
        try:
            yield
        finally:
            remove_owner(path)
