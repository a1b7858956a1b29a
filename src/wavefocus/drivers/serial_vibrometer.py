"""Vibrometer controllers on a serial line: opened, asked, checked, and released again."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, TypeVar

from wavefocus.drivers.dialogue import Dialogue, Query
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import Clock
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.serial_line import LineSettings, SerialLine

Answer = TypeVar("Answer")


class SerialVibrometer(ABC):
    """A controller that states its measurement range over a serial line.

    least_signal_level: Smallest signal level that will do, 0 to 1.
    """

    name: str
    least_signal_level: float
    default_baud: ClassVar[int]
    encoding: ClassVar[str] = "ascii"

    @abstractmethod
    def ask(self, dialogue: Dialogue, require_identity: Callable[[str], None]) -> VibrometerReading:
        """Ask for all settings.

        require_identity: Called with the names that controller and decoder give; raises InstrumentError where the rig
            file's identity is not part of them.

        Raises InstrumentError, TransientInstrumentError or InstrumentLostError.
        """

    def read(
        self,
        port: str,
        *,
        baud: int | None = None,
        identity: str | None = None,
        any_level: bool = False,
        answer_s: float = 1.0,
        clock: Clock | None = None,
    ) -> VibrometerReading:
        """Ask for the sensitivity that it is set to, and release the controller again.

        port: A device path, ``"COM3"``, ``"socket://host:port"`` or ``"serial-number:ABC123"``.
        baud: Bits per second; by default the controller's own.
        identity: Text that the names of controller and decoder must contain.
        any_level: Whether a signal below `least_signal_level` will do.
        answer_s: Longest wait for one answer, in s, > 0.
        clock: Passes the time while the controller starts; by default the wall's.

        Raises InstrumentError, TransientInstrumentError or InstrumentLostError.
        """
        instrument = f"vibrometer ({self.name} at {port})"
        settings = LineSettings(baud or self.default_baud, "\n", answer_s, self.encoding)
        dialogue = Dialogue(instrument, SerialLine(instrument, port, settings), clock)

        def require_identity(stated: str) -> None:
            if identity is not None and identity not in stated:
                cause = f"another device answers: {stated!r} does not contain {identity!r}"
                remedy = "plug in the right device, or correct the rig file, identity"
                raise InstrumentError(instrument, "asking who it is", cause, remedy)

        dialogue.open()
        try:
            reading = self.ask(dialogue, require_identity)
        finally:
            dialogue.close()
        level = reading.signal_level
        if level is not None and level < self.least_signal_level and not any_level:
            cause = f"it is {level:.0%} of full, at least {self.least_signal_level:.0%} is wanted"
            remedy = "focus the laser; put reflective film on the surface"
            raise InstrumentError(instrument, "checking the signal level", cause, remedy)
        return reading


def optional_answer(dialogue: Dialogue, query: Query[Answer]) -> Answer | None:
    """The answer, or None where the controller has none that can be read. Raises InstrumentLostError."""
    try:
        return dialogue.ask(query, f"asking {query.text}")
    except InstrumentLostError:
        raise
    except InstrumentError:
        return None
