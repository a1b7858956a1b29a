"""Messages of the commands that check a rig: ``calibrate --operator lines``, ``doctor`` and ``verify``."""

from collections.abc import Mapping
from typing import Any, Literal

from wavefocus.config.messages import EventMessage, Instant, Message, Number, Refused
from wavefocus.config.messages.operate import Faulted, LevelMeasured, Numbers


class Begin(EventMessage, frozen=True, tag="begin"):
    """A calibration begins."""

    parts: tuple[str, ...]
    marks_mm: tuple[Numbers, ...]


class Tell(EventMessage, frozen=True, tag="tell"):
    """A line for the person."""

    line: str


class OperatorQuestion(Message, frozen=True, kw_only=True):
    """Base class of questions to the person; the class keyword `tag` is the value of their key ``what``."""

    event: Literal["ask"] = "ask"


class AskConnect(OperatorQuestion, frozen=True, tag_field="what", tag="connect"):
    """Plug `source` into the response input; the sentence says it in words."""

    source: str
    sentence: str


class AskJog(OperatorQuestion, frozen=True, tag_field="what", tag="jog"):
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


class MapView(OperatorQuestion, frozen=True, tag_field="what", tag="map"):
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
    rms_mm: Number
    worst_mm: Number
    limit_mm: Number
    suspect: int
    problem: str


class AskAgain(OperatorQuestion, frozen=True, tag_field="what", tag="again"):
    """Try a measurement once more, or leave it out."""

    problem: str


class CalibrationDone(EventMessage, frozen=True, tag="done"):
    """The calibration is over; `file` is None where nothing was measured."""

    file: str | None
    measured: tuple[str, ...]
    problems: tuple[str, ...]
    calibration: Mapping[str, Any]


CALIBRATE_EVENTS = (
    Begin, Tell, AskConnect, AskJog, MapView, AskAgain, LevelMeasured, Refused, Faulted, CalibrationDone,
)  # fmt: skip


# Words that answer each question, by its key ``what``, and the keys that a word takes with it.
ANSWERS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "connect": {"done": ()},
    "jog": {"here": (), "by": ("x_mrad", "y_mrad"), "to": ("x_mrad", "y_mrad")},
    "map": {"keep": (), "redo": ("mark",), "drop": ()},
    "again": {"again": (), "skip": ()},
}
# Answers any question: the calibration ends, muted and parked.
CANCEL = "cancel"


class Answer(Message, frozen=True):
    """A person's answer to a question, one of `ANSWERS`.

    The beam moves ``by`` so many milliradians from where it stands, or ``to`` such angles; a `mark`, from 1, is met
    once more.
    """

    answer: str
    x_mrad: float = 0.0
    y_mrad: float = 0.0
    mark: int = 0


Verdict = Literal["ok", "warn", "fail", "skipped"]
Action = Literal["calibrate", "edit-rig", "open-folder", "reset-usb", "run", "test-message"]


class Act(Message, frozen=True):
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


class Finding(Message, frozen=True):
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


class FindingMade(Message, frozen=True):
    """One finding, as soon as it is made."""

    finding: Finding


class Examination(Message, frozen=True):
    """All findings of a rig, their counts by verdict, and the versions of the packages that matter."""

    rig: str
    name: str
    good: bool
    counts: Mapping[str, int]
    findings: tuple[Finding, ...]
    versions: Mapping[str, str]


class VerifyStarted(EventMessage, frozen=True, tag="started"):
    """A verification begins, in a process of a host."""

    at: Instant
    pid: int
    host: str


class VerifyStep(EventMessage, frozen=True, tag="step"):
    """A step has done so many of its items; `left_s` None until the first is done."""

    at: Instant
    step: str
    done: int
    total: int
    left_s: float | None = None


class VerifyEnded(EventMessage, frozen=True, tag="ended"):
    """The verification is over, with its exit code and why."""

    at: Instant
    code: int
    reason: str


VERIFY_MESSAGES = (VerifyStarted, VerifyStep, VerifyEnded)
