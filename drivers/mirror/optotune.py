"""Optotune MR-E-2 fast steering mirrors in their "simple mode"; experimental.

Sources: public programs for this controller (256000 baud, commands end with carriage return and line feed, ``start``
as handshake, ``status`` with ten digits, ``acknowledge``, ``xy=0.1234;-0.5000``), and one for the vendor's package,
which states the unit: x is the tangent of the beam's angle over tan 50 degrees. "MR-E-2 Development Kit Operation
Manual" (2019), section 4.2, lists the simple mode's commands; it was not at hand.

Not confirmed: the answer ``OK`` to ``xy=``, ``NO`` for what is refused, and the answer to ``status``. No question for
a serial number is known, so the device cannot be told from another of its kind: name the port by its serial number
(``serial-number:...``) where there are two. There is no read-back; a move lasts the stated settling time.
"""

from __future__ import annotations

import math
import re

from drivers.serial_line.dialogue import Dialogue
from drivers.serial_line.question import Marker, Query, RefusedError, UnreadableError

IDENTITY = "Optotune MR-E-2"
FULL_SCALE = math.tan(math.radians(50.0))


class OptotuneMre2:
    """The dialect ``optotune-mre2``."""

    baud = 256000
    command_end = "\r\n"
    patience_s = 2.0
    reach_mrad = 1000 * math.radians(50.0)
    says_when_idle = False

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        dialogue.introduce(Query("start", _ready), patience_s)
        return IDENTITY

    def marker(self, identity: str) -> Marker:
        return Marker("status", identity, lambda line: re.search(r"\d{10}$", line) is not None, lambda line: None)

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        dialogue.ask(Query("acknowledge", _done), "acknowledging earlier errors")

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        x, y = (math.tan(angle_mrad / 1000) / FULL_SCALE for angle_mrad in (x_mrad, y_mrad))
        dialogue.ask(Query(f"xy={x:.4f};{y:.4f}", _done), doing)

    def park(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        self.move(dialogue, *park_mrad, "parking")

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        return False

    def where_mrad(self, dialogue: Dialogue, doing: str) -> None:
        return None


def _ready(answer: str) -> str:
    if answer.strip() != "OK":
        raise UnreadableError(answer)
    return answer


def _done(answer: str) -> None:
    if answer.strip() == "OK":
        return
    if re.fullmatch(r"[A-Z]{2}", answer.strip()):
        raise RefusedError(f"the controller answers {answer.strip()}", "see the controller's manual", passing=True)
    raise UnreadableError(answer)
