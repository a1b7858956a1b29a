"""A Mirrorcle MTI controller on its serial line.

Where the replies come from: public programs of laboratories for the MTI controllers, two in agreement with each other
(``MEMS_driver.py``, a base class for the serial line, of April 2023; a class ``SerialMirror`` that drives Mirrorcle and
Optotune mirrors): the greeting to ``$MTI$``, ``MTI-ERR InvalidCommand`` to ``$MTI$`` within command mode, ``MTI-OK`` to
``MTI+VB``, ``MTI+VD``, ``MTI+BW``, ``MTI+EN``, ``MTI+DI`` and ``MTI+GT``, ``MTI-Device Exit Command Mode`` to
``MTI+EX``; ranges of the settings, and that they are not to be changed while the mirror is on, from the first.

Not confirmed by a source: the words after ``MTI-ERR`` other than InvalidCommand, and which one answers a setting while
the mirror is on.
"""

from __future__ import annotations

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.mirrors import MIRROR_DEVICES, MirrorDevice, number

# Bias, largest difference and filter, as public drivers limit them.
RANGES = {"VB": (0, 100), "VD": (0, 200), "BW": (50, 15000)}


@MIRROR_DEVICES.register
class MirrorcleDevice(MirrorDevice):
    """An MTI controller with its mirror; it keeps its settings when its command mode is left.

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
        elif verb[4:] in RANGES and len(numbers) == 1 and self._enabled:
            return "MTI-ERR InvalidCommand"
        elif verb[4:] in RANGES and len(numbers) == 1:
            least, most = RANGES[verb[4:]]
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
