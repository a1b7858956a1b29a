"""Why a serial port could not be opened, in words that say what to do."""

from __future__ import annotations

import errno

from drivers.serial_line.ports import NETWORK

ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
FORBIDDEN = (errno.EACCES, errno.EPERM)
BUSY = (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK)
NO_SERIAL_PORT = (errno.ENOTTY, errno.EINVAL, errno.EISDIR)
UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ETIMEDOUT)


def open_failure(address: str, failure: Exception) -> tuple[str, str]:
    """Say why a port could not be opened and what to do about it.

    Parameters
    ----------
    address : str
        What was opened: a device path or a ``socket://`` address.
    failure : Exception
        What pyserial raised: with an error number on POSIX (`serialposix.py`, ``open``), with the Windows
        error in its text (`serialwin32.py`, ``open``), and with the socket's error as its context for TCP
        (`urlhandler/protocol_socket.py`, ``open``); all of pyserial 3.5.

    Returns
    -------
    cause, remedy : str
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
