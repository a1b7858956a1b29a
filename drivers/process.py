"""A driver in a process of its own: every wait for it has an end, and a process that hangs is killed."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TypeVar

Message = dict[str, Any]

BYTES = "bytes"


class MessagePipe:
    """One end of a pair of pipes; several threads may send, one receives.

    Parameters
    ----------
    incoming, outgoing : binary file
        What is read, and what is written.
    """

    def __init__(self, incoming: IO[bytes], outgoing: IO[bytes]) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._lock = threading.Lock()

    def send(self, message: Message, payload: bytes | memoryview = b"") -> None:
        """Write one message.

        Parameters
        ----------
        message : dict
            What JSON can hold.
        payload : bytes
            Goes along.

        Raises
        ------
        OSError, ValueError
            The other end, or this one, is closed.
        """
        line = json.dumps({**message, BYTES: len(payload)}).encode() + b"\n"
        with self._lock:
            self._outgoing.write(line)
            self._outgoing.write(payload)
            self._outgoing.flush()

    def receive(self) -> tuple[Message, bytes] | None:
        """Wait for the next message; None when the other end is closed, be it in the middle of one."""
        line = self._incoming.readline()
        if not line.endswith(b"\n"):
            return None
        message: Message = json.loads(line)
        size = message.pop(BYTES)
        payload = self._incoming.read(size)
        return (message, payload) if len(payload) == size else None


ANSWER_S = 5.0
"""A process that is well answers within milliseconds; on a busy machine within a second."""

LOOK_S = 0.5
"""How often a process that is waited for is asked for a sign of life."""

OPENING_S = 20.0
"""Loading PortAudio and opening a device; ASIO drivers take seconds."""

CLOSING_S = 6.0
"""Longer than the process allows itself."""

Value = TypeVar("Value")


class ProcessGoneError(Exception):
    """The process ended, or was killed because it hung.

    Parameters
    ----------
    cause : str
        What happened.
    """

    def __init__(self, cause: str) -> None:
        super().__init__(cause)
        self.cause = cause


class DriverProcess:
    """Starts a module as a process and talks with it; safe to use from several threads.

    Parameters
    ----------
    module : str
        What runs there; it reads and writes `drivers.process.MessagePipe` on its standard input and output.
    name : str
        What the process is, for messages: ``"the process that owns its stream"``.
    environment : mapping from str to str
        Added to the environment of this process.
    receive : callable
        Gets every message and its payload, in order, in a thread of its own, and with the lock of `wait_for` held.
    defaults : mapping from str to str, optional
        Added where this process's environment has not the variable.
    """

    def __init__(
        self,
        module: str,
        name: str,
        environment: Mapping[str, str],
        receive: Callable[[Message, bytes], None],
        defaults: Mapping[str, str] | None = None,
    ) -> None:
        self._name = name
        self._receive = receive
        self._news = threading.Condition()
        self._gone = ""
        self._heard_s = time.monotonic()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process, in close()
        root = str(Path(__file__).parents[1])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            # -P: a file in the working directory must not pass for a module of ours.
            [sys.executable, "-P", "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={
                "OPENBLAS_NUM_THREADS": "1",  # it adds and multiplies nothing
                **(defaults or {}),
                **os.environ,
                **environment,
                "PYTHONPATH": os.pathsep.join(paths),
            },
            # Ctrl-C and a closing terminal are this process's to answer.
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._pipe = MessagePipe(self._process.stdout, self._process.stdin)
        self._reader = threading.Thread(target=self._read, name=f"answers of {module}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def gone(self) -> str:
        """Why the process is gone; empty while it lives."""
        return self._gone

    def send(self, *messages: tuple[Message, bytes | memoryview]) -> None:
        """Send messages in a row; a process that does not take them in time is killed.

        Parameters
        ----------
        messages : tuple of message and payload
            As of `drivers.process.MessagePipe.send`.

        Raises
        ------
        ProcessGoneError
            It is gone.
        """
        if self._gone:
            raise ProcessGoneError(self._gone)
        guard = threading.Timer(ANSWER_S, self.kill, [f"it took nothing in for {ANSWER_S:g} s and was killed"])
        guard.daemon = True
        guard.start()
        try:
            for message, payload in messages:
                self._pipe.send(message, payload)
        except (OSError, ValueError):
            raise ProcessGoneError(self._why()) from None
        finally:
            guard.cancel()

    def wait_for(self, look: Callable[[], Value | None], until_s: float) -> Value | None:
        """Wait for news; the process is asked for a sign of life meanwhile.

        Parameters
        ----------
        look : callable
            Gives what is waited for, None as long as it is not there; called with the lock held.
        until_s : float
            When to give up, of `time.monotonic`.

        Returns
        -------
        object
            What `look` gave, None if the time is up.

        Raises
        ------
        ProcessGoneError
            The process is gone, or showed no sign of life and was killed.
        """
        asked_s, silent_s, looked_s = -math.inf, 0.0, time.monotonic()
        while True:
            with self._news:
                self._news.wait_for(lambda: look() is not None or self._gone, min(max(0.0, until_s - looked_s), LOOK_S))
                value = look()
                if value is not None:
                    return value
                if self._gone:
                    raise ProcessGoneError(self._gone)
                heard_s = self._heard_s
            now_s = time.monotonic()
            if now_s >= until_s:
                return None
            # Time in which this process itself was kept waiting does not count against the other.
            silent_s += min(now_s - looked_s, 2 * LOOK_S)
            looked_s = now_s
            if heard_s > asked_s:
                asked_s, silent_s = now_s, 0.0
                try:
                    self.send(({"do": "ask"}, b""))
                except ProcessGoneError:
                    self._reader.join(ANSWER_S)  # what it said before it went may be what is waited for
                    with self._news:
                        value = look()
                    if value is None:
                        raise
                    return value
            elif silent_s > ANSWER_S:
                self.kill(f"{self._name} did not answer for {ANSWER_S:g} s and was killed")

    def kill(self, cause: str) -> None:
        """End the process at once; what it played falls silent with it.

        Parameters
        ----------
        cause : str
            Why, for whoever asks later.
        """
        with self._news:
            self._gone = self._gone or cause
            self._news.notify_all()
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # held in a driver's call; it makes no more sound
            self._process.wait(ANSWER_S)

    def close(self) -> None:
        """See the process end, killing it if it does not."""
        try:
            self._process.wait(CLOSING_S)
        except subprocess.TimeoutExpired:
            self.kill("it did not end and was killed")
        self._reader.join(CLOSING_S)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        for pipe in (self._process.stdin, self._process.stdout, self._errors):
            try:
                pipe.close()
            except BrokenPipeError:  # what could not be told it will not miss
                continue

    def _read(self) -> None:
        while (received := self._pipe.receive()) is not None:
            message, payload = received
            with self._news:
                self._heard_s = time.monotonic()
                if message["is"] == "lost":
                    self._gone = self._gone or str(message["cause"])
                self._receive(message, payload)
                self._news.notify_all()
        why = self._why()
        with self._news:
            self._gone = self._gone or why
            self._news.notify_all()

    def _why(self) -> str:
        """Why the pipe is closed, as far as can be told."""
        if self._gone:
            return self._gone
        try:
            code = self._process.wait(ANSWER_S)
        except subprocess.TimeoutExpired:
            return f"{self._name} closed its pipe"
        self._errors.seek(0)
        told = self._errors.read().decode(errors="replace").strip().splitlines()
        last = f", its last words {told[-1]!r}" if told else ""
        return f"{self._name} ended with code {code}{last}"
