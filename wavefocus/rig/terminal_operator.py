"""A person at a terminal: asked on standard error, answers by lines on standard input."""

from __future__ import annotations

import math
from collections.abc import Callable

from acquisition.calibration_procedures.operator import (
    BOTH,
    SUM,
    VIBROMETER,
    By,
    Here,
    Jog,
    JogView,
    Judged,
    Keep,
    MapView,
    Operator,
    To,
)
from mocks.virtual.surroundings import PatchBay
from storage.errors import InputError
from wavefocus.console import say

HELP = 'two numbers move the beam by so many mrad, "= x y" moves it there, Enter alone says: the spot is on the mark'
CABLES = {
    VIBROMETER: "plug the vibrometer into the response input",
    SUM: "plug the summing box, with all outputs for actuators in it, into the response input",
    BOTH: "plug the loopback into both inputs, reference and response",
}


def cable(source: str) -> str:
    """What is to be plugged, in words."""
    return CABLES.get(source) or f"plug {source} of the player into the response input"


class TerminalOperator:
    """Implements `acquisition.calibration_procedures.operator.Operator`.

    Parameters
    ----------
    read_line : callable
        Gives the next line with its end, or an empty text when there are no more.
    forget_typed : callable, optional
        Drops what was typed before a question was asked: no answer to it.
    """

    def __init__(self, read_line: Callable[[], str], forget_typed: Callable[[], object] = lambda: None) -> None:
        self._read_line, self._forget_typed = read_line, forget_typed

    def tell(self, line: str) -> None:
        """Read a line."""
        say(line)

    def connect(self, source: str) -> None:
        """Plug something into the response input, and press Enter."""
        line = "?"
        while line:  # nothing but Enter says that it is done
            self._forget_typed()
            say(f"{cable(source)}, then press Enter")
            line = self._answer("a cable was plugged").strip()

    def jog(self, view: JogView) -> Jog:
        """Read how the beam is to move; what is not understood is asked again."""
        if view.note:
            say(view.note)
        while True:
            self._forget_typed()
            (x_mm, y_mm), (x_mrad, y_mrad) = view.place_mm, view.at_mrad
            now = f"mirror at ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
            say(f"mark {view.number} of {view.of} at ({x_mm:g}, {y_mm:g}) mm; {now}")
            say(f"  type: {HELP}")
            line = self._answer(f"mark {view.number} of {view.of} was met").strip()
            if not line:
                return Here()
            absolute = line.startswith("=")
            numbers = _two_numbers(line.removeprefix("="))
            if numbers is not None:
                return To(*numbers) if absolute else By(*numbers)
            say(f"{line!r} is not understood: {HELP}")

    def judge(self, view: MapView) -> Judged:
        """Take the map that was jogged; one that misses a mark is refused afterwards."""
        return Keep()

    def again(self, problem: str) -> bool:
        """Look for what is wrong; Enter tries once more, s leaves it out."""
        self._forget_typed()
        say(f"{problem}; press Enter to try once more, or s and Enter to leave it out")
        return self._answer("this was decided").strip().lower() not in ("s", "skip")

    def _answer(self, before: str) -> str:
        line = self._read_line()
        if not line:
            raise InputError(f"standard input: ended before {before}")
        return line


class VirtualHands:
    """An operator whose rig is virtual: what the person says is plugged is plugged.

    Parameters
    ----------
    operator : Operator
        The person.
    patch_bay : PatchBay
        The virtual rig's.
    """

    def __init__(self, operator: Operator, patch_bay: PatchBay) -> None:
        self._operator = operator
        self._patch_bay = patch_bay

    def tell(self, line: str) -> None:
        """Read a line."""
        self._operator.tell(line)

    def connect(self, source: str) -> None:
        """Plug something into the response input."""
        self._operator.connect(source)
        self._patch_bay.connect(source)

    def jog(self, view: JogView) -> Jog:
        """Say how the beam is to move next."""
        return self._operator.jog(view)

    def judge(self, view: MapView) -> Judged:
        """Look at the residuals."""
        return self._operator.judge(view)

    def again(self, problem: str) -> bool:
        """Look for what is wrong."""
        return self._operator.again(problem)


def _two_numbers(text: str) -> tuple[float, float] | None:
    """Two finite numbers with blanks or a comma between, None where there are no such."""
    try:
        first, second = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        return None
    return (first, second) if math.isfinite(first) and math.isfinite(second) else None
