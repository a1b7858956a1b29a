"""A driver in a process of its own: every wait for it has an end, and a process that hangs is killed.

`wavefocus.drivers.timeouts` bounds each call to an instrument, and can only abandon a thread that hangs. A process is
asked for a sign of life and killed within seconds, which silences its outputs and frees its device. It gets a sign of
life from its parent, too: where the parent is stopped (SIGSTOP, Ctrl-Z, a debugger), the process puts its outputs to
rest.

Messages are words, or tuples that begin with one, pickled: both ends are this package, started by one another.
"""

import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TypeVar

ANSWER_S = 5.0
"""A process that is well answers within milliseconds; on a busy machine within a second."""

_LOOK_S = 0.5
"""How often a process that is waited for is asked for a sign of life."""

OPENING_S = 20.0
"""Loading a vendor's library and opening a device; ASIO drivers take seconds."""

_CLOSING_S = 6.0
"""Longer than the process allows itself."""

SILENT_S = 5.0
"""A parent that gives no sign of life for so long is stopped; a busy one is late by a second."""

_STOPPED = (
    f"this program was stopped for more than {SILENT_S:g} s (Ctrl-Z, SIGSTOP or a debugger), and its outputs were put"
    " to rest meanwhile"
)

Value = TypeVar("Value")


ASK = "ask"
"""Asks a process for a sign of life."""

ALIVE = "alive"
"""A sign of life: the process's answer to `ASK`, and the parent's of its own accord."""

CLOSE = "close"
"""Asks a process to release its device and end."""

AT_REST = ("lost", _STOPPED, True)
"""The last message of a process whose parent is stopped: "lost", the cause, and that its outputs are at rest."""


class MessagePipe:
    """One end of a pair of pipes; several threads may send, one receives.

    received: Number of messages so far.
    """

    def __init__(self, incoming: IO[bytes], outgoing: IO[bytes]) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._lock = threading.Lock()
        self.received = 0

    def send(self, message: object) -> None:
        """Write one message. Raises OSError or ValueError where either end is closed."""
        with self._lock:
            pickle.dump(message, self._outgoing, pickle.HIGHEST_PROTOCOL)
            self._outgoing.flush()

    def try_send(self, message: object) -> None:
        """Write one message, or nothing where the other end is closed: the reader there notices, too."""
        with suppress(OSError):
            self.send(message)

    def close(self) -> None:
        """Close both pipes."""
        for pipe in (self._outgoing, self._incoming):
            with suppress(BrokenPipeError):  # messages that the other end did not read
                pipe.close()

    def receive(self) -> Any:
        """Wait for the next message; None when the other end is closed, be it in the middle of one."""
        try:
            message = pickle.load(self._incoming)
        except (EOFError, pickle.UnpicklingError):
            return None
        self.received += 1
        return message


def pipe_to_parent() -> MessagePipe:
    """The pipe of a process that `DriverProcess` started; to be called first thing there."""
    # Ctrl-C reaches every process of a terminal; the parent decides what stops, and when.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Vendors' libraries print where they please; the answers go where nothing else does.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return MessagePipe(sys.stdin.buffer, answers)


def wait_for_silence(pipe: MessagePipe) -> None:
    """In the process, in a thread of its own: return when the parent has given no sign of life for `SILENT_S`."""
    silent_s, looked_s, received = 0.0, time.monotonic(), pipe.received
    while silent_s < SILENT_S:
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
        # Time in which this process itself was kept waiting, or the computer slept, does not count.
        silent_s = 0.0 if pipe.received != received else silent_s + min(now_s - looked_s, 2 * _LOOK_S)
        looked_s, received = now_s, pipe.received


class ProcessGoneError(Exception):
    """The process ended, or was killed because it hung; its text is the cause."""


