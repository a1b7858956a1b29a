"""ASI Tiger (TG-1000) and MS-2000 controllers with a scanner (micro-mirror or galvo) card.

Sources: "ASI Tiger System Instruction Manual" of 9 March 2015, part "TG-1000 Programming Manual", sections "RS-232
Communication" (syntax), "Error Codes", "Command: BUILD" and "Command: STATUS"; ASI's documentation pages
``commands/where`` (positions come in the order of the hardware, so one axis is asked at a time here) and
``commands/pm`` (internal or external input; external is the default of firmware before 3.10); Micro-Manager's device
adapter ASITiger, ``ASIScanner.cpp`` (``UM`` gives units per degree, 1000 by default) and ``ASIHub.cpp`` (answers).

Not confirmed: whether the degrees of ``UM`` are those of the mirror or of the beam. Micro-Manager calls them
"degree rotation for the micromirror", ASI's drive card guide gives 4.6 degrees for a mirror whose maker states that
as its mechanical tilt; so the beam is taken to turn `beam_per_mirror` = 2 times as far. Replies must be in the
MS-2000 syntax, the default (``VB F=0``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from drivers.errors import InstrumentError
from drivers.serial_line.dialogue import Dialogue
from drivers.serial_line.question import Marker, Query, RefusedError, UnreadableError

NUMBER = r"-?\d{1,9}(?:\.\d{1,9})?"
CODES = {
    1: ("it does not know the command", "check driver in the rig file", True),
    2: ("it has no such axis", "name the scanner's axes in the rig file", False),
    3: ("it misses a parameter", "check driver in the rig file", True),
    4: ("the value is out of its range", "check limit_mrad in the rig file against the controller's SL and SU", False),
    5: ("the operation failed", "try again; if it stays, look at the controller's display", True),
    6: ("it does not understand the command", "try again; if it stays, check the cable", True),
    7: ("the card does not answer", "check that the scanner card is plugged in", False),
    21: ("it was halted by hand or by another program", "stop what halts it", True),
}


class AsiTiger:
    """The dialect ``asi-tiger``; reads back, says when it is idle.

    Parameters
    ----------
    axes : tuple of str, optional
        Letters of the scanner's axes; by default the first two of type ``u`` (micro-mirror), else X and Y.
    beam_per_mirror : float
        Optical degrees per degree of the controller, > 0.
    """

    baud = 115200
    command_end = "\r"
    patience_s = 2.0
    reach_mrad = math.inf
    says_when_idle = True

    def __init__(self, axes: tuple[str, str] | None = None, beam_per_mirror: float = 2.0) -> None:
        self._wanted_axes = axes
        self._beam_per_mirror = beam_per_mirror
        self._axes = axes or ("X", "Y")
        self._units_per_mrad = (1.0, 1.0)

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        identity = dialogue.introduce(Query("BU X", _build), patience_s)
        self._axes = self._wanted_axes or _scanner_axes(identity)
        return identity

    def marker(self, identity: str) -> Marker:
        def stranger(line: str) -> str | None:
            return line if "Motor Axes:" in line else None

        return Marker("BU X", " ".join(identity.split()), lambda line: line.endswith(identity), stranger)

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        for axis in self._axes:
            self._require_serial_input(dialogue, axis)
        x_per_degree, y_per_degree = (
            dialogue.ask(Query(f"UM {axis}?", _setting(axis)), f"reading the units of axis {axis}")
            for axis in self._axes
        )
        per_mrad = math.degrees(1e-3) / self._beam_per_mirror
        self._units_per_mrad = (x_per_degree * per_mrad, y_per_degree * per_mrad)

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        (x_axis, y_axis), (x_scale, y_scale) = self._axes, self._units_per_mrad
        command = f"M {x_axis}={x_mrad * x_scale:.3f} {y_axis}={y_mrad * y_scale:.3f}"
        dialogue.ask(Query(command, _done), doing)

    def park(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        self.move(dialogue, *park_mrad, "parking")

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        return dialogue.ask(Query("/", _busy), doing)

    def where_mrad(self, dialogue: Dialogue, doing: str) -> tuple[float, float]:
        x_units, y_units = (dialogue.ask(Query(f"W {axis}", _position), doing) for axis in self._axes)
        return x_units / self._units_per_mrad[0], y_units / self._units_per_mrad[1]

    def _require_serial_input(self, dialogue: Dialogue, axis: str) -> None:
        """Refuse a mirror that follows its analog input: it would accept every move and make none."""
        doing = f"reading the input mode of axis {axis}"
        try:
            mode = dialogue.ask(Query(f"PM {axis}?", _setting(axis)), doing)
        except InstrumentError as refusal:
            if isinstance(refusal.__cause__, RefusedError):
                return  # firmware that has no such mode
            raise
        if mode == 1:
            raise InstrumentError(
                dialogue.instrument, doing, "it follows its analog input", f"send PM {axis}=0 to the controller"
            )


def _scanner_axes(build: str) -> tuple[str, str]:
    """The first two micro-mirror axes of a ``BU X`` answer (axis type ``u`` in Micro-Manager), else X and Y."""
    letters, kinds = _row(build, "Motor Axes:"), _row(build, "Axis Types:")
    mirrors = [letter for letter, kind in zip(letters, kinds, strict=False) if kind == "u"]
    chosen = mirrors[:2] if len(mirrors) >= 2 else ["X", "Y"]
    return chosen[0], chosen[1]


def _row(build: str, title: str) -> list[str]:
    found = re.search(rf"{title}([^\r]*)", build)
    return found.group(1).split() if found else []


def _build(answer: str) -> str:
    if "Motor Axes:" not in answer:
        raise UnreadableError(answer)
    return answer


def _done(answer: str) -> None:
    _match(r":A ?", answer)


def _busy(answer: str) -> bool:
    return _match(r"([BN]) ?", answer).group(1) == "B"


def _position(answer: str) -> float:
    return float(_match(rf":A ({NUMBER}) ?", answer).group(1))


def _setting(axis: str) -> Callable[[str], float]:
    """Read ``:A X=1000``, or ``:X=1000 A`` as older firmware says it, or ``X=1000 :A``."""

    def read(answer: str) -> float:
        number = rf"{axis}=({NUMBER})"
        found = _match(rf":A {number} ?|:{number} A ?|{number} :A ?", answer)
        return float(next(group for group in found.groups() if group is not None))

    return read


def _match(pattern: str, answer: str) -> re.Match[str]:
    """Match the whole answer, or say what its error code means."""
    refusal = re.fullmatch(r":N-(\d{1,2}) ?", answer)
    if refusal is not None:
        code = int(refusal.group(1))
        meaning, remedy, passing = CODES.get(code, ("an error that the manual does not list", "see the manual", True))
        raise RefusedError(f"the controller answers :N-{code}: {meaning}", remedy, passing=passing)
    found = re.fullmatch(pattern, answer)
    if found is None:
        raise UnreadableError(answer)
    return found
