"""What people see while a command works: lines and a progress bar, all on standard error."""

from __future__ import annotations

import errno
import io
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cache
from typing import IO, TYPE_CHECKING, Protocol, TextIO, cast

from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.exits import STAND_IN, escaped

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer
    from rich.console import Console
    from rich.progress import Task
    from rich.status import Status


class _StandardError(io.TextIOBase):
    """Standard error as it is now; what cannot be written to a terminal that is gone is dropped.

    Nobody is left to read it, and a campaign must not end for it: its log next to the bank holds the same.
    """

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._stream(), "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError):  # ValueError: it was closed
            self._stream().write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError):
            self._stream().flush()

    def isatty(self) -> bool:
        try:
            return self._stream().isatty()
        except (OSError, ValueError):
            return False

    def fileno(self) -> int:
        return self._stream().fileno()

    @staticmethod
    def _stream() -> IO[str]:
        # While a progress bar is shown, rich puts a stand-in there that writes to the bar's console, that is, here.
        return cast(IO[str], getattr(sys.stderr, "rich_proxied_file", sys.stderr))


class Listener(io.FileIO):
    """Standard output of a process: a reader that goes away decides nothing of what is carried out."""

    gone = False

    @classmethod
    def in_place_of(cls, stream: TextIO) -> TextIO:
        """A stream that takes the place of standard output; a terminal stays as it is."""
        try:
            if stream.isatty() or getattr(stream, STAND_IN, False):
                return stream
            stream.flush()
            raw = cls(stream.fileno(), "w", closefd=False)
        except (OSError, ValueError):  # nothing stands behind it
            return stream
        binary = io.BufferedWriter(raw)
        return io.TextIOWrapper(binary, stream.encoding, stream.errors, line_buffering=bool(stream.line_buffering))

    def write(self, data: ReadableBuffer) -> int:
        """Write; dropped once nobody reads. Raises OSError, which names standard output: it cannot be written."""
        try:
            return 0 if (written := super().write(data)) is None else written
        except OSError as failure:
            # EINVAL: a pipe that nobody reads, on Windows.
            if failure.errno != errno.EPIPE and not (os.name == "nt" and failure.errno == errno.EINVAL):
                raise OSError(failure.errno, failure.strerror, "standard output") from None
            self.gone = True
            return memoryview(data).nbytes


@cache
def people() -> Console:
    """Tables, rules and progress bars on standard error."""
    from rich.console import Console  # most commands only say lines

    return Console(file=cast(IO[str], _StandardError()), highlight=False, soft_wrap=True)


def say(line: str) -> None:
    """Write one line to standard error; dropped where the terminal is gone."""
    with suppress(OSError, ValueError):  # ValueError: it was closed
        print(escaped(line), file=sys.stderr, flush=True)


def answer(line: str) -> None:
    """Write one line of what a command was asked for, on standard output.

    Raises OSError: standard output cannot be written.
    """
    print(escaped(line), flush=True)


@contextmanager
def spinner(words: str) -> Iterator[Status | None]:
    """Name on a terminal what is going on, where nobody knows how much is left; None elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    with people().status(f"{words} ...") as status:
        yield status


def finish_clock(remaining_s: float) -> str:
    """The wall's clock time in `remaining_s` seconds, with the day when it is not today."""
    now = datetime.now(UTC)
    finish = finish_time(remaining_s, now)
    return finish.strftime("%H:%M:%S" if finish.date() == now.astimezone().date() else "%a %d %b %H:%M")


class Report(Protocol):
    """Progress of some work."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """`done` of `total` items are done; `note` stands at the end of the line."""
        ...


def _rate(task: Task) -> str:
    speed = task.finished_speed or task.speed
    if task.finished:
        return f"in {hours(task.finished_time or 0.0)}"
    if not speed or task.total is None:
        return ""
    remaining_s = (task.total - task.completed) / speed
    return f"{speed:.1f}/s  {hours(remaining_s)} left  finished at {finish_clock(remaining_s)}"


@contextmanager
def progress(what: str, total: int, *, done: int = 0, timed: bool = True) -> Iterator[Report]:
    """Show how far some work is, with rate, remaining time and finish time.

    Yields
    ------
    callable
        ``report(done, total, note="")``, to be called as items are done.
    """
    if not sys.stderr.isatty():
        yield _line_reporter(what, Pace(done, total), timed=timed)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, SpinnerColumn, TextColumn
    from rich.table import Column
    from rich.text import Text

    class RateColumn(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(_rate(task))

    # On a narrow terminal the note is cut, and rate and time left; bar and count stay.
    rest = {"no_wrap": True, "overflow": "ellipsis"}
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True)),
        BarColumn(bar_width=None, table_column=Column(min_width=10, ratio=1)),
        MofNCompleteColumn(table_column=Column(no_wrap=True, min_width=2 * len(str(total)) + 1)),
        *([RateColumn(table_column=Column(ratio=3, **rest))] if timed else []),  # type: ignore[arg-type]
        TextColumn("{task.fields[note]}", markup=False, table_column=Column(ratio=3, **rest)),  # type: ignore[arg-type]
    )
    with Progress(*columns, console=people(), expand=True) as bar:
        task = bar.add_task(what, total=total, completed=done, note="")

        def report(done: int, total: int, note: str = "") -> None:
            bar.update(task, completed=done, total=total, note=note)

        yield report


class Pace:
    """Items a second; it begins anew where the number of items changes, since others begin then.

    done, total: Items that are done, and all.
    """

    def __init__(self, done: int, total: int) -> None:
        self._first, self._total, self._since_s = done, total, time.monotonic()

    def per_s(self, done: int, total: int) -> float:
        """Return the items a second so far, 0.0 while none is known."""
        now_s = time.monotonic()
        if total != self._total:
            self._first, self._total, self._since_s = done, total, now_s
        return (done - self._first) / max(now_s - self._since_s, 1e-3)


def _line_reporter(what: str, pace: Pace, *, timed: bool) -> Report:
    """Progress as a line now and then, for when nobody watches a terminal."""
    last_s = time.monotonic()

    def report(done: int, total: int, note: str = "") -> None:
        nonlocal last_s
        rate, now_s = pace.per_s(done, total), time.monotonic()
        if now_s - last_s < 30.0:
            return
        last_s = now_s
        if not timed:
            say(f"{what}: {done} of {total}, {note}")
            return
        left = f"{hours((total - done) / rate)} left" if rate > 0 else "no estimate yet"
        say(f"{what}: {done} of {total}, {rate:.1f}/s, {left} {note}".rstrip())

    return report


def print_line(line: str) -> None:
    """Write a line on standard output at once."""
    sys.stdout.write(line)
    sys.stdout.flush()
