"""Emulated mirror controllers on a serial line, one class for each dialect; the ASI Tiger's is in `asi_tiger`."""

from __future__ import annotations

import math
import re
from functools import reduce

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.emulated_serial import MirrorDevice, number


class GenericMirrorDevice(MirrorDevice):
    """A mirror controller as docs/reference/generic-mirror.md defines it.

    identity: Maker, model, serial number and version, with three commas.
    """

    name = "generic"

    def __init__(self, motion: MirrorMotion, identity: str = "wavefocus,generic mirror,0001,1.0") -> None:
        super().__init__(motion)
        self._identity = identity
        self._park_mrad = motion.park_mrad

    def operation(self, command: str) -> str:
        verb = re.split(r"[=*]", command.lstrip("*"))[0]
        named = {"IDN?": "identify", "BUSY?": "busy", "PARK": "park"}
        if verb in named:
            return "enable" if command.startswith("PARK=") else named[verb]
        return "where" if verb in {"X?", "Y?", "XY?"} else "move" if verb in {"X", "Y", "XY"} else verb.lower()

    def answer(self, command: str) -> str:
        text, star, sum_ = command.rpartition("*")
        if not (star and text and re.fullmatch(r"[0-9A-Fa-f]{2}", sum_)):
            return f"{self._obey(command)}\r\n"
        if sum_.upper() != self._checksum(text):
            return self._checked("ERR 4 checksum")
        return self._checked(self._obey(text))

    def refusal(self, command: str) -> str:
        return self._checked("ERR 5 not ready")

    def impostor(self, command: str) -> str:
        return self._checked("wavefocus,another mirror,0002,1.0")

    def restart(self) -> None:
        self._park_mrad = self._motion.park_mrad
        self._motion.start(*self._park_mrad)

    def _obey(self, text: str) -> str:
        x_mrad, y_mrad = self._motion.where_mrad()
        asked = {
            "*IDN?": self._identity,
            "X?": f"{x_mrad:.4f}",
            "Y?": f"{y_mrad:.4f}",
            "XY?": f"{x_mrad:.4f},{y_mrad:.4f}",
            "BUSY?": str(int(self._motion.busy())),
            "LIMIT?": f"{self._motion.limit_mrad:.4f}",
        }
        if text in asked:
            return asked[text]
        if text == "PARK":
            return self._start(self._park_mrad)
        verb, equals, values = text.partition("=")
        if not equals or verb not in {"X", "Y", "XY", "PARK"}:
            return "ERR 1 unknown command"
        numbers = [value for value in map(number, values.split(",")) if value is not None]
        if len(numbers) != (1 if verb in {"X", "Y"} else 2) or len(numbers) != len(values.split(",")):
            return "ERR 2 number"
        target = (x_mrad if verb == "Y" else numbers[0], y_mrad if verb == "X" else numbers[-1])
        if not self._motion.reaches(*target):
            return "ERR 3 out of range"
        if verb == "PARK":
            self._park_mrad = target
            return "OK"
        return self._start(target)

    def _start(self, target_mrad: tuple[float, float]) -> str:
        self._motion.start(*target_mrad)
        return "OK"

    def _checked(self, text: str) -> str:
        return f"{text}*{self._checksum(text)}\r\n"

    @staticmethod
    def _checksum(text: str) -> str:
        return f"{reduce(lambda sum_, byte: sum_ ^ byte, text.encode('latin-1'), 0):02X}"


# Bias, largest difference and filter, as public drivers limit them.
_RANGES = {"VB": (0, 100), "VD": (0, 200), "BW": (50, 15000)}


