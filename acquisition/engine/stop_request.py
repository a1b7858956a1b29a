"""Requests of a person to a session: stop, pause, go on."""

from __future__ import annotations

import threading

BY_THE_USER = "stopped by the user"


class StoppedWhileWaitingError(Exception):
    """A person asked for a stop while an instrument was waited for; there is no position to finish."""


class StopRequest:
    """Shared between the engine and whoever may stop or pause it; safe from any thread."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._pause = threading.Event()
        # Set at every request, for those who wait for the next one; taken back by them.
        self._news = threading.Event()
        self.reason = BY_THE_USER

    def finish_position(self, reason: str = BY_THE_USER) -> None:
        """Ask for a stop once the position under way is committed; the reason of the first request counts."""
        if not self._stop.is_set():
            self.reason = reason
        self._stop.set()
        self._news.set()

    def pause(self) -> None:
        """Ask the engine to stand still once the position under way is committed."""
        self._pause.set()
        self._news.set()

    def go_on(self) -> None:
        """Take a pause back."""
        self._pause.clear()
        self._news.set()

    @property
    def requested(self) -> bool:
        """Whether the engine was asked to stop."""
        return self._stop.is_set()

    @property
    def pause_requested(self) -> bool:
        """Whether the engine was asked to pause and not yet to go on."""
        return self._pause.is_set()

    def wait_for_news(self, seconds: float) -> None:
        """Wait on the wall's clock for the next request, at most so long."""
        self._news.wait(seconds)
        self._news.clear()
