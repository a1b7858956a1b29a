"""The person at the bench, as the procedures know one: plugs cables, jogs the beam, decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

VIBROMETER, SUM, BOTH = "vibrometer", "sum", "both"


def output(channel: int) -> str:
    """The word for an output of the player, plugged into the response input."""
    return f"output {channel}"


@dataclass(frozen=True, slots=True)
class JogView:
    """What a person sees while bringing the beam onto a mark.

    Parameters
    ----------
    number, of : int
        Which mark this is, from 1, and how many there are.
    place_mm : tuple of float
        Where the mark lies on the surface.
    at_mrad : tuple of float
        Where the mirror stands now.
    note : str
        What came of the last step, where it was not done; else empty.
    moved : bool
        The beam was moved for this mark.
    """

    number: int
    of: int
    place_mm: tuple[float, float]
    at_mrad: tuple[float, float]
    note: str = ""
    moved: bool = False


@dataclass(frozen=True, slots=True)
class By:
    """Move the beam by so much from where it stands."""

    x_mrad: float
    y_mrad: float


@dataclass(frozen=True, slots=True)
class To:
    """Move the beam to these angles."""

    x_mrad: float
    y_mrad: float


@dataclass(frozen=True, slots=True)
class Here:
    """The spot is on the mark."""


Jog = By | To | Here


@dataclass(frozen=True, slots=True)
class MapView:
    """What a person sees when the beam was on every mark.

    Parameters
    ----------
    place_mm : tuple of (float, float)
        Where the marks lie.
    off_mm : tuple of (float, float)
        Where the map lets the beam of each mark fall, less where the mark lies; none where there is no map.
    rms_mm, worst_mm, limit_mm : float
        Residuals, and the largest that is allowed; NaN where there is no map.
    suspect : int
        The mark, from 1, that is most likely to be wrong; 0 where nothing tells.
    problem : str
        Why the map cannot be taken; empty for one that can.
    """

    place_mm: tuple[tuple[float, float], ...]
    off_mm: tuple[tuple[float, float], ...]
    rms_mm: float
    worst_mm: float
    limit_mm: float
    suspect: int
    problem: str


@dataclass(frozen=True, slots=True)
class Keep:
    """Take the map, if it can be taken."""


@dataclass(frozen=True, slots=True)
class Redo:
    """Bring the beam onto one mark, from 1, once more."""

    number: int


@dataclass(frozen=True, slots=True)
class Drop:
    """Leave the map."""


Judged = Keep | Redo | Drop


class Operator(Protocol):
    """A person with two hands; every method returns when it is done."""

    def tell(self, line: str) -> None:
        """Read a line."""
        ...

    def connect(self, source: str) -> None:
        """Plug something into the response input.

        Parameters
        ----------
        source : str
            ``"vibrometer"``, ``"output K"`` (output K of the player), ``"sum"`` (the summing box that all outputs
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
