"""Ending a command by a file: an order that any process on any system can give, without knowing a process id."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from wavefocus.ending_at_once import interrupt

LOOKS_EVERY_S = 0.1


@contextmanager
def ended_by_file(path: Path) -> Iterator[None]:
    """End the block with KeyboardInterrupt, as Ctrl-C does, once a file appears; the file is taken away.

    A file of that name that was left before is no order and is taken away first. Must be entered in the main thread
    to have an effect, and inside what turns signals into KeyboardInterrupt.
    """
    path.unlink(missing_ok=True)
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    over = threading.Event()

    def watch() -> None:
        while not over.wait(LOOKS_EVERY_S):
            if path.exists():
                with suppress(OSError):
                    path.unlink()
                interrupt()
                return

    watcher = threading.Thread(target=watch, name="order to end", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
