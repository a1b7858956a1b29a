"""What a verification tells while it works: JSON lines in its folder, which windows and other programs follow."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from acquisition.engine.events import Event
from rendering.verify.names import LOG_NAME
from storage.sidecar_files import create
from wavefocus.campaign.event_log import EventLines
from wavefocus.exits import exit_code, sentence

# Followers look twenty times a second; more lines would only fill the disk.
TELLS_EVERY_S = 0.1


class VerifyLog:
    """Writes the log of one verification; a context manager, and a subscriber of the scan's events.

    A line is an object with ``at`` and ``event``: first ``started`` (``pid``, ``host``), then ``step`` (``step``,
    ``done``, ``total``, ``left_s``) and any event of a scan as in a bank's log, at the end ``ended`` (``code``,
    ``reason``). A disk that refuses lines does not end the verification.

    Parameters
    ----------
    out : Path
        The verification's folder, which is there; an older log is replaced.
    """

    def __init__(self, out: Path) -> None:
        # A file of its own, so that followers see that it is another one.
        (out / LOG_NAME).unlink(missing_ok=True)
        self._file = create(out / LOG_NAME)
        self._lines = EventLines(lambda line: self._file.write(line.encode()), str(out / LOG_NAME), "verification")
        self._tell("started", pid=os.getpid(), host=socket.gethostname())

    def __call__(self, event: Event) -> None:
        """Write an event of the scan."""
        self._lines(event)

    def step(self, name: str, total: int) -> Callable[[int, int], None]:
        """Begin a step of `total` items; the result is told how many are done."""
        started_s = time.monotonic()
        told_s = started_s
        self._tell("step", step=name, done=0, total=total, left_s=None)

        def report(done: int, total: int) -> None:
            nonlocal told_s
            now_s = time.monotonic()
            if done < total and now_s - told_s < TELLS_EVERY_S:
                return
            told_s = now_s
            left_s = round((now_s - started_s) / done * (total - done), 1) if done else None
            self._tell("step", step=name, done=done, total=total, left_s=left_s)

        return report

    def done(self, code: int, reason: str) -> None:
        """Say how it ended."""
        self._tell("ended", code=code, reason=reason)

    def __enter__(self) -> VerifyLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and (code := exit_code(error)) is not None:
            self.done(code, sentence(error))
        with suppress(OSError):
            self._file.close()

    def _tell(self, event: str, **content: object) -> None:
        at = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._lines.write(json.dumps({"at": at, "event": event, **content}) + "\n")