class DriverProcess:
    """Starts a module's `main` as a process and talks with it; safe to use from several threads.

    module: Its function ``main`` runs there, on `pipe_to_parent`.
    name: What the process is, for messages: ``"the process that owns its stream"``.
    receive: Gets every message, in order, in a thread of its own, and with the lock of `wait_for` held.
    environment: Added to the environment of this process.

    gone: Why the process is gone; empty while it lives.
    at_rest: It is gone, and has put its outputs to rest before.
    pid: Process id.
    """

    def __init__(
        self,
        module: str,
        name: str,
        receive: Callable[[Any], None],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._name = name
        self._receive = receive
        self._news = threading.Condition()
        self.gone = ""
        self.at_rest = False
        self._answered_s = time.monotonic()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process, in close()
        root = str(Path(__file__).parents[2])  # holds wavefocus/
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            # -P: a file in the working directory must not pass for a module of ours.
            [sys.executable, "-P", "-c", f"from {module} import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={
                "OPENBLAS_NUM_THREADS": "1",  # it adds and multiplies nothing
                **os.environ,
                **(environment or {}),
                "PYTHONPATH": os.pathsep.join(paths),
            },
            # Ctrl-C and a closing terminal are this process's to answer.
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.pid = self._process.pid
        self._pipe = MessagePipe(self._process.stdout, self._process.stdin)
        self._reader = threading.Thread(target=self._read, name=f"answers of {module}", daemon=True)
        self._reader.start()
        self._ending = threading.Event()
        self._signs = threading.Thread(target=self._give_signs, name=f"signs of life for {module}", daemon=True)
        self._signs.start()

    def send(self, *messages: object) -> None:
        """Send messages in a row; a process that does not take them in time is killed. Raises ProcessGoneError."""
        if self.gone:
            raise ProcessGoneError(self.gone)
        sent = threading.Event()
        threading.Thread(target=self._kill_unless, args=(sent,), daemon=True).start()
        try:
            for message in messages:
                self._pipe.send(message)
        except (OSError, ValueError):
            self._reader.join(ANSWER_S)  # its last message says why
            raise ProcessGoneError(self._why()) from None
        finally:
            sent.set()

    def _kill_unless(self, sent: threading.Event) -> None:
        began_s = time.monotonic()
        while not sent.wait(ANSWER_S):
            now_s = time.monotonic()
            if now_s - began_s < ANSWER_S + 1.0:  # longer: this process itself was stopped meanwhile
                self.kill(f"it took nothing in for {ANSWER_S:g} s and was killed")
                return
            began_s = now_s

    def wait_for(self, look: Callable[[], Value | None], until_s: float, *, asks: bool = True) -> Value | None:
        """Wait for news; the process is asked for a sign of life meanwhile. Raises ProcessGoneError.

        look: Gives what is waited for, None as long as it is not there; called with the lock held.
        until_s: When to give up, of `time.monotonic`; later by what this process was stopped meanwhile.
        asks: False where it cannot answer meanwhile: while it loads its packages and opens its device.

        Returns object: what `look` gave, None if the time is up.
        """
        asked_s, silent_s, looked_s = -math.inf, 0.0, time.monotonic()
        while True:
            with self._news:
                self._news.wait_for(lambda: look() is not None or self.gone, min(max(0.0, until_s - looked_s), _LOOK_S))
                value = look()
                if value is not None:
                    return value
                if self.gone:
                    raise ProcessGoneError(self.gone)
                answered_s = self._answered_s
            now_s = time.monotonic()
            # Time in which this process itself was stopped or kept waiting does not count against the other.
            until_s += max(0.0, now_s - looked_s - 2 * _LOOK_S)
            if now_s >= until_s:
                return None
            silent_s += min(now_s - looked_s, 2 * _LOOK_S)
            looked_s = now_s
            if not asks:
                continue
            if answered_s >= asked_s:  # equal: an answer within one step of a coarse clock
                asked_s, silent_s = now_s, 0.0
                try:
                    self.send(ASK)
                except ProcessGoneError:
                    with self._news:  # what it said before it went may be what is waited for
                        value = look()
                    if value is None:
                        raise
                    return value
            elif silent_s > ANSWER_S:
                self.kill(f"{self._name} did not answer for {ANSWER_S:g} s and was killed")

    def kill(self, cause: str) -> None:
        """End the process at once, with whatever it plays; `cause` is for later calls."""
        with self._news:
            self.gone = self.gone or cause
            self._news.notify_all()
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # held in a driver's call; it makes no more sound
            self._process.wait(ANSWER_S)

    def close(self) -> None:
        """Ask the process to end, see it end, and kill it if it does not."""
        try:
            self.send(CLOSE)
        except ProcessGoneError as gone:
            self.kill(str(gone))
        try:
            self._process.wait(_CLOSING_S)
        except subprocess.TimeoutExpired:
            self.kill("it did not end and was killed")
        self._ending.set()
        self._reader.join(_CLOSING_S)
        self._signs.join(_CLOSING_S)
        self._pipe.close()
        self._errors.close()

    def _give_signs(self) -> None:
        # A sign of life to the process each second.
        while not self._ending.wait(1.0) and not self.gone:
            with suppress(OSError, ValueError):
                self._pipe.send(ALIVE)

    def _read(self) -> None:
        while (message := self._pipe.receive()) is not None:
            with self._news:
                self._answered_s = time.monotonic()
                match message:
                    case ("lost", cause, at_rest):
                        self.gone, self.at_rest = self.gone or cause, at_rest
                    case _:
                        self._receive(message)
                self._news.notify_all()
        why = self._why()
        with self._news:
            self.gone = self.gone or why
            self._news.notify_all()

    def _why(self) -> str:
        """Why the pipe is closed, as far as it can be found out."""
        if self.gone:
            return self.gone
        try:
            code = self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            return f"{self._name} closed its pipe"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        last = f", its last words {lines[-1]!r}" if lines else ""
        return f"{self._name} ended with code {code}{last}"
