"""The log of a verification that runs, which a window follows."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from wavefocus.campaign.sidecar_files import EventLines
from wavefocus.config.messages import Message, to_line
from wavefocus.config.messages.campaign import Event
from wavefocus.config.messages.rig_checks import VerifyEnded, VerifyStarted, VerifyStep
from wavefocus.console import Pace
from wavefocus.exits import exit_code, sentence
from wavefocus.rendering.verify.record import LOG_NAME
from wavefocus.storage.sidecar_files import create


class VerifyLog:
    """Writes the log of one verification; a context manager, and a subscriber of the scan's events.

    A line is an object with ``at`` and ``event``: first ``started`` (``pid``, ``host``), then ``step`` (``step``,
    ``done``, ``total``, ``left_s``) and any event of a scan as in a bank's log, at the end ``ended`` (``code``,
    ``reason``). A disk that refuses lines does not end the verification.
    """

    def __init__(self, out: Path) -> None:
        # A file of its own, so that followers see that it is another one.
        (out / LOG_NAME).unlink(missing_ok=True)
        self._file = create(out / LOG_NAME)
        self._lines = EventLines(lambda line: self._file.write(line.encode()), str(out / LOG_NAME), "verification")
        self._write(VerifyStarted(_now(), os.getpid(), socket.gethostname()))

    def __call__(self, event: Event) -> None:
        """Write an event of the scan."""
        self._lines(event)

    def step(self, name: str, total: int) -> Callable[[int, int], None]:
        """Begin a step of `total` items; the result is called with the number done."""
        told_s, pace = time.monotonic(), Pace(0, total)
        self._write(VerifyStep(_now(), name, 0, total))

        def report(done: int, total: int) -> None:
            nonlocal told_s
            rate, now_s = pace.per_s(done, total), time.monotonic()
            # Followers look twenty times a second; more lines would only fill the disk.
            if done < total and now_s - told_s < 0.1:
                return
            told_s = now_s
            self._write(VerifyStep(_now(), name, done, total, round((total - done) / rate, 1) if rate > 0 else None))

        return report

    def done(self, code: int, reason: str) -> None:
        """Say how it ended."""
        self._write(VerifyEnded(_now(), int(code), reason))

    def __enter__(self) -> VerifyLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.done(exit_code(error), sentence(error))
        with suppress(OSError):
            self._file.close()

    def _write(self, message: Message) -> None:
        self._lines.write(to_line(message))


def _now() -> datetime:
    return datetime.now(UTC)
