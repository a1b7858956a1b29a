"""A device on a serial line, with faults on order, and the two kinds of wire that it hangs on.

A wire comes back at the same address after it was unplugged. A pseudo-terminal behind a stable link is a full serial
port to the client, but only POSIX has it; the TCP port is there for every other system.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from pathlib import Path

from wavefocus.config.emulation import WireFault
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire import WireFaultPlan

_IDLE_S = 0.5
_TICK_S = 0.01
_CHUNK = 4096


class SerialDevice(ABC):
    """A device on a serial line that answers commands as its manual says.

    role: ``"mirror"`` or ``"vibrometer"``.
    baud: Bits per second that it listens at.
    command_end: The character that ends a command.
    """

    role: str
    baud: int = 115200
    command_end: str = "\n"

    @abstractmethod
    def operation(self, command: str) -> str:
        """The verb of a command in fault plans: identify, move, park, busy, where, enable, or its own."""

    @abstractmethod
    def answer(self, command: str) -> str:
        """Carry a command out and answer it, line ends included; empty where there is no answer."""

    @abstractmethod
    def refusal(self, command: str) -> str:
        """An error code in place of an answer."""

    @abstractmethod
    def impostor(self, command: str) -> str:
        """What another device would answer to the question who it is."""

    @abstractmethod
    def restart(self) -> None:
        """Forget what power-off makes it forget."""

    def banner(self) -> str:
        """What it sends by itself once it has started."""
        return ""


class MirrorDevice(SerialDevice):
    """A controller with one mirror, as the commands of a dialect reach it."""

    role = "mirror"
    name: str

    def __init__(self, motion: MirrorMotion) -> None:
        self._motion = motion

    @classmethod
    def turning(cls, motion: MirrorMotion, full_scale_mrad: float | None) -> MirrorDevice:
        """A device whose mirror turns by this angle at full deflection, by default as far as its kind does."""
        return cls(motion)

    def restart(self) -> None:
        self._motion.start(0.0, 0.0)


def number(text: str | None) -> float | None:
    """The number that a text is, or None."""
    return float(text) if text is not None and re.fullmatch(r"[+-]?(?:\d+\.?\d*|\.\d+)", text) else None


def garble(answer: bytes) -> bytes:
    """An answer as a bad line delivers it: every other byte with its top bit set, the line's end as it was."""
    body = answer.rstrip(b"\r\n")
    return bytes(byte | 0x80 if index % 2 == 0 else byte for index, byte in enumerate(body)) + answer[len(body) :]


