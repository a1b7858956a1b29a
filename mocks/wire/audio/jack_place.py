"""Room for one more audio server on this machine, and a name for it."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

SERVER_BYTES = 45_000_000
"""A jackd takes 42 MB of /dev/shm, however few ports it has (measured, 1.9.21)."""
MOST_SERVERS = 7
"""Of eight that may be registered; a person may run one."""
PLACE_S = 60.0


@contextlib.contextmanager
def server_place() -> Iterator[str]:
    """The name of a server that nobody else on this machine uses, and room for it in shared memory.

    A few names, used again and again: a server that was killed stays registered until one of its name follows, and
    eight are all there is room for.

    Raises
    ------
    RuntimeError
        All places were taken for too long.
    """
    import fcntl

    memory = os.statvfs("/dev/shm")
    places = min(MOST_SERVERS, max(1, memory.f_blocks * memory.f_frsize // SERVER_BYTES))
    latest_s = time.monotonic() + PLACE_S
    while True:
        for place in range(places):
            name = f"wavefocus-{os.getuid()}-{place}"
            lock = Path(tempfile.gettempdir()) / f"{name}.lock"
            with open(lock, "a", opener=_not_through_links) as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                yield name
                return
        if time.monotonic() > latest_s:
            raise RuntimeError(f"{places} emulated interfaces are running, and /dev/shm has no room for one more")
        time.sleep(0.05)


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW, 0o600)
