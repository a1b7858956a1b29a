"""One serial line: text out, a line of text in, each with an end to its waiting."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from typing import Any

from drivers.errors import InstrumentLostError
from drivers.serial_line.ports import find_port, open_failure, pyserial_missing

# How long pyserial waits for bytes before the deadline is looked at again.
POLL_S = 0.02
LONGEST_ANSWER = 4096


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
    """A serial port or a TCP connection in its place, opened for one user alone.

    instrument: Whose line it is, for messages.
    port: As in the rig file, see `drivers.serial_line.ports.find_port`.
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
            raise pyserial_missing(self._instrument, f"opening {self._name}") from missing
        # termios.error is none of the OSErrors; it comes from tcflush when a port has gone. Windows has no termios.
        # A port that another thread closes meanwhile has no descriptor left: pyserial fails with a TypeError then.
        self._failures = (serial.SerialException, OSError, ValueError, TypeError, AttributeError, *_termios_errors())
        address = find_port(self._name, self._instrument)
        try:
            self._port = serial.serial_for_url(
                address,
                baudrate=self.settings.baud,
                timeout=POLL_S,
                write_timeout=self.settings.answer_s,
                exclusive=True,
            )
        except self._failures as failure:
            cause, remedy = open_failure(address, failure)
            raise InstrumentLostError(self._instrument, f"opening {self._name}", cause, remedy) from failure

    def send(self, text: str) -> None:
        """Send a command; its end is added. Raises NoAnswerError or LineFailedError."""
        import serial

        try:
            self._port.write((text + self.settings.end).encode(self.settings.encoding))
        except serial.SerialTimeoutException:
            # What was not taken must not be sent later, before another command.
            with contextlib.suppress(*self._failures):
                self._port.reset_output_buffer()
            raise NoAnswerError(f"the device did not take the command within {self.settings.answer_s:g} s") from None
        except self._failures as failure:
            raise LineFailedError(_text(failure)) from failure

    def receive(self, deadline_s: float) -> str:
        """The next line of text, without its end. Raises NoAnswerError or LineFailedError.

        deadline_s: When to give up, on the clock of `time.monotonic`.
        """
        while b"\n" not in self._input:
            self._input += self._read()
            if len(self._input) > LONGEST_ANSWER:
                self._input.clear()
                raise NoAnswerError(f"more than {LONGEST_ANSWER} bytes came and no end of the line")
            if time.monotonic() > deadline_s and b"\n" not in self._input:
                got = bytes(self._input)
                raise NoAnswerError(f"the answer broke off after {got!r}" if got else "no answer came")
        line, _, rest = self._input.partition(b"\n")
        self._input = rest
        try:
            return line.rstrip(b"\r").decode(self.settings.encoding)
        except UnicodeDecodeError:
            raise NoAnswerError(f"what came is no text: {bytes(line)!r}") from None

    def received(self) -> bool:
        """Whether there is input that nobody has read. Raises LineFailedError."""
        try:
            return bool(self._input or self._port.in_waiting)
        except self._failures as failure:
            raise LineFailedError(_text(failure)) from failure

    def discard(self) -> None:
        """Drop what has come in so far; a device that never stops sending is left at it. Raises LineFailedError."""
        dropped = len(self._input)
        self._input.clear()
        while self.received() and dropped < LONGEST_ANSWER:
            dropped += len(self._read())

    def close(self) -> None:
        """Release the port; never waits for the device. Twice does no harm."""
        port, self._port = self._port, None
        self._input.clear()
        if port is None:
            return
        # The socket of pyserial 3.5 stays open where its shutdown fails, as it does once the peer has gone.
        remains = getattr(port, "_socket", None)
        for step in (port.reset_output_buffer, port.close, *([remains.close] if remains is not None else [])):
            with contextlib.suppress(*self._failures):
                step()

    def _read(self) -> bytes:
        """What is there; at least a byte if one comes within `POLL_S`."""
        try:
            return bytes(self._port.read(self._port.in_waiting or 1))
        except self._failures as failure:
            raise LineFailedError(_text(failure)) from failure


def _termios_errors() -> tuple[type[Exception], ...]:
    try:
        import termios
    except ImportError:
        return ()
    return (termios.error,)


def _text(failure: Exception) -> str:
    return " ".join(str(failure).split()) or type(failure).__name__
