"""Which serial port a rig file means: a device path, a network address, or a serial number to look for."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

from drivers.errors import InstrumentError, InstrumentLostError

NETWORK = "socket://"
BY_SERIAL_NUMBER = "serial-number:"


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of the operating system.

    device: What it is opened by: ``"/dev/ttyUSB0"``, ``"COM3"``.
    serial_number: Of its USB interface; empty where it has none.
    description: What the operating system calls it.
    """

    device: str
    serial_number: str = ""
    description: str = ""


def serial_ports(instrument: str = "serial ports") -> tuple[SerialPort, ...]:
    """All serial ports that are present now. Raises InstrumentError."""
    try:
        from serial.tools.list_ports import comports
    except ImportError as missing:
        raise pyserial_missing(instrument, "looking for serial ports") from missing
    return tuple(
        SerialPort(str(port.device), str(port.serial_number or ""), str(port.description or "")) for port in comports()
    )


def find_port(port: str, instrument: str, present: Iterable[SerialPort] | None = None) -> str:
    """What to open for a port as a rig file names it; asked afresh at every open, since numbers move.

    Raises InstrumentLostError or InstrumentError.

    port: A device path (``"/dev/ttyUSB0"``, ``"COM3"``), ``"socket://host:port"``, or ``"serial-number:ABC123"``.
    instrument: Who asks, for the message.
    present: The ports to choose from; by default those of this computer, now.

    Returns str: a device path or a ``socket://`` address.
    """
    if port.startswith(NETWORK):
        return _network_address(port, instrument)
    if not port.startswith(BY_SERIAL_NUMBER):
        if not port.strip():
            raise InstrumentError(instrument, "opening", "port is empty", "write its path into the rig file, port")
        return port
    wanted = port.removeprefix(BY_SERIAL_NUMBER).strip()
    listed = tuple(serial_ports(instrument) if present is None else present)
    found = [one.device for one in listed if wanted and one.serial_number == wanted]
    if len(found) == 1:
        return found[0]
    doing = f"looking for the port with serial number {wanted!r}"
    if found:
        raise InstrumentLostError(
            instrument, doing, f"{' and '.join(found)} both have it", "name one of them in the rig file, port"
        )
    numbers = ", ".join(f"{one.serial_number} ({one.device})" for one in listed if one.serial_number)
    raise InstrumentLostError(
        instrument,
        doing,
        f"no port has it; those present: {numbers or 'none with a serial number'}",
        "plug it in, or correct the rig file, port",
    )


def pyserial_missing(instrument: str, doing: str) -> InstrumentError:
    """What to say where pyserial is not installed."""
    return InstrumentError(instrument, doing, "the package pyserial is not installed", "pip install pyserial")


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


ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
FORBIDDEN = (errno.EACCES, errno.EPERM)
BUSY = (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK)
NO_SERIAL_PORT = (errno.ENOTTY, errno.EINVAL, errno.EISDIR)
UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT)


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
    if number in ABSENT or "FileNotFoundError" in text:
        return "there is no such port now", "plug the device in and switch it on, or correct the rig file, port"
    if number in FORBIDDEN:
        return (
            "this user may not open the port",
            "join the group that owns it (often dialout: sudo usermod -aG dialout NAME) and log in again",
        )
    if number in NO_SERIAL_PORT or "configure port" in text or "IsADirectory" in text:
        return f"that is no serial port ({text})", "correct the rig file, port or baud"
    return f"it cannot be opened ({text})", "check the rig file, port, and the cable"


def _network_failure(number: int | None, text: str) -> tuple[str, str]:
    if number == errno.ECONNREFUSED or "10061" in text:  # Windows: WSAECONNREFUSED
        return "nothing there accepts connections", "switch the device or its serial server on; check the port number"
    if number in UNREACHABLE or "timed out" in text:
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
