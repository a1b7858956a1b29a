"""Files next to a bank: event log, drift history, small JSON files; and the log of a verification that runs."""

from __future__ import annotations

import errno
import glob
import json
import os
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from wavefocus.config.messages import Message, to_line
from wavefocus.config.messages.campaign import (
    CrosstalkMeasured,
    Drift,
    Event,
    Fault,
    Logged,
    PositionCommitted,
    PositionKept,
    PositionStarted,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
    event_line,
    read_event,
)
from wavefocus.config.messages.rig_checks import VerifyEnded, VerifyStarted, VerifyStep
from wavefocus.console import Pace, exit_code, say, sentence
from wavefocus.storage.bank.ledger import row_ranges
from wavefocus.storage.sidecar_files import Log, create, is_replaceable
from wavefocus.storage.text_file import open_regular

# A file that somebody reads just now cannot be replaced on Windows; the reader is done at once.
_TRIES = 5
_PAUSE_S = 0.02
# More than any of these files ever is.
_MAX_BYTES = 65536


def raw_path(bank: Path) -> Path:
    """Where the raw recordings of a bank are kept: ``plate.h5`` -> ``plate.raw.h5``."""
    return bank.with_name(f"{bank.stem if bank.suffix == '.h5' else bank.name}.raw.h5")


def log_path(bank: Path) -> Path:
    """Where the events of a bank are logged: ``plate.h5`` -> ``plate.events.jsonl``."""
    return bank.with_suffix(".events.jsonl")


def said_path(bank: Path) -> Path:
    """Where a window keeps the standard error of a capture that it starts: ``plate.h5`` -> ``plate.h5.said``."""
    return bank.with_name(f"{bank.name}.said")


def write_whole(path: Path, content: Mapping[str, object], *, by_many: bool = False) -> None:
    """Write a JSON object so that a reader finds the old one or the new one and nothing in between.

    Raises OSError: it cannot be written.
    """
    if not is_replaceable(path):
        raise FileExistsError(errno.EEXIST, "a file of another program has this name", str(path))
    new = path.with_name(f".{path.name}.{secrets.token_hex(8)}.new")
    try:
        with create(new) as file:
            file.write((json.dumps(content) + "\n").encode())
        for left in reversed(range(_TRIES)):
            try:
                new.replace(path)
                break
            except PermissionError:
                if left == 0:
                    raise
                time.sleep(_PAUSE_S)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    if not by_many:
        for left_behind in path.parent.glob(f".{glob.escape(path.name)}.*.new"):  # by processes that were killed
            left_behind.unlink(missing_ok=True)


