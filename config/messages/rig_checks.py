"""Messages of the commands that check a rig: ``calibrate --operator lines``, ``doctor`` and ``verify``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from wavefocus.config.messages.codec import Message
from wavefocus.config.messages.operate import Faulted, LevelMeasured, Numbers, Refused


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


Verdict = Literal["ok", "warn", "fail", "skipped"]
Action = Literal["calibrate", "edit-rig", "open-folder", "reset-usb", "run", "test-message"]


@dataclass(frozen=True)
class Act:
    """The part of a remedy that a program can do, or make ready, for a person.

    Parameters
    ----------
    do : str
        ``"calibrate"`` a part; ``"edit-rig"``: a key of the rig file; ``"open-folder"``; ``"reset-usb"`` of a role;
        ``"run"`` a command in a terminal; ``"test-message"``: send one to every address.
    on : str
        The part, the key (``"player.channels"``), the folder, the role or the command.
    """

    do: Action
    on: str = ""


@dataclass(frozen=True)
class Finding:
    """One check of one instrument, or of what else was examined.

    Parameters
    ----------
    instrument : str
        The role, or what else was examined.
    check : str
        Name of the check.
    verdict : str
        ``"ok"``, ``"warn"`` (usable, but look at it), ``"fail"`` or ``"skipped"``.
    what : str
        What was found, or why it was skipped.
    remedy : str
        What to do about it; empty where there is nothing to do.
    act : Act, optional
        The part of the remedy that a program can do.
    """

    instrument: str
    check: str
    verdict: Verdict
    what: str
    remedy: str = ""
    act: Act | None = None


@dataclass(frozen=True)
class FindingMade(Message):
    """One finding, as soon as it is made."""

    finding: Finding


@dataclass(frozen=True)
class Examination(Message):
    """All findings of a rig, their counts by verdict, and the versions of the packages that matter."""

    rig: str
    name: str
    good: bool
    counts: Mapping[str, int]
    findings: tuple[Finding, ...]
    versions: Mapping[str, str]


DOCTOR_MESSAGES = (FindingMade, Examination)


@dataclass(frozen=True)
class VerifyStarted(Message, event="started"):
    """A verification begins, in a process of a host."""

    at: datetime
    pid: int
    host: str


@dataclass(frozen=True)
class VerifyStep(Message, event="step"):
    """A step has done so many of its items; `left_s` None until the first is done."""

    at: datetime
    step: str
    done: int
    total: int
    left_s: float | None = None


@dataclass(frozen=True)
class VerifyEnded(Message, event="ended"):
    """The verification is over, with its exit code and why."""

    at: datetime
    code: int
    reason: str


VERIFY_MESSAGES = (VerifyStarted, VerifyStep, VerifyEnded)
