"""Optotune MR-E-2 and MR-E-3 fast steering mirrors in their "simple mode"; experimental.

Sources: public programs for this controller (256000 baud, commands end with carriage return and line feed, ``start``
as handshake, ``status``, ``acknowledge``, ``xy=0.1234;-0.5000``), and one for the vendor's package, which states the
unit: x is the tangent of the beam's angle over tan 50 degrees; the vendor's Python SDK (optoMDC, optoKummenberg): the
frame that ends the pro mode, in which text is not answered, the answers ``OK`` and ``NO`` to ``Start``, USB
0483:A31E; the MR-E-3 manual: ``STATUS`` is a 32-bit register in hexadecimal, bit 4 says that the mirror is not
stable, ``OU`` and ``OL`` say that a value was over or under the range, that it was clamped and that the mirror moved
there, ``NO`` that a command was not recognised; the reach is the unit circle of x and y.

Not confirmed: whether the eight digits have ``0x`` or two zeros before them (all are read). No question for a serial
number is known, so two devices of this kind cannot be distinguished: name the port by its serial number
(``serial-number:...``) where there are two. There is no read-back.
"""

import math
import re
from dataclasses import dataclass

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, RefusedError, UnreadableError
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.registry import MIRRORS
from wavefocus.drivers.serial_device import Dialect

_IDENTITY = "Optotune MR-E-2"
_FULL_SCALE = math.tan(math.radians(50.0))
_LEAVE_PRO_MODE = "\x7e\x00\x06\x02\x00\x00\x00\x00\x7e"
_NOT_STABLE = 1 << 4
_REGISTER = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{8,10})")
_REFUSALS = {
    "OU": ("a value was over its range: it moved to the edge of its reach", "lower limit_mrad in the rig file", False),
    "OL": ("a value was under its range: it moved to the edge of its reach", "lower limit_mrad in the rig file", False),
    "NO": ("it did not recognise the command", "try again; if it stays, check driver and baud in the rig file", True),
}


@MIRRORS.register
@dataclass(kw_only=True)
class OptotuneMre2(Dialect):
    """The dialect ``optotune-mre2``."""

    name = "optotune-mre2"
    bauds = (256000,)
    command_end = "\r\n"
    reach_mrad = 1000 * math.radians(50.0)

    def reaches(self, x_mrad: float, y_mrad: float) -> bool:
        return math.hypot(*_deflections(x_mrad, y_mrad)) <= 1.0

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        dialogue.introduce(Query("start", _ready), patience_s, before=_LEAVE_PRO_MODE)
        return _IDENTITY

    def device(self, identity: str) -> DeviceIdentity:
        return DeviceIdentity("", identity)

    def marker(self, identity: str) -> Marker:
        return Marker("status", identity, lambda line: re.search(_REGISTER.pattern + "$", line) is not None, _nobody)

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        dialogue.ask(Query("acknowledge", _done), "acknowledging earlier errors")

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        x, y = _deflections(x_mrad, y_mrad)
        dialogue.ask(Query(f"xy={x:.4f};{y:.4f}", _done), doing)

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        return bool(dialogue.ask(Query("status", _register), doing) & _NOT_STABLE)


def _deflections(x_mrad: float, y_mrad: float) -> tuple[float, float]:
    """Parts of full scale; the two lie in the unit circle."""
    return math.tan(x_mrad / 1000) / _FULL_SCALE, math.tan(y_mrad / 1000) / _FULL_SCALE


def _nobody(line: str) -> None:
    """No answer of this device distinguishes it from another."""


def _ready(answer: str) -> str:
    if answer.strip() != "OK":
        raise UnreadableError(answer)
    return answer


def _register(answer: str) -> int:
    found = _REGISTER.fullmatch(answer.strip())
    if found is None:
        _done(answer)
        raise UnreadableError(answer)
    return int(found.group(1), 16)


def _done(answer: str) -> None:
    text = answer.strip()
    if text == "OK":
        return
    if re.fullmatch(r"[A-Z]{2}|ERROR[ -~]*", text):
        meaning, remedy, passing = _REFUSALS.get(text, ("an error", "see the controller's manual", True))
        raise RefusedError(f"the controller answers {text}: {meaning}", remedy, passing=passing)
    raise UnreadableError(answer)
