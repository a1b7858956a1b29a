"""Orders by OSC over UDP.

``/source/NAME/position x y [amplitude]``, ``/source/NAME/amplitude a`` (from its next position on),
``/source/NAME/signal TABLE`` (a JSON text, as in a scene file), ``/source/NAME/end``, ``/end``; alone or in bundles,
whose times are not waited for. Source: The Open Sound Control 1.0 specification (Wright, 2002).

Packets are read here and not by python-osc (1.10): that package logs each unknown type tag to the root logger, and so
to standard error; pads a number that was cut off; and reads all messages of a bundle before one can be left out.
"""

import json
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress

from wavefocus.console import one_line
from wavefocus.storage.errors import InputError

BUNDLE = b"#bundle\0"
MAX_MESSAGES = 2000
"""Most messages of one datagram: the shortest position takes 40 bytes, a datagram at most 65,507."""
NUMBERS = {"i": ">i", "h": ">q", "f": ">f", "d": ">d"}
CONSTANTS = {"T": True, "F": False, "N": None, "I": None}


def split_packet(datagram: bytes) -> list[bytes]:
    """The messages of a packet, not yet read, in their order; bundles within bundles too.

    Raises InputError: a size does not fit, or there are more than `MAX_MESSAGES`.
    """
    messages: list[bytes] = []
    parts = [datagram]
    while parts:
        part = parts.pop()
        if not part.startswith(BUNDLE):
            messages.append(part)
            if len(messages) > MAX_MESSAGES:
                raise InputError(f"more than {MAX_MESSAGES} messages in one datagram")
            continue
        # Behind the bundle's name, and a time tag that is not waited for.
        at, elements = 16, []
        while at != len(part):
            size = struct.unpack_from(">i", part, at)[0] if at + 4 <= len(part) else -1
            if size <= 0 or size % 4 or at + 4 + size > len(part):
                raise InputError("an element of the bundle does not fit into it")
            elements.append(part[at + 4 : at + 4 + size])
            at += 4 + size
        parts += reversed(elements)
    return messages


def read_message(message: bytes) -> tuple[str, list[object]]:
    """Address and arguments of a message.

    Numbers, texts, blobs, True, False and Nil; arrays are lists. Raises InputError.
    """
    address, at = _text(message, 0)
    if not address.startswith("/") or len(message) % 4:
        raise InputError("not an OSC message")
    if at == len(message):
        return address, []  # without type tags, as older programs send it
    tags, at = _text(message, at)
    if not tags.startswith(","):
        raise InputError(f"{address}: its arguments have no type tags")
    lists: list[list[object]] = [[]]
    for tag in tags[1:]:
        value: object
        if tag == "[":
            lists.append([])
            continue
        if tag == "]":
            value = lists.pop()
            if not lists:
                raise InputError(f"{address}: an array ends that has not begun")
        elif tag in CONSTANTS:
            value = CONSTANTS[tag]
        elif tag in NUMBERS:
            form = NUMBERS[tag]
            end = at + struct.calcsize(form)
            if end > len(message):
                raise InputError(f"{address}: cut off within an argument")
            value, at = struct.unpack_from(form, message, at)[0], end
        elif tag in "sS":
            value, at = _text(message, at)
        elif tag == "b":
            size = struct.unpack_from(">i", message, at)[0] if at + 4 <= len(message) else -1
            if size < 0 or at + 4 + size > len(message):
                raise InputError(f"{address}: cut off within an argument")
            value, at = message[at + 4 : at + 4 + size], at + 4 + size + -size % 4
        else:
            raise InputError(
                f"{address}: arguments of the type {tag!r} are not known; allowed: i, h, f, d, s, b, T, F, N"
            )
        lists[-1].append(value)
    if len(lists) != 1 or at != len(message):
        raise InputError(f"{address}: {len(message)} bytes, and its type tags {tags!r} stand for {at}")
    return address, lists[0]


