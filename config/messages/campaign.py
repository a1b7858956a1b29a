"""Events of a campaign or a scan: what command line, log, window and ``--json`` receive."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum

from wavefocus.config.messages.codec import Message, MessageError, message_of, to_record
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


_KINDS: dict[str, type[Event]] = {}


@dataclass(frozen=True, slots=True)
class Event(Message):
    """Something that happened, at `time_s` seconds on the rig's clock since the session began.

    The key ``event`` of its JSON object is the name of its class in snake case.
    """

    time_s: float

    def __init_subclass__(cls) -> None:
        name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        cls.tag = {"event": name}
        _KINDS[name] = cls


@dataclass(frozen=True, slots=True)
class StateChanged(Event):
    """The campaign entered `state`; `reason` says why in words."""

    state: State
    reason: str


@dataclass(frozen=True, slots=True)
class SessionStarted(Event):
    """A session of the campaign begins: `done` of `positions` are committed, `to_do` are left.

    `instruments` describe mirror, recorder and player with their settings; `devices` are who they are, by role.
    """

    bank: str
    positions: int
    actuators: int
    done: int
    to_do: int
    planned_s: float
    instruments: tuple[str, ...]
    devices: dict[str, DeviceIdentity] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ScheduleSettled(Event):
    """A trial before the first session has settled how positions are measured; `time_s` is how long it took.

    `candidates` are name, groups (0: one actuator after the other), level, seconds of the whole campaign and error
    of each schedule that was tried at `position`, the one that was asked for first.
    """

    position: int
    chosen: str
    reason: str
    hours: float
    candidates: tuple[dict[str, object], ...]


@dataclass(frozen=True, slots=True)
class PositionStarted(Event):
    """The first record of a position begins."""

    position: int
    attempt: int
    x_mm: float
    y_mm: float


@dataclass(frozen=True, slots=True)
class RecordTaken(Event):
    """A record of a position is in: `record` of `records`, counted from 1; not where a position has only one."""

    position: int
    attempt: int
    record: int
    records: int


@dataclass(frozen=True, slots=True)
class PositionCommitted(Event):
    """A position is durably in the bank, with the contract's status bits and its quality.

    Where it is not valid, `reason` says why and `defects` names it. `response_range_v` is the input range where it
    is not the configured one, `moved_mm` how far from the position the laser was.
    """

    position: int
    status: int
    attempts: int
    snr_db: float
    residual_db: float
    clock_ppm: float
    start_offset_samples: float
    reason: str = ""
    defects: tuple[str, ...] = ()
    response_range_v: float | None = None
    moved_mm: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PositionRepeated(Event):
    """An attempt was not good enough and the position is measured again.

    `defects` names what was wrong, `response_range_v` and `moved_mm` say what is tried, as of `PositionCommitted`.
    """

    position: int
    attempt: int
    reason: str
    defects: tuple[str, ...] = ()
    response_range_v: float | None = None
    moved_mm: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class PositionKept(Event):
    """A new attempt was no better than what the bank holds, which therefore stays."""

    position: int
    attempt: int
    reason: str
    defects: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PassStarted(Event):
    """All that is not valid is measured again: these `positions` of the bank."""

    positions: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Progress(Event):
    """How far the campaign is; times by the rig's clock, those that begin with ``wall`` by the wall's.

    What remains follows from the latest positions, with their repeats and with the sentinel's measurements to come.
    """

    done: int
    total: int
    elapsed_s: float
    remaining_s: float
    wall_remaining_s: float
    positions_per_hour: float
    wall_positions_per_hour: float = 0.0

    @property
    def per_hour(self) -> float:
        """Positions an hour by the wall's clock; by the rig's in logs of the first version."""
        return self.wall_positions_per_hour or self.positions_per_hour


@dataclass(frozen=True, slots=True)
class Fault(Event):
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


@dataclass(frozen=True, slots=True)
class ReconnectTried(Event):
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


@dataclass(frozen=True, slots=True)
class Drift(Event):
    """The sentinel position measured again: what changed since it was first measured.

    `occasion` is ``"resume"``, ``"run"`` or ``"repeat"`` (of a stop during a run, to be sure), `cause` what figures
    that are not steady come from, and `suspect` the positions measured since the last steady measurement, where the
    verdict is to stop.
    """

    position: int
    level_db: float
    delay_samples: float
    correlation: float
    verdict: str
    occasion: str
    cause: str
    suspect: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CrosstalkMeasured(Event):
    """How much of the loopback voltage leaks into the response input, by the latest positions.

    `level_db` is re the loopback, `share` in V per V and `sigmas` in standard errors of it. `named` says that it is
    large and sure enough; then the `marked` positions became poor, `reason` says what to do, and what follows is poor
    as long as it lasts. `actuators` are those whose rows show it, where not all do.
    """

    level_db: float
    delay_s: float
    share: float
    sigmas: float
    named: bool
    actuators: tuple[int, ...] = ()
    marked: tuple[int, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ConditionsSeen(Event):
    """Values of the watched conditions while the campaign is suspended; `back` says whether all are back."""

    values: dict[str, float]
    back: bool
    reason: str


@dataclass(frozen=True, slots=True)
class SessionEnded(Event):
    """The session is over.

    `counts` are positions per status word. `failure` is empty unless the session failed: ``"drift"``,
    ``"instrument"``, ``"file"`` or ``"other"``.
    """

    state: State
    done: int
    total: int
    counts: dict[str, int]
    failure: str = ""


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
        at, kind = datetime.fromisoformat(record["at"]), _KINDS[record["event"]]  # type: ignore[arg-type, index]
        event = message_of(record, (kind,))
    except (KeyError, TypeError, ValueError, MessageError):
        return None
    return None if event is None or at.tzinfo is None else Logged(at, event)