class MirrorcleDevice(MirrorDevice):
    """An MTI controller with its mirror; it keeps its settings when its command mode is left.

    Where the replies come from: public programs of laboratories for the MTI controllers, two in agreement with each
    other (``MEMS_driver.py``, a base class for the serial line, of April 2023; a class ``SerialMirror`` that drives
    Mirrorcle and Optotune mirrors): the greeting to ``$MTI$``, ``MTI-ERR InvalidCommand`` to ``$MTI$`` within command
    mode, ``MTI-OK`` to ``MTI+VB``, ``MTI+VD``, ``MTI+BW``, ``MTI+EN``, ``MTI+DI`` and ``MTI+GT``, ``MTI-Device Exit
    Command Mode`` to ``MTI+EX``; ranges of the settings, and that they are not to be changed while the mirror is on,
    from the first.

    Not confirmed by a source: the words after ``MTI-ERR`` other than InvalidCommand, and which one answers a setting
    while the mirror is on.

    full_scale_mrad: Optical angle at full deflection.
    identity: Its name in the greeting.
    """

    name = "mirrorcle-mti"

    def __init__(self, motion: MirrorMotion, full_scale_mrad: float, *, identity: str = "MTI-MZ-2.3.113:USB") -> None:
        super().__init__(motion)
        self._full_scale_mrad = full_scale_mrad
        self._identity = identity
        self._commanded = False
        self._enabled = False
        self._target_mrad = (0.0, 0.0)

    @classmethod
    def turning(cls, motion: MirrorMotion, full_scale_mrad: float | None) -> MirrorcleDevice:
        return cls(motion, full_scale_mrad or motion.limit_mrad)

    def operation(self, command: str) -> str:
        verb = command.split(" ", maxsplit=1)[0]
        return {"$MTI$": "identify", "MTI+GT": "move", "MTI+EN": "enable", "MTI+DI": "disable"}.get(verb, verb.lower())

    def answer(self, command: str) -> str:
        if command == "$MTI$" and not self._commanded:
            self._commanded = True
            return self._greeting(self._identity)
        if not self._commanded:
            return ""
        verb, *arguments = command.split()
        if verb == "MTI+EX" and not arguments:
            self._commanded = False
            return "MTI-Device Exit Command Mode\r\n"
        return f"{self._obey(verb, arguments)}\r\n"

    def refusal(self, command: str) -> str:
        return "MTI-ERR DeviceBusy\r\n"

    def impostor(self, command: str) -> str:
        return self._greeting("MTI-OTHER-1.0:USB")

    def restart(self) -> None:
        self._commanded = self._enabled = False
        self._target_mrad = (0.0, 0.0)
        self._motion.start(0.0, 0.0)

    def _obey(self, verb: str, arguments: list[str]) -> str:
        numbers = [number(argument) for argument in arguments]
        if verb == "MTI+EN" and not arguments:
            self._enabled = True
            self._motion.start(*self._target_mrad)
        elif verb == "MTI+DI" and not arguments:
            self._enabled = False
            self._motion.start(0.0, 0.0)
        elif verb == "MTI+GT" and len(numbers) == 3:
            return self._point(numbers[0], numbers[1])
        elif verb[4:] in _RANGES and len(numbers) == 1 and self._enabled:
            return "MTI-ERR InvalidCommand"
        elif verb[4:] in _RANGES and len(numbers) == 1:
            least, most = _RANGES[verb[4:]]
            if numbers[0] is None or not least <= numbers[0] <= most:
                return "MTI-ERR InvalidParameter"
        else:
            return "MTI-ERR InvalidCommand"
        return "MTI-OK"

    def _point(self, x: float | None, y: float | None) -> str:
        if x is None or y is None or max(abs(x), abs(y)) > 1:
            return "MTI-ERR InvalidParameter"
        target_mrad = (x * self._full_scale_mrad, y * self._full_scale_mrad)
        if not self._motion.reaches(*target_mrad):
            return "MTI-ERR InvalidParameter"
        self._target_mrad = target_mrad
        # Without high voltage the mirror lies flat, and the command is accepted all the same.
        if self._enabled:
            self._motion.start(*target_mrad)
        return "MTI-OK"

    @staticmethod
    def _greeting(name: str) -> str:
        return f"MTI-Device {name} Ready in Command Mode\r\n"


