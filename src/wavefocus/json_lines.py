"""Messages between a program and a command as JSON lines: events out, orders or answers in."""

import codecs
import json
import math
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import NoReturn

from wavefocus.config.messages import AnyMessage, Message, MessageError, from_record, tag, to_line
from wavefocus.console import one_line, print_line
from wavefocus.storage.errors import InputError, WavefocusError

# No order is longer; a line without an end must not fill the memory.
_MAX_BYTES = 1 << 16


class LinesOut:
    """Writes messages to standard output, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __call__(self, message: Message) -> None:
        """Write a message; dropped where it cannot be written: who listens decides nothing of what is carried out."""
        line = to_line(message)
        with self._lock, suppress(OSError, ValueError):
            print_line(line)


class ReadingFailedError(WavefocusError):
    """Standard input is not read any more, though it has not come to its end."""


class LinesIn:
    """Reads JSON objects from standard input in a thread of its own, from `start` on."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[Mapping[str, object] | InputError | None] = queue.SimpleQueue()
        self._over = False
        self._failure: BaseException | None = None

    def start(
        self,
        on_line: Callable[[Mapping[str, object]], object] = lambda _line: None,
        on_error: Callable[[], object] = lambda: None,
        on_eof: Callable[[], object] = lambda: None,
    ) -> None:
        """Begin to read; `on_line` gets each object as it is read, `on_eof` is called after the last."""

        def read() -> None:
            try:
                self._read(on_line)
                on_eof()
            except BaseException as failure:  # raised again by `next`
                self._failure = failure
                try:
                    on_error()
                finally:
                    self._lines.put(None)

        threading.Thread(target=read, name="orders", daemon=True).start()

    def next(self, timeout_s: float | None = None) -> Mapping[str, object] | None:
        """The next object; None at the end of the input, again and again.

        Raises TimeoutError: none came in time. Raises InputError: A line that is no JSON object; the next call goes on
        after it. Raises ReadingFailedError: the reading thread has ended by an error; lines that wait are not worth
        anything any more.
        """
        if self._over:
            return None
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise TimeoutError from None
        if self._failure is not None:
            failure = self._failure
            said = f"{type(failure).__name__}: {failure}"
            raise ReadingFailedError(f"standard input cannot be read any more ({said})") from failure
        if isinstance(line, InputError):
            raise line
        self._over = line is None
        return line

    def discard(self, unless: Callable[[Mapping[str, object]], bool]) -> None:
        """Drop what waits, but for the end and for what is to be kept."""
        kept: list[Mapping[str, object] | InputError | None] = []
        with suppress(queue.Empty):
            while True:
                line = self._lines.get_nowait()
                if line is None or (not isinstance(line, InputError) and unless(line)):
                    kept.append(line)
        for line in kept:
            self._lines.put(line)

    def _read(self, on_line: Callable[[Mapping[str, object]], object]) -> None:
        for line, _ in input_objects():
            if not isinstance(line, InputError):
                on_line(line)
            self._lines.put(line)
        self._lines.put(None)


def input_objects() -> Iterator[tuple[Mapping[str, object] | InputError, float]]:
    """JSON objects on standard input, one a line, to its end, and when each was read, of `time.monotonic`.

    An InputError in place of the object for a line that is none.
    """
    try:
        # Not through sys.stdin: its lock, held by a thread that waits, would hold up the end of the process.
        descriptor, rest = sys.stdin.fileno(), b""
    except (OSError, ValueError):  # nothing stands behind it
        return
    while True:
        try:
            block = os.read(descriptor, _MAX_BYTES)
        except OSError:
            block = b""
        read_s = time.monotonic()
        *lines, rest = (rest + block).split(b"\n")
        if not block and rest.strip():
            lines.append(rest)
        elif len(rest) > _MAX_BYTES:
            lines, rest = [*lines, rest], b""
        for line in lines:
            # Some programs (PowerShell) begin what they write with a byte-order mark.
            text = line.removeprefix(codecs.BOM_UTF8)
            if text.strip():
                yield _object(text), read_s
        if not block:
            return


def _object(line: bytes) -> Mapping[str, object] | InputError:
    try:
        content = json.loads(line.decode(), parse_float=_finite, parse_constant=_refused)
    except (ValueError, RecursionError):
        content = None
    if isinstance(content, dict):
        return content
    shown = line[:60].decode("utf-8", "replace").strip()
    return InputError(f"{shown!r} is no JSON object on one line, or holds a number that is not finite")


def read_order(content: Mapping[str, object], kinds: Iterable[type[AnyMessage]]) -> AnyMessage:
    """Read an object as an order of one of some kinds. Raises InputError: it is none of them, or a key is wrong."""
    named = {tag(kind): kind for kind in kinds}
    word = content.get("order")
    if not isinstance(word, str) or word not in named:
        raise InputError(f"order {one_line(repr(word), 60)} is not known; allowed: {', '.join(named)}")
    try:
        return from_record(named[word], content)
    except MessageError as wrong:
        raise wrong_order(word, wrong) from None


def wrong_order(word: str, wrong: MessageError) -> InputError:
    """Make the error about the content of an order."""
    return InputError(one_line(f"{word}: {wrong}", 300))


def _finite(digits: str) -> float:
    """A number as written; JSON has none that is not finite, so that an answer could not repeat it."""
    number = float(digits)
    return number if math.isfinite(number) else _refused(digits)


def _refused(digits: str) -> NoReturn:
    raise ValueError(digits)
