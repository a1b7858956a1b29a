"""Instruments, emulated or not, have a thread each: what is left open is seen by it."""

import gc
import threading
import time


def threads_end():
    """For a fixture: fails where a thread that began meanwhile does not end."""
    before = set(threading.enumerate())
    yield
    latest_s = time.monotonic() + 10.0
    while (left := set(threading.enumerate()) - before) and time.monotonic() < latest_s:
        gc.collect()
        time.sleep(0.05)
    assert not left, f"left open: {', '.join(sorted(thread.name for thread in left))}"
