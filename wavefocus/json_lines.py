"""JSON lines between a program and a command: events out, orders or answers in."""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress

from calibration.errors import InputError

# No order is longer; a line without an end must not fill the memory.
_MOST_BYTES = 1 << 16


class LinesOut:
    """Writes events to standard output, one JSON object per line, from any thread.

    Once nobody reads them any more they are dropped: `gone` then tells whoever works for that reader.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.gone = False

    def __call__(self, event: str, **facts: object) -> None:
        """Tell an event."""
        line = json.dumps({"event": event, **facts}, allow_nan=False)
        with self._lock:
            try:
                print(line, flush=True)
            except (OSError, ValueError):
                self.gone = True


class LinesIn:
    """Reads JSON objects from standard input in a thread of its own.

    Parameters
    ----------
    overtakes : callable, optional
        Called in that thread with each object as soon as it is there, before those that wait.
    """

    def __init__(self, overtakes: Callable[[Mapping[str, object]], object] = lambda _line: None) -> None:
        self._overtakes = overtakes
        self._lines: queue.SimpleQueue[Mapping[str, object] | InputError | None] = queue.SimpleQueue()
        self._over = False
        threading.Thread(target=self._read, name="orders", daemon=True).start()

    def next(self, timeout_s: float | None = None) -> Mapping[str, object] | None:
        """The next object; None at the end of the input, again and again.

        Parameters
        ----------
        timeout_s : float, optional
            Longest wait; without end, if absent.

        Raises
        ------
        TimeoutError
            None came in time.
        InputError
            A line that is no JSON object; the next call goes on after it.
        """
        if self._over:
            return None
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise TimeoutError from None
        if isinstance(line, InputError):
            raise line
        self._over = line is None
        return line

    def forget(self, keeps: Callable[[Mapping[str, object]], bool]) -> None:
        """Drop what waits, but for the end and for what is to be kept."""
        kept: list[Mapping[str, object] | InputError | None] = []
        with suppress(queue.Empty):
            while True:
                line = self._lines.get_nowait()
                if line is None or (not isinstance(line, InputError) and keeps(line)):
                    kept.append(line)
        for line in kept:
            self._lines.put(line)

    def _read(self) -> None:
        # Not through sys.stdin: its lock, held by a thread that waits, would hold up the end of the process.
        descriptor, rest = sys.stdin.fileno(), b""
        while True:
            try:
                block = os.read(descriptor, _MOST_BYTES)
            except OSError:
                block = b""
            *lines, rest = (rest + block).split(b"\n")
            if not block and rest.strip():
                lines.append(rest)
            elif len(rest) > _MOST_BYTES:
                lines, rest = [*lines, rest], b""
            for line in lines:
                if line.strip():
                    self._take(line)
            if not block:
                self._lines.put(None)
                return

    def _take(self, line: bytes) -> None:
        try:
            content = json.loads(line)
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            shown = line[:60].decode("utf-8", "replace").strip()
            self._lines.put(InputError(f"{shown!r} is no JSON object on one line"))
            return
        self._overtakes(content)
        self._lines.put(content)
