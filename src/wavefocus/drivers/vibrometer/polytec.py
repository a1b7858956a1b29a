"""Polytec vibrometer controllers, OFV-5000 and OFV-3001, on their RS-232 interface.

OFV-5000, sources: the PLACE laboratory package's driver, made after Polytec's "RS-232 Interface Commands: OFV-5000 User
Manual" (``Get,VeloDec,1,Range`` -> ``125mm/s/V``, ``Get,VeloDec,1,SignalDelay`` -> ``8.16 us``,
``Set,Interface,0,Echo,Off`` without an answer; 115200 baud, 8N1, line feed). Four public programs ask who the
controller is by ``GetDevInfo,Controller,0,Name`` (one gets ``OFV-5000 Vibrometer Controller``); PLACE also
``Get,Controller,0,Name``. Three ask ``Get,SignalLevel,0,Value`` and get a number. Three list ranges with `` LP`` (with
a low-pass filter) and ``Off``. Numbers may have decimals, behind a point or a comma. Which number a decoder has differs
from box to box: 1 is the VD-09 in those programs.

Not confirmed: the largest signal level, 775 in two of the programs; what the controller answers to a command that it
does not support (``Not Available`` for a decoder that is not installed); which byte a micro sign is (latin-1 here).

OFV-3001, sources: the controller's user manual, appendix E.2.4 and E.2.6 (``VELO?`` -> ``1`` to ``9`` with the table of
ranges, ``LEV`` -> ``0`` to ``40``, line feeds, and the answers with ``ECHOON``: ``VELO3``, ``LEV12``), and the MATLAB
program of a master's thesis at TU Darmstadt (T-Fritzsche/Vibrometer), which asks ``VELO?`` at 9600 baud after ``REN``.
Not confirmed: whether it answers before ``REN`` has switched it to remote control (here ``REN`` is sent only where it
does not); other baud rates; how late the output is behind the surface, which it does not say.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, RefusedError, UnreadableError, matched
from wavefocus.drivers.registry import VIBROMETERS, VibrometerReading, rig_key
from wavefocus.drivers.serial_device import SerialVibrometer, optional_answer

_FULL_SIGNAL_LEVEL = 775
# All programs known ask the first; PLACE's driver has the second as well.
_NAME_QUESTIONS = ("GetDevInfo,Controller,0,Name", "Get,Controller,0,Name")
_NUMBER = r"(\d{1,6}(?:[.,]\d{1,9})?)"
_METRES = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}


@VIBROMETERS.register
@dataclass(frozen=True, kw_only=True)
class Polytec(SerialVibrometer):
    """Polytec OFV-5000 controllers."""

    decoder: int = rig_key("Number of the velocity decoder in use", default=1, in_plan="free", ge=0, le=9)
    least_signal_level: float = rig_key("Smallest signal level that will do", default=0.0, in_plan="free", ge=0, le=1)

    name = "polytec-ofv5000"

    default_baud = 115200
    encoding = "latin-1"

    def ask(self, dialogue: Dialogue, require_identity: Callable[[str], None]) -> VibrometerReading:
        """Ask for all settings; see `SerialVibrometer`."""
        # With echo on, the controller repeats every command before its answer.
        asked, who = dialogue.introduce(
            _who(_NAME_QUESTIONS[0]), 2.0, before="Set,Interface,0,Echo,Off", also=_who(_NAME_QUESTIONS[1])
        )
        dialogue.recognise(Marker(asked, who, lambda line: line.endswith(who), _stranger))
        decoder_name = optional_answer(dialogue, Query(f"Get,VeloDec,{self.decoder},Name", _name))
        stated = who if decoder_name is None else f"{who}, {decoder_name}"
        require_identity(stated)
        range_text = dialogue.ask(Query(f"Get,VeloDec,{self.decoder},Range", _range), "reading the measurement range")
        latency_s = optional_answer(dialogue, Query(f"Get,VeloDec,{self.decoder},SignalDelay", _delay_s))
        level = optional_answer(dialogue, Query("Get,SignalLevel,0,Value", _level))
        return VibrometerReading(sensitivity_m_s_per_v(range_text), range_text, latency_s, level, stated)


def _who(question: str) -> Query[tuple[str, str]]:
    """Ask for the controller's name; answered with the question that it knows, and the name."""
    return Query(question, lambda answer: (question, _name(answer)))


def _name(answer: str) -> str:
    """A device's name: some letters with a number, and no number with a unit, which would be another answer."""
    name = _given(answer)
    if not re.fullmatch(r"(?=.*\d)(?!(?:Get|GetDevInfo|Set),)[A-Za-z][A-Za-z0-9 ().,;/+-]{1,80}", name):
        raise UnreadableError(answer)
    return name


