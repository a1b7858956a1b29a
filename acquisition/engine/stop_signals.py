"""How a person stops or pauses a campaign: the first request finishes the position, the second stops at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

BY_THE_USER = "stopped by the user"
TERMINAL_GONE = "stopped because its terminal was closed"


class StoppedWhileWaitingError(Exception):
    """A person asked for a stop while an instrument was waited for; there is no position to finish."""


class StopRequest:
    """Shared between the engine and whoever may stop or pause it; safe from any thread."""

    def __init__(self) -> None:
        self._finish_position = threading.Event()
        self._pause = threading.Event()
        # Set at every request, for those who wait for the next one; taken back by them.
        self._news = threading.Event()
        self._reason = BY_THE_USER

    def finish_position(self, reason: str = BY_THE_USER) -> None:
        """Ask the engine to stop once the position under way is measured and committed.

        Parameters
        ----------
        reason : str
            Who or what stops it, for the log; that of the first request counts.
        """
        if not self._finish_position.is_set():
            self._reason = reason
        self._finish_position.set()
        self._news.set()

    def pause(self) -> None:
        """Ask the engine to stand still once the position under way is measured and committed."""
        self._pause.set()
        self._news.set()

    def go_on(self) -> None:
        """Take a pause back."""
        self._pause.clear()
        self._news.set()

    @property
    def requested(self) -> bool:
        """Whether the engine was asked to stop."""
        return self._finish_position.is_set()

    @property
    def reason(self) -> str:
        """Who or what stops it."""
        return self._reason

    @property
    def pause_requested(self) -> bool:
        """Whether the engine was asked to pause and not yet to go on."""
        return self._pause.is_set()

    def wait_for_news(self, seconds: float) -> None:
        """Wait on the wall's clock for the next request, at most so long."""
        self._news.wait(seconds)
        self._news.clear()


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Ctrl-C asks `stop` to finish the position, a second one raises KeyboardInterrupt at once.

    A terminal that goes away (SIGHUP) finishes the position too; one that was to be ignored, as under nohup,
    stays ignored. SIGTERM, and a console window that is closed on Windows, raise KeyboardInterrupt at once:
    whoever sends them will not wait for a record. Signals after that are ignored while the engine puts the
    instruments to rest. Must be entered in the main thread; the former dispositions are restored on leaving.
    """
    at_once = False
    signals = EndingSignals.here()

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal at_once
        if at_once:
            return
        if number in signals.terminal_gone:
            stop.finish_position(TERMINAL_GONE)
            return
        if number in signals.finish and not stop.requested:
            stop.finish_position()
            return
        at_once = True
        stop.finish_position()
        raise KeyboardInterrupt

    caught = [one for one in signals.all if signal.getsignal(one) is not signal.SIG_IGN or one in signals.finish]
    former = {number: signal.signal(number, receive) for number in caught}
    try:
        yield
    finally:
        for number, disposition in former.items():
            signal.signal(number, disposition)


@dataclass(frozen=True, slots=True)
class EndingSignals:
    """Numbers of signals by what is meant with them.

    Parameters
    ----------
    finish : tuple of int
        Finish the position first; once more: at once.
    terminal_gone : tuple of int
        Nobody watches any more; finish the position.
    at_once : tuple of int
        Do not wait for the position.
    """

    finish: tuple[int, ...]
    terminal_gone: tuple[int, ...]
    at_once: tuple[int, ...]

    @classmethod
    def here(cls, source: object = signal) -> EndingSignals:
        """The signals of this system.

        Parameters
        ----------
        source : object
            Where to look for SIGINT, SIGHUP, SIGTERM and SIGBREAK; the module `signal`. SIGBREAK is what Windows
            sends for Ctrl-Break and, with seconds to live, when the console window is closed.
        """

        def those_of(*names: str) -> tuple[int, ...]:
            return tuple(int(getattr(source, name)) for name in names if hasattr(source, name))

        return cls(those_of("SIGINT"), those_of("SIGHUP"), those_of("SIGTERM", "SIGBREAK"))

    @property
    def all(self) -> tuple[int, ...]:
        """Every one of them."""
        return (*self.finish, *self.terminal_gone, *self.at_once)
