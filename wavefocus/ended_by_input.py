"""Ending a command when standard input closes: whoever started it is gone, or wants it to end, on any system."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from wavefocus.ending_at_once import interrupt

_READS_BYTES = 4096


@contextmanager
def ended_by_input() -> Iterator[None]:
    """End the block with KeyboardInterrupt, as Ctrl-C does, when standard input comes to its end.

    What is written there is read and means nothing. Must be entered in the main thread to have an effect, and inside
    what turns signals into KeyboardInterrupt.
    """
    if threading.current_thread() is not threading.main_thread() or sys.stdin is None:
        yield
        return
    over, source = threading.Event(), sys.stdin.fileno()

    def watch() -> None:
        try:
            # Not through sys.stdin: a thread that waits in its lock would not let the interpreter end.
            while os.read(source, _READS_BYTES):
                pass
        except OSError:
            pass  # it cannot be read any more: closed as well
        if not over.is_set():
            interrupt()

    threading.Thread(target=watch, name="end of input", daemon=True).start()
    try:
        yield
    finally:
        over.set()
