"""A command that talks in JSON lines, in a process that rests its instruments when the window lets go of it."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import IO

from gui.shell.apart import leave, start_apart
from gui.shell.front_door import FrontDoor
from gui.shell.tab import TabContext, error_text

Told = dict[str, object]

_STOPS = signal.SIGTERM if os.name == "posix" else signal.Signals(getattr(signal, "CTRL_BREAK_EVENT", 15))
_LINES_KEPT = 50
_KILLED = (
    "ended without a good-bye: its process was killed, or the machine ran out of memory; the laser may stand where it "
    "was, so park it, or switch it off"
)


class LinesProcess:
    """A command whose answers are read by threads and taken by the window when it has time.

    It is never killed when the window goes: its standard input ends, upon which it mutes, parks and ends by itself.

    Parameters
    ----------
    front : FrontDoor
        Starts commands.
    arguments : sequence of str
        Command and arguments.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(self, front: FrontDoor, arguments: Sequence[str]) -> None:
        self._what = arguments[0]
        pipe = subprocess.PIPE
        self._process = start_apart([*front.command, *arguments], stdin=pipe, stdout=pipe, stderr=pipe)
        self._told: queue.SimpleQueue[Told] = queue.SimpleQueue()
        self._said: deque[str] = deque(maxlen=_LINES_KEPT)
        self._threads = [
            threading.Thread(target=read, args=(stream,), name=f"{self._what} {name}", daemon=True)
            for name, read, stream in (
                ("answers", self._read, self._process.stdout),
                ("words", self._listen, self._process.stderr),
            )
        ]
        for thread in self._threads:
            thread.start()

    @classmethod
    def started(cls, context: TabContext, arguments: Sequence[str], failing: str) -> LinesProcess | None:
        """Start one; where that fails, None, and a message that begins with `failing`."""
        try:
            return cls(context.front, arguments)
        except OSError as failure:
            context.messages.fault(f"{failing}: {error_text(failure)}")
            return None

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def exit_code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._process.poll()

    @property
    def said(self) -> list[str]:
        """The last lines that it told people."""
        return list(self._said)

    def kill(self) -> None:
        """End it by force."""
        self._process.kill()

    def hand_over(self, hear: Callable[[Told], object]) -> bool:
        """Give `hear` what it told since the last look; whether it has ended, and that was all."""
        over = self._process.poll() is not None and not any(thread.is_alive() for thread in self._threads)
        told = []
        with suppress(queue.Empty):
            while True:
                told.append(self._told.get_nowait())
        if over:
            self.end()
        for line in told:
            hear(line)
        return over

    def send(self, **line: object) -> None:
        """Give it an order or an answer; one that is gone hears nothing, which its end tells."""
        stdin = self._process.stdin
        if stdin is not None and not stdin.closed:
            with suppress(OSError, ValueError):
                stdin.write(json.dumps(line).encode() + b"\n")
                stdin.flush()

    def end(self) -> None:
        """Say that nothing more comes: it puts its instruments to rest and ends."""
        stdin = self._process.stdin
        if stdin is not None:
            with suppress(OSError, ValueError):
                stdin.close()

    def interrupt(self) -> None:
        """Ask it to stop what it does; it puts its instruments to rest first."""
        if self._process.poll() is None:
            self._process.send_signal(_STOPS)

    def ending(self) -> str:
        """How it ended, in a sentence; empty when all went well or while it runs."""
        code = self.exit_code
        if code is None or code == 0:
            return ""
        if code < 0:
            return f"wavefocus {self._what} {_KILLED}"
        said = self._said[-1].removeprefix("wavefocus: ") if self._said else ""
        return said or f"wavefocus {self._what} ended with exit code {code}"

    def let_go(self) -> None:
        """Leave it to its way out, without a parent that would wait for it."""
        self.end()
        leave(self._process)

    def _read(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                with suppress(ValueError, RecursionError):
                    content = json.loads(line)
                    if isinstance(content, dict):
                        self._told.put(content)

    def _listen(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                if words := line.decode("utf-8", "replace").strip():
                    self._said.append(words)
