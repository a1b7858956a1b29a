"""How a person stops a campaign: the first request finishes the position, the second stops at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StoppedWhileWaitingError(Exception):
    """A person asked for a stop while an instrument was waited for; there is no position to finish."""


class StopRequest:
    """Shared between the engine and whoever may stop it."""

    def __init__(self) -> None:
        self._finish_position = threading.Event()

    def finish_position(self) -> None:
        """Ask the engine to stop once the position under way is measured and committed."""
        self._finish_position.set()

    @property
    def requested(self) -> bool:
        """Whether the engine was asked to stop."""
        return self._finish_position.is_set()


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Ctrl-C asks `stop` to finish the position, a second one raises KeyboardInterrupt at once.

    SIGTERM raises KeyboardInterrupt at once: whoever sends it will not wait for a record.
    Signals after that are ignored while the engine puts the instruments to rest. Must be
    entered in the main thread; the former dispositions are restored on leaving.
    """
    at_once = False

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal at_once
        if at_once:
            return
        if number == signal.SIGINT and not stop.requested:
            stop.finish_position()
            return
        at_once = True
        stop.finish_position()
        raise KeyboardInterrupt

    former = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, disposition in former.items():
            signal.signal(number, disposition)
