"""The log beside a bank: one JSON line per event, so that the bank itself holds no clock times."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from acquisition.engine.events import Event, event_record
from storage.sidecar_files import Log
from wavefocus.campaign.sidecar_files import log_path
from wavefocus.console import say


def event_line(event: Event) -> str:
    """One event as a JSON line with the wall's clock time, without the line end."""
    return json.dumps({"at": datetime.now(UTC).isoformat(timespec="milliseconds"), **event_record(event)})


class EventLines:
    """Writes events as JSON lines; a subscriber that a full disk or a closed pipe cannot turn against the campaign.

    Parameters
    ----------
    write : callable
        Takes a line with its end and brings it out at once.
    name : str
        What the lines go to, for the one message when that fails.
    work : str
        What goes on without them.
    """

    def __init__(self, write: Callable[[str], object], name: str, work: str = "campaign") -> None:
        self._write: Callable[[str], object] | None = write
        self._name, self._work = name, work

    def __call__(self, event: Event) -> None:
        """Write one event; after a failure the campaign goes on without these lines."""
        self.write(event_line(event) + "\n")

    def write(self, line: str) -> None:
        """Write a line with its end; after a failure nothing more."""
        if self._write is None:
            return
        try:
            self._write(line)
        except (OSError, ValueError) as failure:  # ValueError: it was closed
            self._write = None
            why = getattr(failure, "strerror", None) or failure
            say(f"{self._name} cannot be written any more ({why}); the {self._work} goes on without it")


def print_line(line: str) -> None:
    """Write a line on standard output at once."""
    sys.stdout.write(line)
    sys.stdout.flush()


class EventLog:
    """Appends events to the log beside a bank; a subscriber."""

    def __init__(self, bank: Path) -> None:
        # Unbuffered: every line reaches the operating system, and closing has nothing left to fail on.
        self._file = Log(log_path(bank))
        self._lines = EventLines(self._file.write, str(log_path(bank)))

    def __call__(self, event: Event) -> None:
        """Write one event."""
        self._lines(event)

    def __enter__(self) -> EventLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


# The newest progress is among the last lines; an event is under 500 bytes.
_BLOCK_BYTES = 65536


def last_events(bank: Path) -> Iterator[dict[str, object]]:
    """The latest events of a bank's log, newest first; nothing when there is no log.

    The log is read backwards and no further than asked for. A torn last line (the machine lost
    power) is passed over.
    """
    for line in _lines_backwards(log_path(bank)):
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict):
            yield record


def _lines_backwards(path: Path) -> Iterator[bytes]:
    """The lines of a file from the last to the first, as it was when asked first."""
    if not path.is_file():
        return
    with path.open("rb") as file:
        start = file.seek(0, os.SEEK_END)
        rest = b""
        while start > 0:
            size = min(start, _BLOCK_BYTES)
            start = file.seek(start - size)
            rest, *lines = (file.read(size) + rest).split(b"\n")
            yield from reversed(lines)
        yield rest
