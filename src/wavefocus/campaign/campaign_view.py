"""A campaign for people: a progress bar, and a line for each important event."""

from __future__ import annotations

import math

from wavefocus.acquisition.wording import a_while, hours, row_ranges
from wavefocus.config.messages.campaign import (
    ConditionsSeen,
    CrosstalkMeasured,
    Drift,
    Event,
    Fault,
    PassStarted,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    Progress,
    ReconnectTried,
    RecordTaken,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.console import Report, finish_clock, say

# What a person at the terminal asked for, or must see; recovery and the end have lines of their own.
_TOLD = frozenset({State.PAUSING, State.PAUSED, State.SUSPENDED, State.STOPPING})

_WAITING = frozenset({State.PAUSED, State.SUSPENDED, State.RECOVERING})

# A rig on a virtual clock lives through hours in seconds; then both clocks are shown.
_SAME_CLOCK = 0.2


class CampaignView:
    """Subscribes to a campaign's events and shows them on standard error."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._done, self._total, self._left = 0, 0, ""
        self._repeats = 0
        self._former = State.IDLE

    def __call__(self, event: Event) -> None:
        """Show one event."""
        match event:
            case SessionStarted():
                self._done, self._total = event.done, event.positions
                say(
                    f"{event.bank}: {event.done} of {event.positions} positions are in, {event.to_do} to do "
                    f"with {event.actuators} actuators; planned: {hours(event.planned_s)}"
                )
                for instrument in event.instruments:
                    say(f"  {instrument}")
            case StateChanged():
                self._state(event)
            case ConditionsSeen() if not event.back:
                say(f"still suspended: {event.reason}")
            case Progress():
                self._done, self._total, self._left = event.done, event.total, remaining(event)
                self._report(self._done, self._total, self._left)
            case RecordTaken():
                at = f"position {event.position}: record {event.record} of {event.records}"
                self._report(self._done, self._total, f"{at}; {self._left}" if self._left else at)
            case PositionRepeated():
                self._repeats += 1
                say(f"position {event.position} is measured again{_otherwise(event)}: {event.reason}")
            case PositionCommitted() if any(name.startswith("neighbour ") for name in event.defects):
                say(f"position {event.position} is poor: {event.reason}")
            case PassStarted():
                rows_text = row_ranges(event.positions)
                say(f"{len(event.positions)} positions that are not valid are measured again: {rows_text}")
            case PositionKept():
                say(f"position {event.position} stays as the bank has it: {event.reason}")
            case Fault():
                then = "trying again" if event.retried else "not tried again"
                say(f"{event.instrument}: {event.operation}: {event.cause}; {event.remedy} ({then})")
            case ReconnectTried():
                say(_reconnect_line(event))
            case Drift() if event.occasion == "resume" or event.verdict != "steady":
                say(
                    f"sentinel position {event.position}: level {event.level_db:+.2f} dB, "
                    f"delay {event.delay_samples:+.3f} samples, correlation {event.correlation:.5f}: "
                    f"{event.verdict}{f' ({event.cause})' if event.cause else ''}"
                )
            case CrosstalkMeasured() if event.named and event.marked:
                rows_text = row_ranges(event.marked)
                say(f"{event.reason}; positions {rows_text} are poor, and so are the next while it lasts")
            case SessionEnded():
                counts = ", ".join(f"{count} {word}" for word, count in event.counts.items() if count)
                say(
                    f"{event.state}: {event.done} of {event.total} positions ({counts}); "
                    f"{hours(event.time_s)} on the rig's clock, {self._repeats} repeats"
                )
            case _:
                pass

    def _state(self, event: StateChanged) -> None:
        """Report a state; while nothing is measured, no time is left that could be told."""
        if event.state in _WAITING:
            self._report(self._done, self._total, str(event.state))
        elif self._former in _WAITING and event.state is State.RUNNING:
            self._report(self._done, self._total, self._left)
        if event.state in _TOLD or (event.state is State.RUNNING and self._former in _TOLD):
            say(f"{event.state}: {event.reason}")
        self._former = event.state


def remaining(event: Progress) -> str:
    """What is left by the latest positions on the wall's clock; where the rig's differs, on that too."""
    wall_s, rig_s = event.wall_remaining_s, event.remaining_s
    note = f"about {a_while(wall_s)} left, finished at {finish_clock(wall_s)}" if wall_s > 0 else ""
    if rig_s <= 0 or abs(rig_s - wall_s) < _SAME_CLOCK * rig_s:
        return note
    return f"{note} (rig's clock: {hours(rig_s)} left)".strip()


def _otherwise(event: PositionRepeated) -> str:
    range_text = "" if event.response_range_v is None else f" with a range of {event.response_range_v:g} V"
    moved_mm = math.hypot(*event.moved_mm)
    return range_text + (f" {moved_mm:.2g} mm aside" if moved_mm else "")


def _reconnect_line(event: ReconnectTried) -> str:
    """One try for a fresh connection, and when the next one is."""
    if event.connected:
        return f"{event.instrument}: connected again (try {event.number})"
    line = f"{event.instrument}: try {event.number} to connect again failed: {event.outcome}"
    if event.next_try_s is None or event.gives_up_s is None:
        return line
    return f"{line}; next try in {hours(event.next_try_s)}, {hours(event.gives_up_s)} until giving up"
