"""Polytec OFV-3001 vibrometer controllers on their RS-232 interface.

Sources: the controller's user manual, appendix E.2.4 and E.2.6 (``VELO?`` -> ``1`` to ``9`` with the table of ranges,
``LEV`` -> ``0`` to ``40``, line feeds, and the answers with ``ECHOON``: ``VELO3``, ``LEV12``), and the MATLAB program
of a master's thesis at TU Darmstadt (T-Fritzsche/Vibrometer), which asks ``VELO?`` at 9600 baud after ``REN``.

Not confirmed: whether it answers before ``REN`` has switched it to remote control (here ``REN`` is sent only where it
does not); other baud rates; how late the output is behind the surface, which it does not say.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, UnreadableError
from wavefocus.drivers.registry import VIBROMETERS, VibrometerReading, rig_key
from wavefocus.drivers.serial_vibrometer import SerialVibrometer, optional_answer

FULL_LEVEL = 40
# Range number: decoder and mm/s/V (manual, E.2.4).
RANGES = {
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

    least_signal_level: float = rig_key(
        "Least signal level", "Smallest signal level that will do", default=0.0, in_plan="free", ge=0, le=1
    )

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
        level = optional_answer(dialogue, Query("LEV", _level))
        decoder, range_mm_s_per_v = RANGES[number]
        stated = f"OFV-3001, {decoder}"
        require_identity(stated)
        return VibrometerReading(1e-3 * range_mm_s_per_v, f"{range_mm_s_per_v}mm/s/V", None, level, stated)


def _range_number(answer: str) -> int:
    found = re.fullmatch(r"(?:VELO)?([1-9])", answer.strip())
    if found is None:
        raise UnreadableError(answer)
    return int(found.group(1))


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


def _level(answer: str) -> float:
    found = re.fullmatch(r"(?:LEV)?(\d{1,2})", answer.strip())
    if found is None or int(found.group(1)) > FULL_LEVEL:
        raise UnreadableError(answer)
    return int(found.group(1)) / FULL_LEVEL
