"""One serial line, by device path, network address or serial number: text out and in, each with a time limit."""

import contextlib
import errno
import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, MissingPackageError
from wavefocus.drivers.exchange_record import note_exchange

NETWORK = "socket://"
_BY_SERIAL_NUMBER = "serial-number:"
# udev rules of this package for all devices that it knows; installed under the same name.
RULES = Path(__file__).with_name("70-wavefocus.rules")
RULES_FOLDER = "/etc/udev/rules.d/"


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of the operating system.

    device: What it is opened by: ``"/dev/ttyUSB0"``, ``"COM3"``.
    serial_number: Of its USB interface; empty where it has none.
    interface: Number of its interface in an adapter with several ports, from 0; None where that is not known.
    """

    device: str
    serial_number: str = ""
    interface: int | None = None


def _serial_ports(instrument: str = "serial ports") -> tuple[SerialPort, ...]:
    """All serial ports that are present now. Raises InstrumentError."""
    try:
        from serial.tools.list_ports import comports
    except ImportError as missing:
        raise _pyserial_missing(instrument, "looking for serial ports") from missing
    return tuple(
        SerialPort(
            str(port.device),
            str(port.serial_number or ""),
            # "1-1.4:1.0" on Linux, "1-4:x.0" on Windows: configuration and interface behind the colon.
            None if (found := re.search(r":\w+\.(\d+)$", str(port.location or ""))) is None else int(found.group(1)),
        )
        for port in comports()
    )


def find_port(port: str, instrument: str, present: Iterable[SerialPort] | None = None) -> str:
    """What to open for a port as a rig file names it; asked afresh at every open, since numbers move.

    Raises InstrumentLostError or InstrumentError.

    port: A device path (``"/dev/ttyUSB0"``, ``"COM3"``), ``"socket://host:port"``, or ``"serial-number:ABC123"``, of
        an adapter with several ports ``"serial-number:ABC123:1"``, counted from 0.
    instrument: Who asks, for the message.
    present: The ports to choose from; by default those of this computer, now.

    Returns str: a device path or a ``socket://`` address.
    """
    if port.startswith(NETWORK):
        return _network_address(port, instrument)
    if not port.startswith(_BY_SERIAL_NUMBER):
        if not port.strip():
            raise InstrumentError(instrument, "opening", "port is empty", "write its path into the rig file, port")
        return port
    wanted = port.removeprefix(_BY_SERIAL_NUMBER).strip()
    listed = tuple(_serial_ports(instrument) if present is None else present)
    found = _with_serial_number(listed, wanted)
    if len(found) == 1:
        return found[0].device
    doing = f"looking for the port with serial number {wanted!r}"
    if found:
        names = " and ".join(port.device for port in found)
        numbered = [port for port in found if port.interface is not None]
        forms = ", ".join(f"{_BY_SERIAL_NUMBER}{wanted}:{port.interface} is {port.device}" for port in numbered)
        remedy = f"name one of them in the rig file, port{f': {forms}' if forms else ', by its path'}"
        raise InstrumentLostError(instrument, doing, f"{names} have it", remedy)
    numbers = ", ".join(f"{port.serial_number} ({port.device})" for port in listed if port.serial_number)
    nameless = ", ".join(port.device for port in listed if not port.serial_number)
    cause = f"no port has it; those present: {numbers or 'none with a serial number'}"
    remedy = "plug it in, or correct the rig file, port"
    if nameless:
        remedy += f"; ports without a serial number go by their path: {nameless}"
    raise InstrumentLostError(instrument, doing, cause, remedy)


def _with_serial_number(listed: Sequence[SerialPort], wanted: str) -> list[SerialPort]:
    """Ports that have a serial number, or, of an adapter with several ports, the one of an interface."""
    found = _of_number(listed, wanted)
    number, _, interface = wanted.rpartition(":")
    if found or not interface.isdecimal():
        return found
    return [port for port in _of_number(listed, number) if port.interface == int(interface)]


def _of_number(listed: Sequence[SerialPort], wanted: str) -> list[SerialPort]:
    """Ports that have just this number, else in another case."""
    alike = [port for port in listed if wanted and port.serial_number.casefold() == wanted.casefold()]
    return [port for port in alike if port.serial_number == wanted] or alike


def _pyserial_missing(instrument: str, doing: str) -> InstrumentError:
    """What to say where pyserial is not installed."""
    return MissingPackageError(instrument, doing, "the package pyserial is not installed", "pip install pyserial")


def _network_address(port: str, instrument: str) -> str:
    parts = urlsplit(port)
    try:
        number = parts.port
    except ValueError:
        number = None
    if not parts.hostname or number is None or parts.path.strip("/") or parts.query:
        raise InstrumentError(
            instrument, "opening", f"port is {port!r}", "write socket://host:port with a port from 1 to 65535"
        )
    return port


_ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
_FORBIDDEN = (errno.EACCES, errno.EPERM)
BUSY = (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK)
_NO_SERIAL_PORT = (errno.ENOTTY, errno.EINVAL, errno.EISDIR)
_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT)


def open_failure(address: str, failure: Exception) -> tuple[str, str]:
    """Say why a port could not be opened and what to do about it.

    address: What was opened: a device path or a ``socket://`` address.
    failure: What pyserial raised: with an error number on POSIX (`serialposix.py`, ``open``), with the Windows error in
        its text (`serialwin32.py`, ``open``), and with the socket's error as its context for TCP
        (`urlhandler/protocol_socket.py`, ``open``); all of pyserial 3.5.

    Returns cause and remedy.
    """
    number = _error_number(failure)
    text = " ".join(str(failure).split())
    if address.startswith(NETWORK):
        return _network_failure(number, text)
    # Windows denies access to a port that another program has open.
    if number in BUSY or "PermissionError(13" in text:
        return "another program has the port open", "close the other program; on Linux, fuser names it"
    if number in _ABSENT or "FileNotFoundError" in text:
        return "there is no such port now", "plug the device in and switch it on, or correct the rig file, port"
    if number in _FORBIDDEN:
        return (
            "this user may not open the port",
            "join the group that owns it (often dialout: sudo usermod -aG dialout NAME) and log in again, or permit it "
            f"to whoever is logged in: sudo cp {RULES} {RULES_FOLDER}, and plug the device in again",
        )
    if number in _NO_SERIAL_PORT or "configure port" in text or "IsADirectory" in text:
        return f"that is not a serial port ({text})", "correct the rig file, port or baud"
    return f"it cannot be opened ({text})", "check the rig file, port, and the cable"


def _network_failure(number: int | None, text: str) -> tuple[str, str]:
    if number == errno.ECONNREFUSED or "10061" in text:  # Windows: WSAECONNREFUSED
        return "nothing there accepts connections", "switch the device or its serial server on; check the port number"
    if number in _UNREACHABLE or "timed out" in text:
        return "the host cannot be reached", "check the network cable and the address in the rig file, port"
    return f"no connection ({text})", "check the address in the rig file, port"


def _error_number(failure: BaseException | None) -> int | None:
    """The first error number along the chain of what led to a failure."""
    while failure is not None:
        number = getattr(failure, "errno", None)
        if isinstance(number, int):
            return number
        # termios.error carries its number as first argument, and is no OSError.
        if failure.args and isinstance(failure.args[0], int):
            return failure.args[0]
        failure = failure.__cause__ or failure.__context__
    return None


# How long pyserial waits for bytes before the deadline is looked at again.
_POLL_S = 0.02
_MAX_ANSWER = 4096


class LineFailedError(Exception):
    """The port itself failed: unplugged, or the connection closed."""


class NoAnswerError(Exception):
    """Nothing that can be read came back in time."""


@dataclass(frozen=True, slots=True)
class LineSettings:
    """How a device is spoken to.

    baud: Bits per second; 8 data bits, no parity, 1 stop bit.
    end: What ends a command. Every answer ends with a line feed; a carriage return before it does not count.
    answer_s: Longest wait for an answer, and for the device to take a command, > 0.
    encoding: ``"ascii"``; ``"latin-1"`` for a device that sends any bytes between those of text.
    """

    baud: int
    end: str
    answer_s: float = 1.0
    encoding: str = "ascii"


class SerialLine:
    """A serial port or a TCP connection in its place, opened for one user only.

    instrument: Whose line it is, for messages.
    port: As in the rig file, see `wavefocus.drivers.serial_line.find_port`.
    """

    def __init__(self, instrument: str, port: str, settings: LineSettings) -> None:
        self._instrument = instrument
        self._name = port
        self.settings = settings
        self._port: Any = None
        self._input = bytearray()
        self._failures: tuple[type[Exception], ...] = ()

    @property
    def is_open(self) -> bool:
        """Whether the port is open, until a failure shows otherwise."""
        return self._port is not None

    def open(self) -> None:
        """Open the port, exclusively. Raises InstrumentLostError or InstrumentError."""
        self.close()
        try:
            import serial
        except ImportError as missing:
            raise _pyserial_missing(self._instrument, f"opening {self._name}") from missing
        # termios.error is none of the OSErrors; it comes from tcflush when a port has gone. Windows has no termios.
        # A port that another thread closes meanwhile has no descriptor left: pyserial fails with a TypeError then.
        self._failures = (serial.SerialException, OSError, ValueError, TypeError, AttributeError, *_termios_errors())
        address = find_port(self._name, self._instrument)
        try:
            self._port = serial.serial_for_url(
                address,
                baudrate=self.settings.baud,
                timeout=_POLL_S,
                write_timeout=self.settings.answer_s,
                exclusive=True,
            )
        except self._failures as failure:
            cause, remedy = open_failure(address, failure)
            note_exchange(self._instrument, opening=address, failed=cause)
            raise InstrumentLostError(self._instrument, f"opening {self._name}", cause, remedy) from failure
        note_exchange(self._instrument, opened=address, baud=self.settings.baud)

    def send(self, text: str) -> None:
        """Send a command; its end is added. Raises NoAnswerError or LineFailedError."""
        import serial

        data = (text + self.settings.end).encode(self.settings.encoding)
        note_exchange(self._instrument, sent=data)
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            # What was not taken must not be sent later, before another command.
            with contextlib.suppress(*self._failures):
                self._port.reset_output_buffer()
            raise NoAnswerError(f"the device did not take the command within {self.settings.answer_s:g} s") from None
        except self._failures as failure:
            note_exchange(self._instrument, sending="", failed=_text(failure))
            raise LineFailedError(_text(failure)) from failure

    def receive(self, deadline_s: float) -> str:
        """The next line of text, without its end. Raises NoAnswerError or LineFailedError.

        deadline_s: When to give up, on the clock of `time.monotonic`.
        """
        while b"\n" not in self._input:
            self._input += self._read()
            if len(self._input) > _MAX_ANSWER:
                self._input.clear()
                raise NoAnswerError(f"more than {_MAX_ANSWER} bytes came and no end of the line")
            if time.monotonic() > deadline_s and b"\n" not in self._input:
                got = bytes(self._input)
                raise NoAnswerError(f"the answer broke off after {got!r}" if got else "no answer came")
        line, _, rest = self._input.partition(b"\n")
        self._input = rest
        try:
            return line.rstrip(b"\r").decode(self.settings.encoding)
        except UnicodeDecodeError:
            raise NoAnswerError(f"the answer is not text: {bytes(line)!r}") from None

    def received(self) -> bool:
        """Whether there is unread input. Raises LineFailedError."""
        try:
            return bool(self._input or self._port.in_waiting)
        except self._failures as failure:
            raise LineFailedError(_text(failure)) from failure

    def close(self) -> None:
        """Release the port; never waits for the device. Twice does no harm."""
        port, self._port = self._port, None
        self._input.clear()
        if port is None:
            return
        note_exchange(self._instrument, closed=self._name)
        # The socket of pyserial 3.5 stays open where its shutdown fails, as it does once the peer has gone.
        remains = getattr(port, "_socket", None)
        for step in (port.reset_output_buffer, port.close, *([remains.close] if remains is not None else [])):
            with contextlib.suppress(*self._failures):
                step()

    def _read(self) -> bytes:
        """What is there; at least a byte if one comes within `_POLL_S`."""
        try:
            data = bytes(self._port.read(self._port.in_waiting or 1))
        except self._failures as failure:
            note_exchange(self._instrument, reading="", failed=_text(failure))
            raise LineFailedError(_text(failure)) from failure
        if data:
            note_exchange(self._instrument, received=data)
        return data


def _termios_errors() -> tuple[type[Exception], ...]:
    try:
        import termios
    except ImportError:
        return ()
    return (termios.error,)


def _text(failure: Exception) -> str:
    return " ".join(str(failure).split()) or type(failure).__name__
