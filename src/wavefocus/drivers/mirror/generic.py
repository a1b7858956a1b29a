"""The generic mirror, defined in docs/reference/generic-mirror.md for a controller that one builds oneself."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import TypeVar

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, RefusedError, UnreadableError, matched
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.registry import MIRRORS
from wavefocus.drivers.serial_device import Dialect, tolerance_key

Answer = TypeVar("Answer")

_NUMBER = r"(-?\d{1,5}(?:\.\d{1,6})?)"
_CODES = {
    1: ("it does not know the command", "check the controller's program", False),
    2: ("it cannot read the number", "check the controller's program", False),
    3: ("the angle is out of its range", "lower limit_mrad in the rig file", False),
    4: ("the command was disturbed on the line", "try again; if it stays, check the cable", True),
    5: ("it is not ready", "wait until it has started; check its enable switch", True),
    6: ("its hardware has failed", "look at the controller", False),
}


def checksum(text: str) -> str:
    """Two hexadecimal digits: all characters, combined by exclusive or."""
    return f"{reduce(lambda sum_, byte: sum_ ^ byte, text.encode('ascii'), 0):02X}"


@MIRRORS.register
@dataclass(kw_only=True)
class GenericMirror(Dialect):
    """The dialect ``generic``; reads back, says when it is idle, and every line carries a checksum."""

    tolerance_mrad: float = tolerance_key()

    name = "generic"
    command_end = "\r\n"
    patience_s = 4.0  # opening the port resets many a board, which then takes seconds to start
    reach_mrad = 1000 * math.pi / 2

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        return dialogue.introduce(_query("*IDN?", _identity), patience_s)

    def device(self, identity: str) -> DeviceIdentity:
        maker, product, serial, _version = (field.strip() for field in identity.split(","))
        return DeviceIdentity(maker, product, serial)

    def marker(self, identity: str) -> Marker:
        def stranger(line: str) -> str | None:
            try:
                return _identity(_checked(line))
            except (UnreadableError, RefusedError):
                return None

        answer = _checksummed(identity)
        return Marker(
            _checksummed("*IDN?"), identity, lambda line: (line[:-2] + line[-2:].upper()).endswith(answer), stranger
        )

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        self._tell_park(dialogue, park_mrad)

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        dialogue.ask(_query(f"XY={x_mrad:.4f},{y_mrad:.4f}", _done), doing)

    def park(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        # It may have been switched off and on since it was set.
        self._tell_park(dialogue, park_mrad)
        dialogue.ask(_query("PARK", _done), "parking")

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        return dialogue.ask(_query("BUSY?", _busy), doing)

    def where_mrad(self, dialogue: Dialogue, doing: str) -> tuple[float, float]:
        return dialogue.ask(_query("XY?", _angles), doing)

    @staticmethod
    def _tell_park(dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        command = f"PARK={park_mrad[0]:.4f},{park_mrad[1]:.4f}"
        dialogue.ask(_query(command, _done), "telling it where to park")


def _query(text: str, read: Callable[[str], Answer]) -> Query[Answer]:
    return Query(_checksummed(text), lambda answer: read(_checked(answer)))


def _checksummed(text: str) -> str:
    return f"{text}*{checksum(text)}"


def _checked(answer: str) -> str:
    """The answer without its checksum; an error code is raised."""
    text, _, sum_ = answer.rpartition("*")
    if sum_.upper() != checksum(text):
        raise UnreadableError(answer)
    refusal = re.fullmatch(r"ERR (\d{1,3})(?: .*)?", text)
    if refusal is not None:
        code = int(refusal.group(1))
        meaning, remedy, passing = _CODES.get(code, ("an error of its own", "see its documentation", True))
        raise RefusedError(f"the controller answers {text}: {meaning}", remedy, passing=passing)
    return text


def _identity(text: str) -> str:
    if len(text.split(",")) != 4:
        raise UnreadableError(text)
    return text


def _done(text: str) -> None:
    if text != "OK":
        raise UnreadableError(text)


def _busy(text: str) -> bool:
    if text not in {"0", "1"}:
        raise UnreadableError(text)
    return text == "1"


def _angles(text: str) -> tuple[float, float]:
    found = matched(f"{_NUMBER},{_NUMBER}", text)
    return float(found.group(1)), float(found.group(2))