_LEAVE_PRO_MODE = "\x7e\x00\x06\x02\x00\x00\x00\x00\x7e"
_NOT_STABLE = 1 << 4
_FULL_SCALE = math.tan(math.radians(50.0))


class OptotuneDevice(MirrorDevice):
    """An Optotune MR-E-2.

    Where the replies come from (the sources stand in the driver's module):

    =================================  ============================================================================
    reply                              source
    =================================  ============================================================================
    ``Start`` -> ``OK``                optoMDC of the vendor's Python SDK, the conversation in ``MRE2Board``
    frame 7E 00 06 02 00 00 00 00 7E   the same: no answer; it ends the pro mode, in simple mode it is part of a line
    ``GoPro`` -> ``OK``                the same: from then on text is not answered
    unknown command -> ``NO``          the same
    ``acknowledge`` -> ``OK``          public programs for this controller
    ``status`` -> ``00000000``         MR-E-3 manual, STATUS: 32 bits in hexadecimal, bit 4: not stable
    ``xy=x;y`` -> ``OK``, ``OU``       MR-E-3 manual: what is beyond the range is clamped, and the mirror moves there
    =================================  ============================================================================

    Not confirmed by a source: which of ``OU`` and ``OL`` answers a target beyond the circle but within each axis.

    pro_mode: Whether another program has left it in its pro mode.
    """

    name = "optotune-mre2"
    baud = 256000

    def __init__(self, motion: MirrorMotion, *, pro_mode: bool = False) -> None:
        super().__init__(motion)
        self._pro_mode = pro_mode

    def operation(self, command: str) -> str:
        verb = command.lower()
        return {"start": "identify", "acknowledge": "enable", "status": "busy"}.get(
            verb, "move" if "xy" in verb else verb
        )

    def answer(self, command: str) -> str:
        if self._pro_mode:
            self._pro_mode = _LEAVE_PRO_MODE not in command
            return ""
        verb = command.strip().lower()
        if verb == "gopro":
            self._pro_mode = True
        if verb in {"start", "acknowledge", "gopro"}:
            return "OK\r\n"
        if verb == "status":
            return f"{_NOT_STABLE if self._motion.busy() else 0:08X}\r\n"
        found = re.fullmatch(r"xy= ?([^;]+); ?([^;]+)", verb)
        x, y = (number(found.group(1)), number(found.group(2))) if found else (None, None)
        return "NO\r\n" if x is None or y is None else self._point(x, y)

    def refusal(self, command: str) -> str:
        return "NO\r\n"

    def impostor(self, command: str) -> str:
        return "Ready\r\n"

    def restart(self) -> None:
        super().restart()
        self._pro_mode = False

    def _point(self, x: float, y: float) -> str:
        beyond = max(1.0, math.hypot(x, y))
        angles_mrad = (1000 * math.atan(share / beyond * _FULL_SCALE) for share in (x, y))
        limit_mrad = self._motion.limit_mrad
        self._motion.start(*(max(-limit_mrad, min(limit_mrad, angle_mrad)) for angle_mrad in angles_mrad))
        if beyond <= 1.0:
            return "OK\r\n"
        return "OL\r\n" if min(x, y) < -1.0 else "OU\r\n"


MIRROR_DEVICES: dict[str, type[MirrorDevice]] = {
    device.name: device for device in (AsiTigerDevice, GenericMirrorDevice, MirrorcleDevice, OptotuneDevice)
}


def mirror_device(dialect: str, motion: MirrorMotion, full_scale_mrad: float | None = None) -> MirrorDevice:
    """A device that speaks a dialect. Raises ValueError.

    motion: How its mirror moves. Of a mirror that cannot be asked whether it moves, the longest move must be shorter
        than the settling time of the driver.
    full_scale_mrad: Optical angle at full deflection, by default as its kind has it.
    """
    if dialect not in MIRROR_DEVICES:
        raise ValueError(f"there is no mirror dialect {dialect!r}; there are {', '.join(MIRROR_DEVICES)}")
    return MIRROR_DEVICES[dialect].turning(motion, full_scale_mrad)
