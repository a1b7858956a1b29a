"""Commands that a signal ends at once: instruments are put to rest on the way out, and nothing disturbs that."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from acquisition.engine.ending_signals import EndingSignals
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
