"""Events of ``wavefocus calibrate --operator lines``, and the answers to its questions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from config.messages.codec import Message
from config.messages.operate import Faulted, LevelMeasured, Numbers, Refused


@dataclass(frozen=True)
class Begin(Message, event="begin"):
    """A calibration begins."""

    parts: tuple[str, ...]
    marks_mm: tuple[Numbers, ...]


@dataclass(frozen=True)
class Tell(Message, event="tell"):
    """A line for the person."""

    line: str


@dataclass(frozen=True)
class AskConnect(Message, event="ask", what="connect"):
    """Plug `source` into the response input; the sentence says it in words."""

    source: str
    sentence: str


@dataclass(frozen=True)
class AskJog(Message, event="ask", what="jog"):
    """Bring the beam onto mark `number` (from 1) of `of`.

    The mark is at `place_mm`; the mirror stands at `at_mrad`, by the map believed so far at `at_mm` of the surface.
    `note` says why the last step was not taken.
    """

    number: int
    of: int
    place_mm: Numbers
    at_mrad: Numbers
    at_mm: Numbers | None = None
    note: str = ""


@dataclass(frozen=True)
class MapView(Message, event="ask", what="map"):
    """Take the mirror map, bring the beam onto a mark again, or leave it.

    Parameters
    ----------
    place_mm : tuple of (float, float)
        Places of the marks.
    off_mm : tuple of (float, float)
        Where the map lets the beam of each mark fall, less where the mark lies; empty where there is no map.
    rms_mm, worst_mm, limit_mm : float
        Residuals, and the largest that is allowed; NaN where there is no map.
    suspect : int
        The mark, from 1, that is most likely to be wrong; 0 where there is no such.
    problem : str
        Why the map cannot be taken; empty for one that can.
    """

    place_mm: tuple[Numbers, ...]
    off_mm: tuple[Numbers, ...]
    rms_mm: float
    worst_mm: float
    limit_mm: float
    suspect: int
    problem: str


@dataclass(frozen=True)
class AskAgain(Message, event="ask", what="again"):
    """Try a measurement once more, or leave it out."""

    problem: str


@dataclass(frozen=True)
class CalibrationDone(Message, event="done"):
    """The calibration is over; `file` is None where nothing was measured."""

    file: str | None
    measured: tuple[str, ...]
    problems: tuple[str, ...]
    calibration: Mapping[str, object]


Question = AskConnect | AskJog | MapView | AskAgain
CALIBRATE_EVENTS = (
    Begin, Tell, AskConnect, AskJog, MapView, AskAgain, LevelMeasured, Refused, Faulted, CalibrationDone,
)  # fmt: skip


@dataclass(frozen=True)
class Plugged(Message, answer="done"):
    """The cable is plugged."""


@dataclass(frozen=True)
class By(Message, answer="by"):
    """Move the beam by so much from where it stands."""

    x_mrad: float
    y_mrad: float


@dataclass(frozen=True)
class To(Message, answer="to"):
    """Move the beam to these angles."""

    x_mrad: float
    y_mrad: float


@dataclass(frozen=True)
class Here(Message, answer="here"):
    """The spot is on the mark."""


@dataclass(frozen=True)
class Keep(Message, answer="keep"):
    """Take the map, if it can be taken."""


@dataclass(frozen=True)
class Redo(Message, answer="redo"):
    """Bring the beam onto one mark, from 1, once more."""

    mark: int


@dataclass(frozen=True)
class Drop(Message, answer="drop"):
    """Leave the map."""


@dataclass(frozen=True)
class Again(Message, answer="again"):
    """Try once more."""


@dataclass(frozen=True)
class Skip(Message, answer="skip"):
    """Leave it out."""


@dataclass(frozen=True)
class Cancel(Message, answer="cancel"):
    """End the calibration; muted and parked."""
