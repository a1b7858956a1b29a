"""What a serial far side hangs on: a pseudo-terminal behind a stable link, or a TCP port.

Both come back at the same address after they were unplugged. A pseudo-terminal is a full serial port to the
near side, but POSIX alone has it; the TCP port is there for every other system.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from pathlib import Path
from typing import Protocol

CHUNK = 4096


class Wire(Protocol):
    """The far end of a serial line; one thread alone uses it."""

    @property
    def address(self) -> str:
        """What the near side opens."""
        ...

    def plug(self) -> None:
        """Make the port appear."""
        ...

    def unplug(self) -> None:
        """Make the port vanish, with whatever has it open."""
        ...

    def receive(self, timeout_s: float, wake: socket.socket) -> bytes:
        """What has come in; waits up to `timeout_s`, or until there is something to read at `wake`."""
        ...

    def send(self, data: bytes) -> None:
        """Send; what the near side does not take is lost, as with a device that has no handshake."""
        ...

    def baud(self) -> int | None:
        """Bits per second that the near side has chosen; None where it cannot be read."""
        ...


class PtyWire:
    """A pseudo-terminal; POSIX alone. Raises OSError.

    link: Where the port appears: a symbolic link, the same after each unplugging.
    """

    def __init__(self, link: Path) -> None:
        if os.name != "posix":
            raise OSError("this system has no pseudo-terminals; use TcpWire")
        self._link = link
        self._ends: tuple[int, int] | None = None

    @property
    def address(self) -> str:
        return str(self._link)

    def plug(self) -> None:
        import tty

        far, near = os.openpty()
        # Nothing may be echoed or translated before the near side sets the port up.
        tty.setraw(near)
        os.set_blocking(far, False)
        # The near end stays open here too, so that the far end does not fail when the near side closes it.
        self._ends = (far, near)
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.symlink_to(os.ttyname(near))
        fresh.replace(self._link)

    def unplug(self) -> None:
        self._link.unlink(missing_ok=True)
        ends, self._ends = self._ends, None
        for end in ends or ():
            os.close(end)

    def receive(self, timeout_s: float, wake: socket.socket) -> bytes:
        sources: list[int | socket.socket] = [wake] if self._ends is None else [wake, self._ends[0]]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._ends is None or self._ends[0] not in ready:
            return b""
        return os.read(self._ends[0], CHUNK)

    def send(self, data: bytes) -> None:
        if self._ends is not None:
            with contextlib.suppress(BlockingIOError):
                os.write(self._ends[0], data)

    def baud(self) -> int | None:
        if self._ends is None:
            return None
        import termios

        speed = termios.tcgetattr(self._ends[1])[5]
        names = {getattr(termios, name): name for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
        return int(names[speed][1:]) if speed in names else None


class TcpWire:
    """A TCP port that serves one connection at a time, and closes any further one at once.

    host: Address to listen at.
    port: 0 for any free one, which is kept from then on.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0) -> None:
        self._reserved: socket.socket | None = self._bound((host, port))
        self._at: tuple[str, int] = self._reserved.getsockname()[:2]
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def address(self) -> str:
        return f"socket://{self._at[0]}:{self._at[1]}"

    def plug(self) -> None:
        if self._reserved is None:
            self._reserved = self._bound(self._at)
        self._listener, self._reserved = self._reserved, None
        self._listener.listen(1)

    def unplug(self) -> None:
        for one in (self._client, self._listener):
            if one is not None:
                one.close()
        self._client = self._listener = None
        # Bound and not listening: connections are refused, and nobody else gets the number.
        with contextlib.suppress(OSError):
            self._reserved = self._reserved or self._bound(self._at)

    def free(self) -> None:
        """Let go of the port's number, for good."""
        if self._reserved is not None:
            self._reserved.close()
            self._reserved = None

    def receive(self, timeout_s: float, wake: socket.socket) -> bytes:
        sources = [one for one in (wake, self._listener, self._client) if one is not None]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._client in ready and self._client is not None:
            try:
                data = self._client.recv(CHUNK)
            except OSError:
                data = b""
            if not data:
                self._client.close()
                self._client = None
            return data
        if self._listener in ready and self._listener is not None:
            self._accept(self._listener)
        return b""

    def send(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)

    def baud(self) -> int | None:
        return None

    def _accept(self, listener: socket.socket) -> None:
        client, _ = listener.accept()
        if self._client is not None:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client

    @staticmethod
    def _bound(address: tuple[str, int]) -> socket.socket:
        one = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        # On POSIX a number may be bound again while old connections still fade; on Windows this means another thing.
        if os.name == "posix":
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(address)
        except OSError:
            one.close()
            raise
        return one