def read_whole(path: Path) -> dict[str, object] | None:
    """The JSON object in a file; None where there is no such file or none in it."""
    try:
        with open_regular(path) as file:
            content = json.loads(file.read(_MAX_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


class EventLines:
    """Writes events as JSON lines; a subscriber that a full disk or a closed pipe cannot turn against the campaign."""

    def __init__(self, write: Callable[[str], object], name: str, work: str = "campaign") -> None:
        self._write: Callable[[str], object] | None = write
        self._name, self._work = name, work

    def __call__(self, event: Event) -> None:
        """Write one event; after a failure the campaign goes on without these lines."""
        self.write(event_line(event))

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


class EventLog:
    """Appends events of some kinds to a file next to a bank; a subscriber.

    The drift history has a file of its own, for it holds clock times: a resumed bank is to be that of an undisturbed
    campaign.
    """

    def __init__(self, path: Path, *kinds: type[Event]) -> None:
        # Unbuffered: every line reaches the operating system, and closing has nothing left to fail on.
        self._file, self._kinds = Log(path), kinds or (Event,)
        self._lines = EventLines(self._file.write, str(path))

    def __call__(self, event: Event) -> None:
        """Write one event."""
        if isinstance(event, self._kinds):
            self._lines(event)

    def __enter__(self) -> EventLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


# The newest progress is among the last lines; an event is under 500 bytes.
_BLOCK_BYTES = 65536


def last_events(bank: Path) -> Iterator[Logged]:
    """The latest events of a bank's log, newest first; nothing when there is no log.

    The log is read backwards and no further than asked for. Lines that are no events are passed over: the last one
    is torn when the machine lost power.
    """
    return _events_backwards(log_path(bank))


def session_failure(bank: Path, since: datetime) -> tuple[str, str]:
    """Failure of the session that ended last, as of `SessionEnded`, and its reason; empty where none ended since."""
    failure = ""
    for logged in last_events(bank):
        match logged.event:
            case SessionEnded(failure=failure):
                if not failure or logged.at < since.astimezone(UTC).replace(microsecond=0):
                    break
            case StateChanged(state=State.FAILED, reason=reason) if failure:
                return failure, reason
    return "", ""


def unvouched_rows(bank: Path, positions: int) -> tuple[int, ...]:
    """Rows that were measured after the last measurement of the sentinel that a bank's log has.

    A session that was stopped or killed before its next look at the sentinel leaves them. A position counts from its
    start on, for a kill between commit and log; one that stayed as the bank had it does not. Sessions of another number
    of positions, and all before them, are of a bank that had this name earlier.
    """
    rows: list[int] = []
    kept: set[int] = set()
    own, looked = 0, False  # rows of sessions whose start was read; read on to the start of the one with the look
    accepted = False  # who finishes after a change was told to go on, unless its repeat could not be measured
    for logged in last_events(bank):
        match logged.event:
            case SessionStarted(positions=of) if of != positions:
                del rows[own:]
                break
            case SessionStarted(done=done):
                own, accepted = len(rows), False
                if looked or not done:
                    break
            case _ if looked:
                pass
            case Drift() as drift:
                # A change is measured once more before it is believed, unless the session ended between the two.
                if drift.verdict == "steady" or drift.occasion == "repeat" or rows or accepted:
                    rows += drift.suspect
                    looked = True
            case SessionEnded(state=state):
                accepted = state is State.FINISHED
            case Fault():
                accepted = False
            case PositionKept(position=position):
                kept.add(position)
            case PositionCommitted(position=position):
                kept.discard(position)
                rows.append(position)
            case PositionStarted(position=position) if position not in kept:
                rows.append(position)
            case _:
                pass
    return tuple(row for row in dict.fromkeys(reversed(rows)) if row < positions)


def _events_backwards(path: Path) -> Iterator[Logged]:
    """The events of a file from the last to the first, as it was when asked first; nothing where there is none."""
    if not path.is_file():
        return
    with open_regular(path) as file:
        start = file.seek(0, os.SEEK_END)
        rest = b""
        while start > 0:
            size = min(start, _BLOCK_BYTES)
            start = file.seek(start - size)
            rest, *lines = (file.read(size) + rest).split(b"\n")
            for line in reversed(lines if start else [rest, *lines]):
                if (logged := read_event(line)) is not None:
                    yield logged


def drift_path(bank: Path) -> Path:
    """Where the drift of a bank is kept: ``plate.h5`` -> ``plate.drift.jsonl``."""
    return bank.with_suffix(".drift.jsonl")


def read_drift(bank: Path) -> list[tuple[datetime, Drift]]:
    """The drift history of a bank, oldest first; empty where there is none. Torn lines are passed over."""
    found = reversed([*_events_backwards(drift_path(bank))])
    return [(logged.at, logged.event) for logged in found if isinstance(logged.event, Drift)]


def read_crosstalk(bank: Path) -> CrosstalkMeasured | None:
    """The latest look at the leak of the loopback; it stands in the drift history."""
    looks = (one.event for one in _events_backwards(drift_path(bank)) if isinstance(one.event, CrosstalkMeasured))
    return next(looks, None)


def suspect_rows(points: list[tuple[datetime, Drift]]) -> str:
    """Positions that the latest measurement of the sentinel speaks against, as ``--positions`` takes them."""
    return row_ranges(points[-1][1].suspect) if points else ""


class VerifyLog:
    """Writes the log of one verification; a context manager, and a subscriber of the scan's events.

    A line is an object with ``at`` and ``event``: first ``started`` (``pid``, ``host``), then ``step`` (``step``,
    ``done``, ``total``, ``left_s``) and any event of a scan as in a bank's log, at the end ``ended`` (``code``,
    ``reason``). A disk that refuses lines does not end the verification.
    """

    def __init__(self, path: Path) -> None:
        # A file of its own, so that followers see that it is another one.
        path.unlink(missing_ok=True)
        self._file = create(path)
        self._lines = EventLines(lambda line: self._file.write(line.encode()), str(path), "verification")
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

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None:
            self.done(exit_code(error), sentence(error))
        with suppress(OSError):
            self._file.close()

    def _write(self, message: Message) -> None:
        self._lines.write(to_line(message))


def _now() -> datetime:
    return datetime.now(UTC)