class EmulatedSerial:
    """Serves a device on a wire, in a thread of its own, until it is closed.

    Faults: *silent*: the command is lost on its way. *late*: the answer comes `seconds` late. *truncated*: half of
    the answer comes, without an end. *garbled*: see `garble`. *stalled*: from then on nothing is read for `seconds`,
    0 until the next unplugging. *refused*: an error code. *unplugged*: the port vanishes for `seconds`, 0 until
    :meth:`plug`. *impostor*: another device says who it is. *restarted*: it is switched off and on in place of
    obeying; then comes what it sends by itself.

    wire: What it hangs on; closed with the emulated instrument.
    faults: What goes wrong, by the device's role.
    garbler: Turns an answer into a garbled one.
    """

    def __init__(
        self,
        device: SerialDevice,
        wire: Wire,
        faults: WireFaultPlan | None = None,
        garbler: Callable[[bytes], bytes] = garble,
    ) -> None:
        self._device = device
        self._wire = wire
        self._faults = faults or WireFaultPlan(device.role)
        self._garbler = garbler
        self._thread = threading.Thread(target=self._serve, name=f"{device.role} emulated instrument", daemon=True)
        self._orders: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        self._bell, self._wake = socket.socketpair()
        self._wake.setblocking(False)
        self._stopping = threading.Event()
        self._plugged = False
        self._plug_at_s: float | None = None
        self._read_again_s = 0.0
        self._input = b""
        self._commands: deque[str] = deque(maxlen=1000)

    @property
    def address(self) -> str:
        """What goes into a rig file as port."""
        return self._wire.address

    @property
    def commands(self) -> tuple[str, ...]:
        """The latest commands, as they came in."""
        return tuple(self._commands)

    def start(self) -> EmulatedSerial:
        """Make the port appear and serve it."""
        self._wire.plug()
        self._plugged = True
        self._thread.start()
        return self

    def unplug(self) -> None:
        """Pull the plug: the port vanishes, and what has it open gets errors."""
        self._order(lambda: self._unplug(0.0))

    def plug(self) -> None:
        """Plug in again, at the same address; the device starts anew."""
        self._order(self._plug)

    def close(self) -> None:
        """Stop serving, and remove the port. Twice does no harm."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        self._ring()
        if self._thread.is_alive():
            self._thread.join()
        self._wire.unplug()
        self._wire.free()
        self._bell.close()
        self._wake.close()

    def __enter__(self) -> EmulatedSerial:
        return self.start()

    def __exit__(self, *failure: object) -> None:
        self.close()

    # -- in the thread ---------------------------------------------------------------------------

    def _serve(self) -> None:
        while not self._stopping.is_set():
            self._obey()
            now_s = time.monotonic()
            if self._plug_at_s is not None and now_s >= self._plug_at_s:
                self._plug()
            if now_s < self._read_again_s:
                self._stopping.wait(_TICK_S)
                continue
            idle_s = _IDLE_S if self._plug_at_s is None else max(0.0, min(_IDLE_S, self._plug_at_s - now_s))
            self._take(self._wire.receive(idle_s, self._wake))

    def _take(self, data: bytes) -> None:
        self._input += data
        end = self._device.command_end.encode()
        while end in self._input and self._plugged:
            command, _, self._input = self._input.partition(end)
            self._obey_command(command.strip(b"\r\n").decode("latin-1"))

    def _obey_command(self, command: str) -> None:
        self._commands.append(command)
        if not command:
            return
        baud = self._wire.baud()
        if baud is not None and baud != self._device.baud:
            self._wire.send(b"\xfe\xe0\xf8")  # what a wrong baud makes of an error code
            return
        operation = self._device.operation(command)
        answer: bytes | None = None
        due = self._faults.due(operation)
        for fault in due:
            if fault.kind in {"silent", "stalled", "unplugged"}:  # the command does not reach the device
                if fault.kind == "stalled":
                    self._read_again_s = time.monotonic() + fault.seconds if fault.seconds else float("inf")
                elif fault.kind == "unplugged":
                    self._unplug(fault.seconds)
                return
            if fault.kind == "refused":
                answer = self._device.refusal(command).encode("latin-1")
            elif fault.kind == "restarted":
                self._device.restart()
                answer = self._device.banner().encode("latin-1")
            elif fault.kind == "impostor" and operation == "identify":
                answer = self._device.impostor(command).encode("latin-1")
        if answer is None:
            answer = self._device.answer(command).encode("latin-1")
        for fault in due:
            answer = self._spoilt(answer, fault)
        if answer and self._plugged:
            self._wire.send(answer)

    def _spoilt(self, answer: bytes, fault: WireFault) -> bytes:
        if fault.kind == "late":
            self._pause(fault.seconds)
        elif fault.kind == "truncated":
            return answer[: len(answer.rstrip(b"\r\n")) // 2]
        elif fault.kind == "garbled":
            return self._garbler(answer)
        return answer

    def _pause(self, seconds: float) -> None:
        """Let time pass; orders and the end are still obeyed."""
        ends_s = time.monotonic() + seconds
        while not self._stopping.is_set() and self._plugged and (left_s := ends_s - time.monotonic()) > 0:
            self._stopping.wait(min(left_s, _TICK_S))
            self._obey()

    def _unplug(self, seconds: float) -> None:
        if not self._plugged:
            return
        self._plugged = False
        self._plug_at_s = time.monotonic() + seconds if seconds else None
        self._read_again_s = 0.0
        self._input = b""
        self._wire.unplug()

    def _plug(self) -> None:
        if self._plugged:
            return
        self._plug_at_s = None
        self._device.restart()
        self._wire.plug()
        self._plugged = True

    # -- from other threads ------------------------------------------------------------------------

    def _order(self, what: Callable[[], None]) -> None:
        """Have the serving thread do something, and wait until it is done."""
        done = threading.Event()
        self._orders.put((what, done))
        self._ring()
        while not done.wait(0.1) and self._thread.is_alive():
            pass

    def _obey(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._wake.recv(64)
        while not self._orders.empty():
            what, done = self._orders.get()
            what()
            done.set()

    def _ring(self) -> None:
        with contextlib.suppress(OSError):
            self._bell.send(b"!")


class PtyWire:
    """A pseudo-terminal; POSIX only. What the client does not take is lost, as without handshake. Raises OSError.

    link: Where the port appears: a symbolic link, the same after each unplugging.
    """

    def __init__(self, link: Path) -> None:
        if os.name != "posix":
            raise OSError("this system has no pseudo-terminals; use TcpWire")
        self._link = link
        self._ends: tuple[int, int] | None = None

    @property
    def address(self) -> str:
        """What the client opens."""
        return str(self._link)

    def plug(self) -> None:
        """Make the port appear."""
        import tty

        far, near = os.openpty()
        # Nothing may be echoed or translated before the client sets the port up.
        tty.setraw(near)
        os.set_blocking(far, False)
        # The client's end stays open here too, so that this one does not fail when the client closes it.
        self._ends = (far, near)
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.symlink_to(os.ttyname(near))
        fresh.replace(self._link)

    def unplug(self) -> None:
        """Make the port vanish, with whatever has it open."""
        self._link.unlink(missing_ok=True)
        ends, self._ends = self._ends, None
        for end in ends or ():
            os.close(end)

    def free(self) -> None:
        """Nothing is kept once it is unplugged."""

    def receive(self, timeout_s: float, wake: socket.socket) -> bytes:
        """What has come in; waits up to `timeout_s`, or until there is something to read at `wake`."""
        sources: list[int | socket.socket] = [wake] if self._ends is None else [wake, self._ends[0]]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._ends is None or self._ends[0] not in ready:
            return b""
        return os.read(self._ends[0], _CHUNK)

    def send(self, data: bytes) -> None:
        """Send to the client."""
        if self._ends is not None:
            with contextlib.suppress(BlockingIOError):
                os.write(self._ends[0], data)

    def baud(self) -> int | None:
        """Bits per second that the client has chosen; None where it cannot be read."""
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
        """See `PtyWire`, here and below."""
        return f"socket://{self._at[0]}:{self._at[1]}"

    def plug(self) -> None:
        if self._reserved is None:
            self._reserved = self._bound(self._at)
        self._listener, self._reserved = self._reserved, None
        self._listener.listen(1)

    def unplug(self) -> None:
        for source in (self._client, self._listener):
            if source is not None:
                source.close()
        self._client = self._listener = None
        # Bound and not listening: connections are refused, and no other program gets the number.
        with contextlib.suppress(OSError):
            self._reserved = self._reserved or self._bound(self._at)

    def free(self) -> None:
        if self._reserved is not None:
            self._reserved.close()
            self._reserved = None

    def receive(self, timeout_s: float, wake: socket.socket) -> bytes:
        sources = [source for source in (wake, self._listener, self._client) if source is not None]
        ready, _, _ = select.select(sources, [], [], timeout_s)
        if self._client in ready and self._client is not None:
            try:
                data = self._client.recv(_CHUNK)
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


Wire = PtyWire | TcpWire
"""The instrument's end of a serial line; only one thread uses it."""
