"""Ending a command early: by a signal, by a file, or by the end of standard input."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

from acquisition.engine.stop_signals import EndingSignals
from drivers.errors import InstrumentError


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let every signal that ends a program mute the outputs first; a second one does not disturb that."""
    signals, begun = EndingSignals.here(), False

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal begun
        if not begun:
            begun = True
            raise KeyboardInterrupt

    former = {}
    if threading.current_thread() is threading.main_thread():
        caught = [one for one in signals.all if signal.getsignal(one) is not signal.SIG_IGN or one in signals.finish]
        former = {number: signal.signal(number, receive) for number in caught}
    try:
        yield
    except InstrumentError as failure:
        if begun:
            raise KeyboardInterrupt from failure
        raise
    finally:
        for number, disposition in former.items():
            signal.signal(number, disposition)


def interrupt() -> None:
    """Ctrl-C for the main thread; on POSIX a real signal, which also ends what it waits for."""
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


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
