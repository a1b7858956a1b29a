"""The operator at the bench: plugs cables, jogs the beam, decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from config.messages.calibrate import By, Drop, Here, Keep, MapView, Redo, To

VIBROMETER, SUM, BOTH = "vibrometer", "sum", "both"


def output(channel: int) -> str:
    """The word for an output of the player, plugged into the response input."""
    return f"output {channel}"


@dataclass(frozen=True, slots=True)
class JogView:
    """What a person sees while bringing the beam onto a mark.

    number, of: Which mark this is, from 1, and how many there are.
    place_mm: Where the mark lies on the surface.
    at_mrad: Where the mirror stands now.
    note: What came of the last step, where it was not done; else empty.
    moved: The beam was moved for this mark.
    """

    number: int
    of: int
    place_mm: tuple[float, float]
    at_mrad: tuple[float, float]
    note: str = ""
    moved: bool = False


Jog = By | To | Here
Judged = Keep | Redo | Drop


class Operator(Protocol):
    """A person with two hands; every method returns when it is done."""

    def tell(self, line: str) -> None:
        """Read a line."""
        ...

    def connect(self, source: str) -> None:
        """Plug something into the response input.

        source: ``"vibrometer"``, ``"output K"`` (output K of the player), ``"sum"`` (the summing box that all outputs
            for actuators are plugged into) or ``"both"`` (the loopback, which the reference input gets too).
        """
        ...

    def jog(self, view: JogView) -> Jog:
        """Say how the beam is to move next, or that it is there."""
        ...

    def judge(self, view: MapView) -> Judged:
        """Look at the residuals of a mirror map, and say what becomes of it."""
        ...

    def again(self, problem: str) -> bool:
        """Look for what is wrong; True to try once more, False to leave this out."""
        ...
