"""What the engine tells: typed, immutable events; command line, log, window and ``--json`` subscribe."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import StrEnum


class State(StrEnum):
    """Where a campaign stands; which follows which is in `acquisition.states`."""

    IDLE = "idle"
    RUNNING = "running"
    RECOVERING = "recovering"
    STOPPED = "stopped"
    FINISHED = "finished"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, at `time_s` seconds on the rig's clock since the session began."""

    time_s: float


@dataclass(frozen=True, slots=True)
class StateChanged(Event):
    """The campaign entered `state`; `reason` says why in words."""

    state: State
    reason: str


@dataclass(frozen=True, slots=True)
class SessionStarted(Event):
    """A session of the campaign begins: `done` of `positions` are committed, `to_do` are left."""

    bank: str
    positions: int
    actuators: int
    done: int
    to_do: int
    planned_s: float
    instruments: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class PositionStarted(Event):
    """The first record of a position begins."""

    position: int
    attempt: int
    x_mm: float
    y_mm: float


@dataclass(frozen=True, slots=True)
class PositionCommitted(Event):
    """A position is durably in the bank, with the contract's status bits and its quality."""

    position: int
    status: int
    attempts: int
    snr_db: float
    residual_db: float
    clock_ppm: float
    start_offset_samples: float


@dataclass(frozen=True, slots=True)
class PositionRepeated(Event):
    """An attempt was not good enough and the position is measured again."""

    position: int
    attempt: int
    reason: str


@dataclass(frozen=True, slots=True)
class PositionKept(Event):
    """A new attempt was no better than what the bank holds, which therefore stays."""

    position: int
    attempt: int
    reason: str


@dataclass(frozen=True, slots=True)
class Progress(Event):
    """How far the campaign is; times by the rig's clock, `wall_remaining_s` by the wall's."""

    done: int
    total: int
    elapsed_s: float
    remaining_s: float
    wall_remaining_s: float
    positions_per_hour: float


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
    """The sentinel position measured again: what changed since it was first measured."""

    position: int
    level_db: float
    delay_samples: float
    correlation: float
    verdict: str


@dataclass(frozen=True, slots=True)
class SessionEnded(Event):
    """The session is over; `counts` are positions per status word."""

    state: State
    done: int
    total: int
    counts: dict[str, int]


Subscriber = Callable[[Event], None]


def event_record(event: Event) -> dict[str, object]:
    """One event as a JSON-ready mapping, ``event`` naming its kind in snake case.

    Figures that are not finite become ``None``: JSON has no NaN.
    """
    kind = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    fields = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in asdict(event).items()
    }
    return {"event": kind, **fields}
