"""A mirror controller as docs/reference/generic-mirror.md defines it."""

import re
from functools import reduce

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.mirrors import MIRROR_DEVICES, MirrorDevice, number


@MIRROR_DEVICES.register
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
