"""An ASI Tiger controller on its serial line; its sources stand in the driver's module."""

from __future__ import annotations

import math
import re

from mocks.wire.device_numbers import number
from mocks.wire.motion import MirrorMotion

ASI_AXIS = re.compile(r"([A-Z])(?:=(\S+))?")


class AsiTigerDevice:
    """A TG-1000 with one micro-mirror card.

    Parameters
    ----------
    motion : MirrorMotion
        The mirror.
    axes : tuple of str
        Letters of its two axes.
    units_per_degree : float
        What ``UM`` answers.
    beam_per_mirror : float
        Optical degrees per degree of the controller.
    external_input : bool
        Whether the card follows its analog inputs (``PM`` 1), so that no serial move moves the mirror.
    name : str
        First line of the build information.
    """

    role = "mirror"
    baud = 115200
    command_end = "\r"

    def __init__(
        self,
        motion: MirrorMotion,
        axes: tuple[str, str] = ("X", "Y"),
        *,
        units_per_degree: float = 1000.0,
        beam_per_mirror: float = 2.0,
        external_input: bool = False,
        name: str = "TIGER_COMM",
    ) -> None:
        self._motion = motion
        self._axes = axes
        self._units_per_degree = units_per_degree
        self._units_per_mrad = units_per_degree * math.degrees(1e-3) / beam_per_mirror
        self._external_input = external_input
        self._name = name

    def operation(self, command: str) -> str:
        verb = command.split(" ", maxsplit=1)[0].upper()
        return {"BU": "identify", "M": "move", "/": "busy", "STATUS": "busy", "W": "where", "UM": "units"}.get(
            verb, verb.lower()
        )

    def answer(self, command: str) -> str:
        verb, _, rest = command.strip().upper().partition(" ")
        if verb in {"/", "STATUS"}:
            return "B\r\n" if self._motion.busy() else "N\r\n"
        if verb == "BU":
            return self._build(self._name) if rest.strip() == "X" else f"{self._name}\r\n"
        if verb in {"UM", "PM"}:
            return self._settings(verb, rest)
        if verb in {"M", "W"}:
            return self._move(rest) if verb == "M" else self._where(rest)
        if verb == "\\":
            self._motion.start(*self._motion.where_mrad())
            return ":A \r\n"
        return ":N-1\r\n"

    def refusal(self, command: str) -> str:
        return ":N-5\r\n"

    def impostor(self, command: str) -> str:
        return self._build("OTHER_COMM")

    def restart(self) -> None:
        self._motion.start(0.0, 0.0)

    def _build(self, name: str) -> str:
        letters = " ".join(("Z", *self._axes))
        return (
            f"{name}\rMotor Axes: {letters}\rAxis Types: p u u\rAxis Addr: 1 2 2\r"
            f"Hex Addr: 31 32 32\rAxis Props: 0 0 0\r\n"
        )

    def _settings(self, verb: str, rest: str) -> str:
        asked = [one.rstrip("?") for one in rest.split()]
        if not asked:
            return ":N-3\r\n"
        if any(axis not in self._axes for axis in asked):
            return ":N-2\r\n"
        value = f"{self._units_per_degree:.3f}" if verb == "UM" else str(int(self._external_input))
        return ":A " + " ".join(f"{axis}={value}" for axis in self._axes if axis in asked) + "\r\n"

    def _move(self, rest: str) -> str:
        target = list(self._motion.where_mrad())
        parts = rest.split()
        if not parts:
            return ":N-3\r\n"
        for part in parts:
            found = ASI_AXIS.fullmatch(part)
            if found is None or found.group(1) not in self._axes:
                return ":N-2\r\n"
            units = number(found.group(2))
            if units is None:
                return ":N-3\r\n"
            target[self._axes.index(found.group(1))] = units / self._units_per_mrad
        if not self._motion.reaches(*target):
            return ":N-4\r\n"
        if not self._external_input:
            self._motion.start(*target)
        return ":A \r\n"

    def _where(self, rest: str) -> str:
        asked = rest.split()
        if not asked or any(axis not in self._axes for axis in asked):
            return ":N-2\r\n" if asked else ":N-3\r\n"
        where = dict(zip(self._axes, self._motion.where_mrad(), strict=True))
        # In the order of the hardware, whatever the order of the question.
        units = [f"{where[axis] * self._units_per_mrad:.1f}" for axis in self._axes if axis in asked]
        return f":A {' '.join(units)} \r\n"