def _stranger(line: str) -> str | None:
    return line if re.fullmatch(r"OFV-\d{4}[A-Za-z0-9 ().,;/+-]{0,80}", line.strip()) else None


def _range(answer: str) -> str:
    text = _given(answer)
    sensitivity_m_s_per_v(text)
    return text


def sensitivity_m_s_per_v(text: str) -> float:
    """The sensitivity of a range such as ``125mm/s/V`` or, with its low-pass filter on, ``125mm/s/V LP``.

    Raises UnreadableError; RefusedError for ``Off``.
    """
    if text.lower() == "off":
        remedy = "choose a range at the controller, or the number of the decoder in use in the rig file, decoder"
        raise RefusedError("the decoder is switched off: its range is Off", remedy)
    found = re.fullmatch(rf"{_NUMBER} ?(nm|um|mm|cm|m)/s/V(?: ?LP)?", text)
    if found is None or _number(found.group(1)) == 0:
        raise UnreadableError(text)
    return _number(found.group(1)) * _METRES[found.group(2)]


def _delay_s(answer: str) -> float:
    found = matched(rf"{_NUMBER} ?(ns|us|ms|s)", _given(answer))
    return _number(found.group(1)) * _SECONDS[found.group(2)]


def _level(answer: str) -> float:
    return min(1.0, _number(matched(_NUMBER, _given(answer)).group()) / _FULL_SIGNAL_LEVEL)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _given(answer: str) -> str:
    """The answer, unless it says that there is none; a micro sign, in latin-1 or UTF-8, becomes u."""
    text = answer.strip().replace("\xc2\xb5", "u").replace("\xb5", "u")
    if re.fullmatch(r"(?i)not (available|installed)|err(or)?\b[ -~]*|unknown[ -~]*", text):
        raise RefusedError(f"the controller answers {text!r}", "check the decoder's number in the rig file")
    return text


FULL_LEVEL = 40
# Range number: decoder and mm/s/V (manual, E.2.4).
OFV3001_RANGES = {
    5: ("OVD-01", 1),
    1: ("OVD-01", 5),
    2: ("OVD-01", 25),
    3: ("OVD-01", 125),
    4: ("OVD-01", 1000),
    6: ("OVD-02", 5),
    7: ("OVD-02", 25),
    8: ("OVD-02", 125),
    9: ("OVD-02", 1000),
}


@VIBROMETERS.register
@dataclass(frozen=True, kw_only=True)
class PolytecOfv3001(SerialVibrometer):
    """Polytec OFV-3001 controllers, with velocity decoder OVD-01 or OVD-02."""

    least_signal_level: float = rig_key("Smallest signal level that will do", default=0.0, in_plan="free", ge=0, le=1)

    name = "polytec-ofv3001"

    default_baud = 9600

    def ask(self, dialogue: Dialogue, require_identity: Callable[[str], None]) -> VibrometerReading:
        """Ask for all settings; see `SerialVibrometer`. The controller does not name itself, its ranges do."""
        number = dialogue.introduce(Query("VELO?", _range_number), 2.0, between="REN")
        # One digit proves little: the same one is needed three times.
        marked = f"OFV-3001 with range number {number}"
        dialogue.recognise(Marker("VELO?", marked, lambda text: _is_range(text, number), _other_range))
        dialogue.verify("reading the measurement range")
        dialogue.ask(Query("VELO?", lambda text: _same_range(text, number)), "reading the measurement range")
        level = optional_answer(dialogue, Query("LEV", _ofv3001_level))
        decoder, range_mm_s_per_v = OFV3001_RANGES[number]
        stated = f"OFV-3001, {decoder}"
        require_identity(stated)
        return VibrometerReading(1e-3 * range_mm_s_per_v, f"{range_mm_s_per_v}mm/s/V", None, level, stated)


def _range_number(answer: str) -> int:
    return int(matched(r"(?:VELO)?([1-9])", answer.strip()).group(1))


def _same_range(answer: str, number: int) -> int:
    if _range_number(answer) != number:
        raise UnreadableError(answer)
    return number


def _is_range(text: str, number: int) -> bool:
    """Whether a line states this range; half an answer may stand before an echoing one's."""
    return text.strip() == str(number) or text.strip().endswith(f"VELO{number}")


def _other_range(text: str) -> str | None:
    """Another range number: somebody turns the switch, or another device answers."""
    found = re.fullmatch(r"(?:VELO)?([1-9])", text.strip())
    return None if found is None else f"OFV-3001 with range number {found.group(1)}"


def _ofv3001_level(answer: str) -> float:
    level = int(matched(r"(?:LEV)?(\d{1,2})", answer.strip()).group(1))
    if level > FULL_LEVEL:
        raise UnreadableError(answer)
    return level / FULL_LEVEL
