"""Names that one process of this computer holds at a time: an instrument, a rig."""

import hashlib
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wavefocus.storage import durable
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.storage.ledger import owner
from wavefocus.storage.sidecar_files import create
from wavefocus.storage.text_file import permission_words


@contextmanager
def claimed(name: str) -> Iterator[None]:
    """Hold a name while the block runs; the lock is the system's, so a process that is killed releases it.

    name: What is held, as messages state it, with full names of files.

    Raises BankBusyError: another process holds it; the message names host and process id.
    """
    path = _lock_file(name)
    with suppress(FileExistsError):
        create(path).close()
        path.chmod(0o666)  # other users of this computer hold the same name, whatever the umask
    try:
        lock = durable.open_file(path)
    except PermissionError:
        raise InputError(f"{name}: its lock {path} may not be opened{permission_words(path)}") from None
    with lock as file:
        # Whoever asks for the holder has the lock for microseconds.
        given_up_s = time.monotonic() + 0.2
        while not file.try_lock():
            if time.monotonic() >= given_up_s:
                holder = _claim_holder(name) or owner.Owner("this computer", 0)
                raise BankBusyError(
                    f"{name} is held by process {holder.pid or 'unknown'} on {holder.host}; wait until it has finished "
                    "or stop it, then try again"
                )
            time.sleep(0.05)
        owner.write_owner(path)
        try:
            yield
        finally:
            owner.remove_owner(path)


def _claim_holder(name: str) -> owner.Owner | None:
    """The process that holds a name now; None where none does."""
    path = _lock_file(name)
    return owner.bank_owner(path) if path.is_file() else None


def _lock_file(name: str) -> Path:
    return Path(tempfile.gettempdir()) / f"wavefocus-{hashlib.sha256(name.encode()).hexdigest()[:20]}.lock"
