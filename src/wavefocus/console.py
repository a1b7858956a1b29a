"""What people see of a command: lines and a bar on standard error, one line for an error, and the exit code."""

from __future__ import annotations

import errno
import io
import os
import sys
import time
import traceback
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import IntEnum
from functools import cache
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, TYPE_CHECKING, Protocol, TextIO, cast

from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.drivers.errors import InstrumentError, MissingPackageError
from wavefocus.storage.errors import BankBusyError, InputError, WavefocusError
from wavefocus.storage.text_file import permission_words

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer
    from rich.console import Console
    from rich.progress import Task
    from rich.status import Status

STAND_IN = "wavefocus_stand_in"
"""Attribute of a standard stream that was closed when the process began, and has the null device in its place."""


class Exit(IntEnum):
    """Exit codes, as the public contract states them."""

    DONE = 0
    NOT_GOOD_ENOUGH = 1
    WRONG_INPUT = 2
    INSTRUMENT_FAILED = 3
    DEFECT = 70
    BANK_BUSY = 75
    STOPPED = 130


def exit_code(failure: BaseException) -> Exit:
    """The exit code of an error, by what it means to a person; what no check foresees is a defect of the program."""
    match failure:
        case KeyboardInterrupt():
            return Exit.STOPPED
        case BankBusyError():
            return Exit.BANK_BUSY
        case ModuleNotFoundError() if _missing_package(failure):
            return Exit.WRONG_INPUT
        case InputError() | OSError() | MissingPackageError():
            return Exit.WRONG_INPUT
        case _ if _is_beyond_memory(failure):  # what a file asks for can be
            return Exit.WRONG_INPUT
        case InstrumentError() | WavefocusError():
            return Exit.INSTRUMENT_FAILED
    return Exit.DEFECT


def _is_beyond_memory(failure: BaseException) -> bool:
    """Whether the system gave no more memory, or no further thread, which Python reports in words alone."""
    return isinstance(failure, MemoryError) or (
        isinstance(failure, RuntimeError) and str(failure) == "can't start new thread"
    )


def sentence(failure: BaseException) -> str:
    """The one line that reports an error."""
    if isinstance(failure, KeyboardInterrupt):
        return "stopped by the user"
    if _is_beyond_memory(failure):
        return one_line(f"not enough memory: {failure}")
    if isinstance(failure, OSError) and failure.filename is not None:
        denied = permission_words(Path(failure.filename)) if isinstance(failure, PermissionError) else ""
        return one_line(f"{failure.filename}: {failure.strerror}{denied}")
    if isinstance(failure, ModuleNotFoundError) and (package := _missing_package(failure)):
        installed = f"wavefocus[{EXTRAS[package]}]" if package in EXTRAS else package
        return f'the Python package {package} is not installed: pip install "{installed}"'
    return one_line(str(failure)) or type(failure).__name__


def account(failure: BaseException, code: Exit, arguments: Sequence[str]) -> str:
    """The one line about an error; with the files of the command line where its own text names none."""
    if code is Exit.STOPPED:
        return sentence(KeyboardInterrupt())
    if code is not Exit.DEFECT and not _is_beyond_memory(failure):
        return sentence(failure)
    named = [word.partition("=")[2] if word.startswith("--") else word for word in arguments]
    files = "".join(f"{word}: " for word in named if Path(word).is_file())
    if code is not Exit.DEFECT:
        return one_line(f"{files}{sentence(failure)}")
    kind = type(failure).__name__
    said = "" if sentence(failure) == kind else f": {sentence(failure)}"
    return one_line(f"{files}defect of the program: {kind}{said}; {_logged(failure)}")


def _logged(failure: BaseException) -> str:
    """Write the traceback to a new file, and say where it is."""
    text = "".join(traceback.format_exception(failure))
    try:
        with NamedTemporaryFile(
            "w", prefix="wavefocus-defect-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(text)
    except OSError:
        return "WAVEFOCUS_TRACEBACK=1 shows where"
    return f"please report it with {file.name}, which says where"


# Packages that only some commands need, by the extra of pyproject.toml that installs them.
EXTRAS = {
    "PyQt5": "window", "pyqtgraph": "window", "grpc": "remote", "jack": "emulate", "skfem": "plates",
    "xarray": "exchange", "h5netcdf": "exchange", "apprise": "notify", "dask": "cluster", "distributed": "cluster",
}  # fmt: skip


def _missing_package(failure: ModuleNotFoundError) -> str:
    """The package that is not installed; empty where a module of wavefocus itself is missing, which is a defect."""
    package = (failure.name or "").partition(".")[0]
    return "" if package == "wavefocus" else package


# Control, format (bidirectional overrides among them), surrogate, line and paragraph separator.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_LONGEST = 900


def escaped(text: str) -> str:
    r"""Return a text with control and bidirectional characters as escapes (``\x1b``); line ends and tabs stay."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter.encode("unicode_escape").decode()
        if unicodedata.category(letter) in _UNSAFE and letter not in "\n\t"
        else letter
        for letter in text
    )


def one_line(text: str, longest: int = _LONGEST) -> str:
    """A message as one escaped line of bounded length: what is too long loses its middle."""
    line = escaped(" ".join(text.split()))
    if len(line) <= longest:
        return line
    head = longest // 2
    tail = longest - head - 5
    return f"{line[:head]} ... {line[-tail:]}"


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

    @classmethod
    def in_place_of(cls, stream: TextIO) -> TextIO:
        """A stream that takes the place of standard output; a terminal stays as it is."""
        try:
            if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
                stream.reconfigure(errors="backslashreplace")  # a letter that its encoding lacks is no defect
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
