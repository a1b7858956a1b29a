"""Messages between this process and one that runs a driver: a line of JSON, then raw bytes."""

from __future__ import annotations

import json
import threading
from typing import IO, Any

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
