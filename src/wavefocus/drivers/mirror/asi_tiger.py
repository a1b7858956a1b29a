"""ASI Tiger (TG-1000) controllers with a scanner card: a micro-mirror (MEMS) or a galvo.

Sources: "ASI Tiger System Instruction Manual" of 9 March 2015, part "TG-1000 Programming Manual", sections "RS-232
Communication" (syntax), "Error Codes", "Command: BUILD", "Command: STATUS" and "Tiger Banner"; ASI's documentation
pages ``commands/build``, ``commands/where`` (positions come in the order of the hardware, so one axis is asked at a
time here) and ``commands/pm``; "MicroMirror Drive Card User Guide" (4.6 degrees); Micro-Manager's device adapter
ASITiger: ``ASIScanner.cpp`` (``UM`` gives units per degree, 1000 by default; ``SL`` and ``SU`` are in degrees; ``PM``
is the input mode of a card whose modules have no ``DAC_4CH``, and an output range otherwise), ``ASIHub.cpp`` (answers,
axis types and modules of ``BU X``), ``ASITigerComm.cpp`` (``VB F=0``; type ``u`` is a scanner, ``x`` a stage) and
``ASIPeripheralBase.h`` (addresses of cards, one raw byte from 0x31 to 0x39 and from 0x81 to 0xF5). ASI's page
``commands/vb``: ``VB X``, which a laboratory may have saved, makes answers end with a carriage return only (bit 8) or
a move answer with its target (bit 16); it is set to 0 here, as ``VB F`` is.

Not confirmed: whether the degrees of ``UM``, ``SL`` and ``SU`` are those of the mirror or of the beam. Micro-Manager
calls them "degree rotation for the micromirror", ASI's drive card guide gives 4.6 degrees for a mirror whose maker
states that as its mechanical tilt; so the beam is taken to turn `beam_per_mirror` = 2 times as far.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, RefusedError, RestartedError, UnreadableError, matched
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.registry import MIRRORS, rig_key
from wavefocus.drivers.serial_device import Dialect, tolerance_key

# Every answer ends with a line feed, and a move answers without its target.
_PLAIN_ANSWERS = "VB X=0"
# Type of a scanner's axes in the answer to BU X.
_SCANNER = "u"
_NUMBER = r"-?\d{1,9}(?:\.\d{1,9})?"
# The first lines of the banner that the controller sends when it has started.
_BANNER = re.compile(r"At 3[0-9A-F]: ")
# Firmware modules whose cards have output ranges, and no analog input that the mirror could follow.
_OUTPUT_MODULES = ("DAC_4CH", "SIGNAL_DAC")
# One lost character of a command reads as another axis or another number.
_ASKED_ONCE_MORE = {2, 4}
_CODES = {
    1: ("it does not know the command", "check driver in the rig file", True),
    2: ("it has no such axis", "correct axes of [mirror] in the rig file", False),
    3: ("it misses a parameter", "check driver in the rig file", True),
    4: ("the value is out of its range", "check limit_mrad in the rig file against the controller's SL and SU", False),
    5: ("the operation failed", "try again; if it stays, look at the controller's display", True),
    6: ("it does not understand the command", "try again; if it stays, check the cable", True),
    7: ("the card does not answer", "check that the scanner card is plugged in", False),
    21: ("it was halted by hand or by another program", "stop what halts it", True),
}


@MIRRORS.register
@dataclass(kw_only=True)
class AsiTiger(Dialect):
    """The dialect ``asi-tiger``; reads back, says when it is idle."""

    axes: tuple[str, str] | None = rig_key(
        "Letters of the scanner's two axes; needed where the controller has two scanners",
        default=None,
        pattern=(r"[A-Za-z]", "must be the letter of an axis"),
    )
    beam_per_mirror: float = rig_key(
        "Degrees that the beam turns by per degree of the controller",
        default=2.0,
        in_plan="always",
        gt=0,
    )
    tolerance_mrad: float = tolerance_key()

    name = "asi-tiger"
    # Micro-mirrors of its scanner cards turn by 4.6 degrees to either side, the beam by 160.6 mrad.
    table_defaults = MappingProxyType({"limit_mrad": 155.0, "park_mrad": (-150.0, -150.0)})
    command_end = "\r"
    encoding = "latin-1"  # addresses of cards are bytes up to 0xF5

    def __post_init__(self) -> None:
        self._build = ""
        self._axes = ("", "")
        self._units_per_mrad = (1.0, 1.0)
        self._reach_mrad = math.inf

    @property
    def reach_mrad(self) -> float:
        """The nearest of the controller's limits ``SL`` and ``SU``; infinite until they are read."""
        return self._reach_mrad

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        # Answers without a line feed cannot be read before they are asked for in another form.
        self._build = dialogue.introduce(Query("BU X", _build), patience_s, between=_PLAIN_ANSWERS)
        return _printable(self._build)

    def device(self, identity: str) -> DeviceIdentity:
        return DeviceIdentity("ASI", identity)

    def marker(self, identity: str) -> Marker:
        def stranger(line: str) -> str | None:
            if _BANNER.search(line):
                raise RestartedError(line)
            return line if "Motor Axes:" in line else None

        return Marker("BU X", " ".join(identity.split()), lambda line: _printable(line).endswith(identity), stranger)

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        # What the axes are comes first: nothing is set or moved on a controller that has no scanner.
        self._axes = _scanner_axes(self._build, self.axes, dialogue.instrument)
        for command in (_PLAIN_ANSWERS, "VB F=0"):
            dialogue.ask(Query(command, _accepted), "choosing the syntax of its answers")
        for axis in self._axes:
            self._require_serial_input(dialogue, axis)
        scales = [
            dialogue.ask(Query(f"UM {axis}?", _setting(axis)), f"reading the units of axis {axis}")
            for axis in self._axes
        ]
        per_mrad = math.degrees(1e-3) / self.beam_per_mirror
        self._units_per_mrad = (scales[0] * per_mrad, scales[1] * per_mrad)
        self._reach_mrad = min(self._read_reach_degrees(dialogue, axis) for axis in self._axes) / per_mrad

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        (x_axis, y_axis), (x_scale, y_scale) = self._axes, self._units_per_mrad
        command = f"M {x_axis}={x_mrad * x_scale:.3f} {y_axis}={y_mrad * y_scale:.3f}"
        dialogue.ask(Query(command, _done), doing)

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        return dialogue.ask(Query("/", _busy), doing)

    def where_mrad(self, dialogue: Dialogue, doing: str) -> tuple[float, float]:
        x_units, y_units = (dialogue.ask(Query(f"W {axis}", _position), doing) for axis in self._axes)
        return x_units / self._units_per_mrad[0], y_units / self._units_per_mrad[1]

    def _read_reach_degrees(self, dialogue: Dialogue, axis: str) -> float:
        """How far an axis may turn to either side, in the controller's degrees."""
        lower, upper = (
            dialogue.ask(Query(f"{command} {axis}?", _setting(axis)), f"reading the limits of axis {axis}")
            for command in ("SL", "SU")
        )
        return max(0.0, min(-lower, upper))

    def _require_serial_input(self, dialogue: Dialogue, axis: str) -> None:
        """Refuse a micro-mirror that follows its analog input: it would accept every move and make none."""
        command = f"{_address(self._build, axis, dialogue.instrument)}BU X"
        card = dialogue.ask(Query(command, _card), f"asking the card of axis {axis} for its firmware modules")
        if any(module in card for module in _OUTPUT_MODULES):
            return  # there, PM is the range of the output
        doing = f"reading the input mode of axis {axis}"
        try:
            mode = dialogue.ask(Query(f"PM {axis}?", _setting(axis)), doing)
        except InstrumentError as refusal:
            if isinstance(refusal.__cause__, RefusedError):
                return  # firmware that has no such mode
            raise
        if mode == 1:
            cause = "it follows its analog input, as it may after it was switched on"
            remedy = f"send PM {axis}=0 to the controller"
            raise InstrumentError(dialogue.instrument, doing, cause, remedy)


