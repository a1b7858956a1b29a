"""One event of a log as a line for people: when, how weighty, and a sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum

from acquisition.durations import hours
from gui.campaign.statuses import VALID, status_text


class Weight(IntEnum):
    """How much an event matters to whoever looks at the night."""

    DETAIL = 0
    NOTE = 1
    WARNING = 2
    FAULT = 3


WEIGHT_WORDS = {
    Weight.DETAIL: "detail",
    Weight.NOTE: "note",
    Weight.WARNING: "warning",
    Weight.FAULT: "fault",
}


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the event list.

    Parameters
    ----------
    at_s : float
        Seconds since 1970, NaN when the log does not say.
    weight : Weight
        How much it matters.
    text : str
        A sentence.
    position : int
        The bank row that it is about, -1 for none.
    """

    at_s: float
    weight: Weight
    text: str
    position: int = -1


Record = Mapping[str, object]


def number(record: Record, key: str) -> float:
    """A figure of an event, NaN where it is missing."""
    value = record.get(key)
    return float(value) if isinstance(value, int | float) else float("nan")


def whole(record: Record, key: str) -> int:
    """A whole number of an event, -1 where it is missing."""
    value = record.get(key)
    return value if isinstance(value, int) and not isinstance(value, bool) else -1


def instant_s(record: Record) -> float:
    """When an event was logged, in seconds since 1970; NaN when the log does not say."""
    try:
        return datetime.fromisoformat(str(record.get("at"))).timestamp()
    except ValueError:
        return float("nan")


def line_of(record: Record) -> Line | None:
    """The line of an event; None for what is shown in other ways alone (progress)."""
    kind = record.get("event")
    words = _WORDS.get(str(kind))
    if words is None:
        return None if kind in ("progress", "record_taken") else Line(instant_s(record), Weight.DETAIL, f"{kind}")
    weight, text = words(record)
    return Line(instant_s(record), weight, text, whole(record, "position"))


def _session_started(record: Record) -> tuple[Weight, str]:
    done, to_do = whole(record, "done"), whole(record, "to_do")
    return Weight.NOTE, (
        f"session begins: {done} of {whole(record, 'positions')} positions are in, {to_do} to do with "
        f"{whole(record, 'actuators')} actuators; planned: {hours(number(record, 'planned_s'))}"
    )


def _schedule_settled(record: Record) -> tuple[Weight, str]:
    return Weight.NOTE, f"schedule: {record.get('chosen')}: {record.get('reason')}"


def _state_changed(record: Record) -> tuple[Weight, str]:
    state = record.get("state")
    weight = {"failed": Weight.FAULT, "recovering": Weight.WARNING, "suspended": Weight.WARNING}.get(
        str(state), Weight.NOTE
    )
    return weight, f"{state}: {record.get('reason')}"


def _position_started(record: Record) -> tuple[Weight, str]:
    again = f", attempt {whole(record, 'attempt')}" if whole(record, "attempt") > 1 else ""
    x_mm, y_mm = number(record, "x_mm"), number(record, "y_mm")
    return Weight.DETAIL, f"position {whole(record, 'position')} at ({x_mm:.1f}, {y_mm:.1f}) mm begins{again}"


def _position_committed(record: Record) -> tuple[Weight, str]:
    status = whole(record, "status")
    weight = Weight.DETAIL if status == VALID else Weight.WARNING
    return weight, (
        f"position {whole(record, 'position')} is in: {status_text(status)}, signal-to-noise ratio "
        f"{number(record, 'snr_db'):.1f} dB, residual {number(record, 'residual_db'):.1f} dB"
    )


def _position_repeated(record: Record) -> tuple[Weight, str]:
    return Weight.WARNING, f"position {whole(record, 'position')} is measured again: {record.get('reason')}"


def _position_kept(record: Record) -> tuple[Weight, str]:
    return Weight.NOTE, f"position {whole(record, 'position')} stays as the bank has it: {record.get('reason')}"


def _fault(record: Record) -> tuple[Weight, str]:
    then = "trying again" if record.get("retried") else "not tried again"
    return Weight.FAULT, (
        f"{record.get('instrument')}: {record.get('operation')}: {record.get('cause')}; {record.get('remedy')} ({then})"
    )


def _reconnect_tried(record: Record) -> tuple[Weight, str]:
    if record.get("connected"):
        return Weight.NOTE, f"{record.get('instrument')}: connected again (try {whole(record, 'number')})"
    line = f"{record.get('instrument')}: try {whole(record, 'number')} to connect again failed: {record.get('outcome')}"
    next_s = number(record, "next_try_s")
    return Weight.WARNING, line if math.isnan(next_s) else f"{line}; next try in {hours(next_s)}"


def _drift(record: Record) -> tuple[Weight, str]:
    verdict = str(record.get("verdict"))
    weight = {"steady": Weight.NOTE, "warn": Weight.WARNING}.get(verdict, Weight.FAULT)
    cause = f" ({record['cause']})" if record.get("cause") else ""
    return weight, (
        f"sentinel position {whole(record, 'position')}: level {number(record, 'level_db'):+.2f} dB, delay "
        f"{number(record, 'delay_samples'):+.3f} samples, correlation {number(record, 'correlation'):.5f}: "
        f"{verdict}{cause}"
    )


def _conditions_seen(record: Record) -> tuple[Weight, str]:
    return Weight.NOTE, f"{'conditions are back' if record.get('back') else 'still suspended'}: {record.get('reason')}"


def _session_ended(record: Record) -> tuple[Weight, str]:
    counts = record.get("counts")
    told = ", ".join(f"{count} {word}" for word, count in counts.items() if count) if isinstance(counts, dict) else ""
    return Weight.NOTE, (
        f"session over, {record.get('state')}: {whole(record, 'done')} of {whole(record, 'total')} positions ({told}); "
        f"{hours(number(record, 'time_s'))} on the rig's clock"
    )


_WORDS: dict[str, Callable[[Record], tuple[Weight, str]]] = {
    "session_started": _session_started,
    "schedule_settled": _schedule_settled,
    "state_changed": _state_changed,
    "position_started": _position_started,
    "position_committed": _position_committed,
    "position_repeated": _position_repeated,
    "position_kept": _position_kept,
    "fault": _fault,
    "reconnect_tried": _reconnect_tried,
    "drift": _drift,
    "conditions_seen": _conditions_seen,
    "session_ended": _session_ended,
}