def _text(message: bytes, at: int) -> tuple[str, int]:
    """A text that ends in a zero and fills a multiple of four bytes, and where it ends."""
    zero = message.find(b"\0", at)
    end = zero + 4 - zero % 4
    if zero < 0 or end > len(message):
        raise InputError("not an OSC message: a text has no end")
    try:
        return message[at:zero].decode(), end
    except UnicodeDecodeError:
        raise InputError("not an OSC message: a text is not UTF-8") from None


Content = Mapping[str, object]

MAX_BYTES = 1 << 16
MAX_AT_ONCE = 64
"""Datagrams: one of each of 32 sources, twice."""
MAX_WORDS = 200
"""Of what came at once, the newest so many messages are read, without positions that a newer one replaces."""
FLOOD_FROM, FLOOD_PAUSE_S, FLOOD_SHARE = 8, 0.002, 0.25
"""After more than 8 datagrams the next are read 2 ms later, the newest 64 or 64 kB, and at most a quarter of the time
is spent on it: reading more would slow down computing."""
MAX_AMPLITUDES = 64
CLOSING_S = 2.0
LOOKS_EVERY_S = 0.2


def address_of(text: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``; port 0 is any that is free. Raises InputError."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isascii() or not port.isdecimal() or int(port) > 65_535:
        raise InputError(f"--osc {text}: must be HOST:PORT with a port from 0 to 65535, as 127.0.0.1:9000")
    return host, int(port)


class OscInput:
    """Receives messages in a thread of its own, from `start` to `close`.

    address: Where it listens, as ``HOST:PORT``. loopback: No other computer can reach it.

    Raises InputError: The address cannot be listened at.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
        except OSError as error:
            raise InputError(f"--osc {host}:{port}: cannot be listened at: {error.strerror}") from None
        try:
            self._socket.bind(place)
        except OSError as error:
            self._socket.close()
            raise InputError(f"--osc {host}:{port}: cannot be listened at: {error.strerror}") from None
        self._socket.setblocking(False)
        bound = self._socket.getsockname()
        self.address = f"[{bound[0]}]:{bound[1]}" if ":" in bound[0] else f"{bound[0]}:{bound[1]}"
        self.loopback = bound[0].startswith("127.") or bound[0] == "::1"
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, receive: Callable[[Content | InputError, float], object]) -> None:
        """Begin to receive.

        receive: Gets each order as `wavefocus.live_session.orders.order_of` reads it, or what is wrong with a message,
            and the instant of its arrival, of `time.monotonic`.
        """
        messages = OscMessages()

        def listen() -> None:
            for count, datagrams, arrived_s in self._datagrams():
                if count > len(datagrams):
                    text = f"OSC: {count} datagrams at once; only the newest {len(datagrams)} are read"
                    receive(InputError(text), arrived_s)
                for order in messages.read(*datagrams):
                    receive(order, arrived_s)

        self._thread = threading.Thread(target=listen, name="OSC", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Receive no more; never waits long, whatever an order under way meets."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(CLOSING_S)
        self._socket.close()

    def _datagrams(self) -> Iterator[tuple[int, list[bytes], float]]:
        """How many came at once, the newest of them, oldest first, and when."""
        while not self._over.is_set():
            with suppress(OSError, ValueError):  # closed meanwhile
                select.select([self._socket], [], [], LOOKS_EVERY_S)
            newest: deque[bytes] = deque(maxlen=MAX_AT_ONCE)
            count, arrived_s = 0, time.monotonic()
            # Nothing more is there, or it is closed; Windows reports that an earlier answer met a closed port.
            with suppress(OSError):
                while count < 100 * FLOOD_FROM:
                    newest.append(self._socket.recv(MAX_BYTES))
                    count += 1
            while len(newest) > 1 and sum(map(len, newest)) > MAX_BYTES:
                newest.popleft()
            if newest:
                yield count, list(newest), arrived_s
            spent_s = time.monotonic() - arrived_s
            if count > FLOOD_FROM or spent_s > FLOOD_PAUSE_S:
                self._over.wait(max(FLOOD_PAUSE_S, spent_s / FLOOD_SHARE))


class OscMessages:
    """Reads datagrams; holds the amplitudes that wait for a position."""

    def __init__(self) -> None:
        self._amplitudes: dict[str, float] = {}

    def read(self, *datagrams: bytes) -> Iterator[Content | InputError]:
        """The orders of datagrams that came at once, and an InputError for each message that is not one."""
        messages: list[bytes] = []
        for datagram in datagrams:
            try:
                messages += split_packet(datagram)
            except InputError as wrong:
                yield _refused(datagram, wrong)
        messages = _newest(messages)
        if len(messages) > MAX_WORDS:
            yield InputError(f"OSC: {len(messages)} messages at once; only the newest {MAX_WORDS} are read")
        for message in messages[-MAX_WORDS:]:
            try:
                address, values = read_message(message)
            except InputError as wrong:
                yield _refused(message, wrong)
                continue
            try:
                order = self._order(address, values)
            except InputError as wrong:
                order = InputError(one_line(f"OSC {address}: {wrong}", 300))
            if order is not None:
                yield order

    def _order(self, address: str, values: list[object]) -> Content | InputError | None:
        if address == "/end":
            return {"order": "end"}
        parts = address.split("/")
        if len(parts) != 4 or parts[:2] != ["", "source"] or not parts[2]:
            raise InputError("is not known; allowed: /source/NAME/position, amplitude, signal or end, and /end")
        name, word = parts[2], parts[3]
        if word == "position":
            numbers = _numbers(values, "x y [amplitude]", 2, 3)
            kept = self._amplitudes.pop(name, None)
            amplitude = numbers[2] if len(numbers) == 3 else kept
            order: dict[str, object] = {"order": "move", "name": name, "at_mm": numbers[:2]}
            return order if amplitude is None else order | {"amplitude": amplitude}
        if word == "amplitude":
            (amplitude,) = _numbers(values, "a", 1, 1)
            if name not in self._amplitudes and len(self._amplitudes) >= MAX_AMPLITUDES:
                raise InputError(f"more than {MAX_AMPLITUDES} sources wait for a position")
            self._amplitudes[name] = amplitude
            return None
        if word == "signal":
            return {"order": "signal", "name": name, "signal": _table(values)}
        if word == "end":
            self._amplitudes.pop(name, None)
            return {"order": "end_source", "name": name}
        raise InputError(f"{word!r} is not known; allowed: position, amplitude, signal, end")


def _refused(datagram: bytes, wrong: InputError) -> InputError:
    return InputError(one_line(f"OSC message {datagram[:40]!r}: {wrong}", 300))


def _newest(messages: list[bytes]) -> list[bytes]:
    """The same without positions that the same source's next message replaces by another one of the same form."""
    kept: list[bytes | None] = []
    latest: dict[bytes, tuple[int, bytes]] = {}
    for message in messages:
        address, _, rest = message.partition(b"\0")
        name, word = address.rpartition(b"/")[::2]
        form = address + rest.lstrip(b"\0").partition(b"\0")[0] if word == b"position" else b""
        before = latest.get(name)
        if form and before is not None and before[1] == form:
            kept[before[0]] = None
        latest[name] = (len(kept), form)
        kept.append(message)
    return [message for message in kept if message is not None]


def _numbers(values: list[object], allowed: str, least: int, most: int) -> list[float]:
    numbers = [value for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
    if len(numbers) < len(values) or not least <= len(numbers) <= most:
        raise InputError(f"has {values!r}; allowed: {allowed}, numbers")
    return [float(number) for number in numbers]


def _table(values: list[object]) -> Mapping[str, object]:
    table = None
    if len(values) == 1 and isinstance(values[0], str):
        with suppress(ValueError, RecursionError):
            table = json.loads(values[0])
    if not isinstance(table, dict):
        raise InputError('allowed: one JSON text, as {"kind": "sine", "frequency_hz": 200, "duration_s": 1}')
    if table.get("kind") == "file":
        raise InputError("sound files are not read by order of the network; name them in the scene file")
    return table