def _scanner_axes(build: str, wanted: tuple[str, str] | None, instrument: str) -> tuple[str, str]:
    """The axes to move, of type ``u`` (scanner) both. Raises InstrumentError."""

    def refuse(cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(instrument, "looking for the scanner's axes", cause, remedy)

    letters = [letter.upper() for letter in _row(build, "Motor Axes:")]
    kinds = _row(build, "Axis Types:")
    scanner = [letter for letter, kind in zip(letters, kinds, strict=False) if kind == _SCANNER]
    has = ", ".join(f"{letter} ({kind})" for letter, kind in zip(letters, kinds, strict=False)) or "none"
    if len(scanner) < 2:
        raise refuse(
            f"the controller has no scanner: its axes and their types are {has}, a scanner's are {_SCANNER}",
            "plug in a scanner card, or correct driver and port of [mirror] in the rig file",
        )
    choose = f"choose two of {', '.join(scanner)} as axes of [mirror] in the rig file"
    if wanted is None:
        if len(scanner) > 2:
            raise refuse(f"it has more than one scanner, with axes {', '.join(scanner)}, and none is named", choose)
        return scanner[0], scanner[1]
    named = (wanted[0].upper(), wanted[1].upper())
    if named[0] == named[1] or any(axis not in scanner for axis in named):
        raise refuse(f"{named[0]} and {named[1]} are not two axes of a scanner: its axes and types are {has}", choose)
    return named


def _address(build: str, axis: str, instrument: str) -> str:
    """The character that addresses the card of an axis. Raises InstrumentError."""
    index = [letter.upper() for letter in _row(build, "Motor Axes:")].index(axis)
    in_hex, as_characters = _row(build, "Hex Addr:"), _row(build, "Axis Addr:")
    if index < len(in_hex):  # since firmware of September 2013
        return chr(int(in_hex[index], 16))
    if index < len(as_characters):
        return as_characters[index]
    raise InstrumentError(
        instrument, f"looking for the card of axis {axis}", "BU X names no address", "update the controller's firmware"
    )


def _row(build: str, title: str) -> list[str]:
    found = re.search(rf"{title}([^\r]*)", build)
    return found.group(1).split() if found else []


def _printable(text: str) -> str:
    """The same without the raw bytes by which cards are addressed."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


def _build(answer: str) -> str:
    if "Motor Axes:" not in answer or _BANNER.search(answer):
        raise UnreadableError(answer)
    # Answers that ended with only a carriage return may stand before it in the same line.
    before = answer[: answer.rindex("Motor Axes:")].rstrip("\r")
    return answer[before.rfind("\r") + 1 :]


def _card(answer: str) -> str:
    """A card's own build: its axes, and below them its firmware modules."""
    return _match(r"(?s).*Motor Axes:.*", answer).group()


def _accepted(answer: str) -> None:
    """Older firmware has no such setting, and answers it in more than one way."""
    if _BANNER.search(answer):
        raise RestartedError(answer)


def _done(answer: str) -> None:
    # The target, where a card prints it all the same.
    _match(rf":A ?(?:{_NUMBER} ?)*", answer)


def _busy(answer: str) -> bool:
    return _match(r"([BN]) ?", answer).group(1) == "B"


def _position(answer: str) -> float:
    return float(_match(rf":A ({_NUMBER}) ?", answer).group(1))


def _setting(axis: str) -> Callable[[str], float]:
    """Read ``:A X=1000``, or ``:X=1000 A`` as older firmware says it, or ``X=1000 :A``."""

    def read(answer: str) -> float:
        number = rf"{axis}=({_NUMBER})"
        found = _match(rf":A {number} ?|:{number} A ?|{number} :A ?", answer)
        return float(next(group for group in found.groups() if group is not None))

    return read


def _match(pattern: str, answer: str) -> re.Match[str]:
    """Match the whole answer, or say what its error code means."""
    if _BANNER.search(answer):
        raise RestartedError(answer)
    refusal = re.fullmatch(r":N-(\d{1,2}) ?", answer)
    if refusal is not None:
        code = int(refusal.group(1))
        meaning, remedy, passing = _CODES.get(code, ("an error that the manual does not list", "see the manual", True))
        raise RefusedError(
            f"the controller answers :N-{code}: {meaning}", remedy, passing=passing, again=code in _ASKED_ONCE_MORE
        )
    return matched(pattern, answer)
