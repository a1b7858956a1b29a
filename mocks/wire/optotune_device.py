"""An Optotune MR-E-2 controller on its serial line; its sources stand in the driver's module."""

from __future__ import annotations

import math
import re

from mocks.wire.device_numbers import number
from mocks.wire.motion import MirrorMotion


class OptotuneDevice:
    """An MR-E-2 in its simple mode, as far as it is known; see the driver for what is not."""

    role = "mirror"
    baud = 256000
    command_end = "\n"
    FULL_SCALE = math.tan(math.radians(50.0))

    def __init__(self, motion: MirrorMotion) -> None:
        self._motion = motion

    def operation(self, command: str) -> str:
        return {"start": "identify", "acknowledge": "enable"}.get(command, "move" if "xy" in command else command)

    def answer(self, command: str) -> str:
        if command in {"start", "acknowledge"}:
            return "OK\r\n"
        if command == "status":
            return "0000000000\r\n"
        found = re.fullmatch(r"xy= ?([^;]+); ?([^;]+)", command)
        values = [number(found.group(1)), number(found.group(2))] if found else [None]
        deflections = [value for value in values if value is not None and abs(value) <= 1]
        if len(deflections) != 2:
            return "NO\r\n"
        x_mrad, y_mrad = (1000 * math.atan(one * self.FULL_SCALE) for one in deflections)
        if not self._motion.reaches(x_mrad, y_mrad):
            return "NO\r\n"
        self._motion.start(x_mrad, y_mrad)
        return "OK\r\n"

    def refusal(self, command: str) -> str:
        return "NO\r\n"

    def impostor(self, command: str) -> str:
        return "Ready\r\n"

    def restart(self) -> None:
        self._motion.start(0.0, 0.0)
