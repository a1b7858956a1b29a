"""Events of a log as lines for the event list."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from acquisition.durations import hours
from gui.campaign.quality import status_text
from storage.bank.ledger import VALID

Record = Mapping[str, object]


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


def number(record: Record, key: str) -> float:
    """A number of an event, NaN where it is missing."""
    value = record.get(key)
    return float(value) if isinstance(value, int | float) else float("nan")


def whole(record: Record, key: str) -> int:
    """An integer of an event, -1 where it is missing."""
    value = record.get(key)
    return value if isinstance(value, int) and not isinstance(value, bool) else -1


def instant_s(record: Record) -> float:
    """Time of an event, in seconds since 1970; NaN when the log has none."""
    try:
        return datetime.fromisoformat(str(record.get("at"))).timestamp()
    except ValueError:
        return float("nan")


def clock(at_s: float) -> str:
    """Weekday and time; empty where it is NaN."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def line_of(record: Record) -> Line | None:
    """Line of an event; None for progress, which is shown otherwise."""
    kind = str(record.get("event"))
    if kind in ("progress", "record_taken"):
        return None
    text_of = _TEXTS.get(kind)
    weight, text = (Weight.DETAIL, kind) if text_of is None else text_of(record)
    return Line(instant_s(record), weight, text, whole(record, "position"))


def _session_started(record: Record) -> tuple[Weight, str]:
    done, to_do = whole(record, "done"), whole(record, "to_do")
    return Weight.NOTE, (
        f"session begins: {done} of {whole(record, 'positions')} positions measured, {to_do} to do with "
        f"{whole(record, 'actuators')} actuators; planned: {hours(number(record, 'planned_s'))}"
    )


def _state_changed(record: Record) -> tuple[Weight, str]:
    weights = {"failed": Weight.FAULT, "recovering": Weight.WARNING, "suspended": Weight.WARNING}
    return weights.get(str(record.get("state")), Weight.NOTE), f"{record.get('state')}: {record.get('reason')}"


def _position_started(record: Record) -> tuple[Weight, str]:
    again = f", attempt {whole(record, 'attempt')}" if whole(record, "attempt") > 1 else ""
    x_mm, y_mm = number(record, "x_mm"), number(record, "y_mm")
    return Weight.DETAIL, f"position {whole(record, 'position')} at ({x_mm:.1f}, {y_mm:.1f}) mm begins{again}"


def _position_committed(record: Record) -> tuple[Weight, str]:
    status = whole(record, "status")
    return Weight.DETAIL if status == VALID else Weight.WARNING, (
        f"position {whole(record, 'position')} is measured: {status_text(status)}, signal-to-noise ratio "
        f"{number(record, 'snr_db'):.1f} dB, residual {number(record, 'residual_db'):.1f} dB"
    )


def _fault(record: Record) -> tuple[Weight, str]:
    then = "trying again" if record.get("retried") else "not tried again"
    return Weight.FAULT, (
        f"{record.get('instrument')}: {record.get('operation')}: {record.get('cause')}; {record.get('remedy')} ({then})"
    )


def _reconnect_tried(record: Record) -> tuple[Weight, str]:
    attempt = f"{record.get('instrument')}: attempt {whole(record, 'number')} to reconnect"
    if record.get("connected"):
        return Weight.NOTE, f"{attempt} succeeded"
    next_s = number(record, "next_try_s")
    then = "" if math.isnan(next_s) else f"; next attempt in {hours(next_s)}"
    return Weight.WARNING, f"{attempt} failed: {record.get('outcome')}{then}"


def _drift(record: Record) -> tuple[Weight, str]:
    verdict = str(record.get("verdict"))
    cause = f" ({record['cause']})" if record.get("cause") else ""
    return {"steady": Weight.NOTE, "warn": Weight.WARNING}.get(verdict, Weight.FAULT), (
        f"sentinel position {whole(record, 'position')}: level {number(record, 'level_db'):+.2f} dB, delay "
        f"{number(record, 'delay_samples'):+.3f} samples, correlation {number(record, 'correlation'):.5f}: "
        f"{verdict}{cause}"
    )


def _session_ended(record: Record) -> tuple[Weight, str]:
    counts = record.get("counts")
    told = ", ".join(f"{count} {word}" for word, count in counts.items() if count) if isinstance(counts, dict) else ""
    return Weight.NOTE, (
        f"session over, {record.get('state')}: {whole(record, 'done')} of {whole(record, 'total')} positions ({told}); "
        f"{hours(number(record, 'time_s'))} on the rig's clock"
    )


_TEXTS: dict[str, Callable[[Record], tuple[Weight, str]]] = {
    "session_started": _session_started,
    "schedule_settled": lambda event: (Weight.NOTE, f"schedule: {event.get('chosen')}: {event.get('reason')}"),
    "state_changed": _state_changed,
    "position_started": _position_started,
    "position_committed": _position_committed,
    "position_repeated": lambda event: (
        Weight.WARNING,
        f"position {whole(event, 'position')} is measured again: {event.get('reason')}",
    ),
    "position_kept": lambda event: (
        Weight.NOTE,
        f"position {whole(event, 'position')} keeps its earlier measurement: {event.get('reason')}",
    ),
    "fault": _fault,
    "reconnect_tried": _reconnect_tried,
    "drift": _drift,
    "conditions_seen": lambda event: (
        Weight.NOTE,
        f"{'conditions are back' if event.get('back') else 'still suspended'}: {event.get('reason')}",
    ),
    "session_ended": _session_ended,
}
