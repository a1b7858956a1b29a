"""Events of a log as lines for the event list."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from acquisition.durations import hours
from config.messages.campaign import (
    ConditionsSeen,
    Drift,
    Event,
    Fault,
    Logged,
    PassStarted,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    ReconnectTried,
    RecordTaken,
    ScheduleSettled,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
    event_of,
)
from gui.campaign.quality import status_text
from storage.bank.ledger import VALID

_LONGEST = 200


class Weight(IntEnum):
    """Importance of an event."""

    DETAIL = 0
    NOTE = 1
    WARNING = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the event list: seconds since 1970 or NaN, and the bank row concerned or -1."""

    at_s: float
    weight: Weight
    text: str
    position: int = -1


def read_record(record: Mapping[str, object]) -> Logged | Line:
    """Read a record of the log; one of another version becomes a line that holds whatever it says."""
    logged = event_of(record)
    if logged is not None:
        return logged
    facts = ", ".join(f"{key} {value}" for key, value in record.items() if key not in ("at", "event", "time_s"))
    text = f"{record.get('event')}: {facts}" if facts else str(record.get("event"))
    try:
        at_s = datetime.fromisoformat(str(record.get("at"))).timestamp()
    except ValueError:
        at_s = math.nan
    return Line(at_s, Weight.DETAIL, text[:_LONGEST])


def clock(at_s: float) -> str:
    """Weekday and time; empty where it is NaN."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def line_of(logged: Logged) -> Line | None:
    """Line of an event; None for progress, which is shown otherwise."""
    if isinstance(logged.event, Progress | RecordTaken):
        return None
    position: int | None = getattr(logged.event, "position", None)
    return Line(logged.at.timestamp(), *_sentence(logged.event), position=-1 if position is None else position)


def _sentence(event: Event) -> tuple[Weight, str]:
    match event:
        case SessionStarted():
            return Weight.NOTE, (
                f"session begins: {event.done} of {event.positions} positions measured, {event.to_do} to do with "
                f"{event.actuators} actuators; planned: {hours(event.planned_s)}"
            )
        case ScheduleSettled():
            return Weight.NOTE, f"schedule: {event.chosen}: {event.reason}"
        case StateChanged(state=state):
            weights = {State.FAILED: Weight.FAULT, State.RECOVERING: Weight.WARNING, State.SUSPENDED: Weight.WARNING}
            return weights.get(state, Weight.NOTE), f"{state}: {event.reason}"
        case PositionStarted():
            again = f", attempt {event.attempt}" if event.attempt > 1 else ""
            return Weight.DETAIL, f"position {event.position} at ({event.x_mm:.1f}, {event.y_mm:.1f}) mm begins{again}"
        case PositionCommitted():
            return Weight.DETAIL if event.status == VALID else Weight.WARNING, (
                f"position {event.position} is measured: {status_text(event.status)}, signal-to-noise ratio "
                f"{event.snr_db:.1f} dB, residual {event.residual_db:.1f} dB"
            )
        case PositionRepeated():
            return Weight.WARNING, f"position {event.position} is measured again: {event.reason}"
        case PositionKept():
            return Weight.NOTE, f"position {event.position} keeps its earlier measurement: {event.reason}"
        case PassStarted():
            return Weight.NOTE, f"all that is not valid is measured again: {len(event.positions)} positions"
        case Fault():
            then = "trying again" if event.retried else "not tried again"
            return Weight.FAULT, f"{event.instrument}: {event.operation}: {event.cause}; {event.remedy} ({then})"
        case ReconnectTried():
            attempt = f"{event.instrument}: attempt {event.number} to reconnect"
            if event.connected:
                return Weight.NOTE, f"{attempt} succeeded"
            then = "" if event.next_try_s is None else f"; next attempt in {hours(event.next_try_s)}"
            return Weight.WARNING, f"{attempt} failed: {event.outcome}{then}"
        case Drift():
            weight = {"steady": Weight.NOTE, "warn": Weight.WARNING}.get(event.verdict, Weight.FAULT)
            return weight, (
                f"sentinel position {event.position}: level {event.level_db:+.2f} dB, delay "
                f"{event.delay_samples:+.3f} samples, correlation {event.correlation:.5f}: {event.verdict}"
                f"{f' ({event.cause})' if event.cause else ''}"
            )
        case ConditionsSeen():
            return Weight.NOTE, f"{'conditions are back' if event.back else 'still suspended'}: {event.reason}"
        case SessionEnded():
            counts = ", ".join(f"{count} {word}" for word, count in event.counts.items() if count)
            return Weight.NOTE, (
                f"session over, {event.state}: {event.done} of {event.total} positions ({counts}); "
                f"{hours(event.time_s)} on the rig's clock"
            )
    return Weight.DETAIL, event.tag["event"]
