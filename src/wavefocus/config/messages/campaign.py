"""Events of a campaign or a scan: what command line, log, window and ``--json`` receive."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

import msgspec

from wavefocus.config.messages import EventMessage, MessageError, Number, from_record, tag, to_record
from wavefocus.drivers.protocols import DeviceIdentity


class State(StrEnum):
    """Where a campaign stands; which follows which is in `wavefocus.acquisition.engine.session`."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    SUSPENDED = "suspended"
    RECOVERING = "recovering"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FINISHED = "finished"
    FAILED = "failed"


def _snake_case(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


class Event(EventMessage, frozen=True, tag=_snake_case):
    """Something that happened, at `time_s` seconds on the rig's clock since the session began.

    The key ``event`` of its JSON object is the name of its class in snake case.
    """

    time_s: Number


class StateChanged(Event, frozen=True):
    """The campaign entered `state`; `reason` says why in words."""

    state: State
    reason: str


class SessionStarted(Event, frozen=True):
    """A session of the campaign begins: `done` of `positions` are committed, `to_do` are left.

    `instruments` describe mirror, recorder and player with their settings; `devices` are who they are, by role.
    """

    bank: str
    positions: int
    actuators: int
    done: int
    to_do: int
    planned_s: Number
    instruments: tuple[str, ...]
    devices: dict[str, DeviceIdentity] = msgspec.field(default_factory=dict)


class ScheduleSettled(Event, frozen=True):
    """A trial before the first session has settled how positions are measured; `time_s` is how long it took.

    `candidates` are name, groups (0: one actuator after the other), level, seconds of the whole campaign and error
    of each schedule that was tried at `position`, the one that was asked for first.
    """

    position: int
    chosen: str
    reason: str
    hours: Number
    candidates: tuple[dict[str, Any], ...]


class PositionStarted(Event, frozen=True):
    """The first record of a position begins."""

    position: int
    attempt: int
    x_mm: Number
    y_mm: Number


class RecordTaken(Event, frozen=True):
    """A record of a position is in: `record` of `records`, counted from 1; not where a position has only one."""

    position: int
    attempt: int
    record: int
    records: int


class PositionCommitted(Event, frozen=True):
    """A position is durably in the bank, with the contract's status bits and its quality.

    Where it is not valid, `reason` says why and `defects` names it. `response_range_v` is the input range where it
    is not the configured one, `moved_mm` how far from the position the laser was.
    """

    position: int
    status: int
    attempts: int
    snr_db: Number
    residual_db: Number
    clock_ppm: Number
    start_offset_samples: Number
    reason: str = ""
    defects: tuple[str, ...] = ()
    response_range_v: float | None = None
    moved_mm: tuple[Number, Number] = (0.0, 0.0)


class PositionRepeated(Event, frozen=True):
    """An attempt was not good enough and the position is measured again.

    `defects` names what was wrong, `response_range_v` and `moved_mm` say what is tried, as of `PositionCommitted`.
    """

    position: int
    attempt: int
    reason: str
    defects: tuple[str, ...] = ()
    response_range_v: float | None = None
    moved_mm: tuple[Number, Number] = (0.0, 0.0)


class PositionKept(Event, frozen=True):
    """A new attempt was no better than what the bank holds, which therefore stays."""

    position: int
    attempt: int
    reason: str
    defects: tuple[str, ...] = ()


class PassStarted(Event, frozen=True):
    """All that is not valid is measured again: these `positions` of the bank."""

    positions: tuple[int, ...]


class Progress(Event, frozen=True):
    """How far the campaign is; times by the rig's clock, those that begin with ``wall`` by the wall's.

    What remains follows from the latest positions, with their repeats and with the sentinel's measurements to come.
    """

    done: int
    total: int
    elapsed_s: Number
    remaining_s: Number
    wall_remaining_s: Number
    positions_per_hour: Number
    wall_positions_per_hour: Number = 0.0

    @property
    def per_hour(self) -> float:
        """Positions an hour by the wall's clock; by the rig's in logs of the first version."""
        return self.wall_positions_per_hour or self.positions_per_hour


class Fault(Event, frozen=True):
    """An instrument failed; `retried` says whether the engine tries again by itself.

    `position` and `attempt` are None where no position was being measured.
    """

    instrument: str
    operation: str
    cause: str
    remedy: str
    position: int | None
    attempt: int | None
    retried: bool


class ReconnectTried(Event, frozen=True):
    """A lost instrument was asked for a fresh connection.

    `number` counts the tries since it last did its work; `connected` says whether this one succeeded and
    `outcome` what happened. `next_try_s` and `gives_up_s` are the seconds until the next try and until the
    campaign gives up; None once it is connected, `next_try_s` also when this was the last try.
    """

    role: str
    instrument: str
    number: int
    connected: bool
    outcome: str
    next_try_s: float | None
    gives_up_s: float | None


class Drift(Event, frozen=True):
    """The sentinel position measured again: what changed since it was first measured.

    `verdict` is ``"steady"``, ``"warn"`` for a step since the latest good look, or ``"stop"``.
    `occasion` is ``"resume"``, ``"run"`` or ``"repeat"`` (of one that is not steady, to be sure), and `suspect` the
    positions measured since the last steady measurement, where this one is not. `cause` is empty; events of earlier
    versions name one.
    `change` is the relative change of its rows, noise taken out: the error that drift means for what is measured now.
    """

    position: int
    level_db: Number
    delay_samples: Number
    correlation: Number
    verdict: str
    occasion: str
    cause: str
    suspect: tuple[int, ...]
    change: Number = float("nan")


class CrosstalkMeasured(Event, frozen=True):
    """How much of the loopback voltage leaks into the response input, by a record of the loopback alone.

    `level_db` is re the loopback (what it is below, where `sigmas` are under 5), `share` in V per V, `sigmas` in
    standard errors of it. `named` says that it makes 1 % of the median row; then the `marked` positions, measured since
    the last clean look, became poor, `reason` says what to do, and what follows is poor as long as it lasts.
    """

    level_db: Number
    delay_s: Number
    share: Number
    sigmas: Number
    named: bool
    marked: tuple[int, ...] = ()
    reason: str = ""


class ConditionsSeen(Event, frozen=True):
    """Values of the watched conditions while the campaign is suspended; `back` says whether all are back."""

    values: dict[str, Number]
    back: bool
    reason: str


class SessionEnded(Event, frozen=True):
    """The session is over.

    `counts` are positions per status word. `failure` is empty unless the session failed: ``"drift"``,
    ``"instrument"``, ``"file"`` or ``"other"``.
    """

    state: State
    done: int
    total: int
    counts: dict[str, int]
    failure: str = ""


_KINDS = {tag(kind): kind for kind in Event.__subclasses__()}
Subscriber = Callable[[Event], None]


@dataclass(frozen=True, slots=True)
class Logged:
    """An event of a log, and when it was written by the wall's clock."""

    at: datetime
    event: Event


def event_line(event: Event) -> str:
    """An event as a line of JSON with the wall's clock time, and its end."""
    return json.dumps({"at": datetime.now(UTC).isoformat(timespec="milliseconds"), **to_record(event)}) + "\n"


def read_event(line: bytes) -> Logged | None:
    """The event of a line; None for a torn line, and for an event of another version that is not understood."""
    try:
        return event_of(json.loads(line))
    except (ValueError, RecursionError):
        return None


def event_of(record: Mapping[str, object]) -> Logged | None:
    """The event of a log's JSON object; None for one of another version that is not understood."""
    try:
        at = datetime.fromisoformat(record["at"])  # type: ignore[arg-type]
        event = from_record(_KINDS[record["event"]], record)  # type: ignore[index]
    except (KeyError, TypeError, ValueError, MessageError):
        return None
    return None if at.tzinfo is None else Logged(at, event)
