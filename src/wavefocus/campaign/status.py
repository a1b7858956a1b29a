"""Status of a campaign, folded from the events of its latest session; its heartbeat, and its view on a terminal."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

from wavefocus.acquisition.event_wording import sentence
from wavefocus.acquisition.wording import a_while, finish_time, hours
from wavefocus.campaign.sidecar_files import last_events
from wavefocus.config.messages import Instant, Message
from wavefocus.config.messages.campaign import (
    ConditionsSeen,
    CrosstalkMeasured,
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
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.console import Report, finish_clock, say
from wavefocus.storage.ledger.owner import Owner

GOING_ON = frozenset({State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.STOPPING, State.RECOVERING})


@dataclass(frozen=True, slots=True)
class CampaignStatus:
    """State of a session, since when and why; idle before it has begun.

    tried: The latest try to connect to the instrument that it waits for.
    done, total: Positions measured, and all; by the latest progress.
    progress, progress_at: The latest progress, and when it was logged; None before the first position.
    planned_s: Seconds that the session was to take when it began.
    position: The position being measured.
    record: The latest record of it.
    kept: Positions that were measured and stay as the bank had them, and why.
    last_event_at: When the latest event was logged.
    fault: The latest fault.
    """

    state: State = State.IDLE
    since: datetime | None = None
    reason: str = ""
    tried: ReconnectTried | None = None
    done: int = 0
    total: int = 0
    progress: Progress | None = None
    progress_at: datetime | None = None
    planned_s: float | None = None
    position: int | None = None
    record: RecordTaken | None = None
    kept: Mapping[int, str] = field(default_factory=dict)
    last_event_at: datetime | None = None
    fault: Fault | None = None

    @property
    def goes_on(self) -> bool:
        """Whether the session is under way, by its events alone."""
        return self.state in GOING_ON

    def after(self, logged: Logged) -> CampaignStatus:
        """The status once another event is logged."""
        match logged.event:
            case SessionStarted(planned_s=planned_s, done=done, positions=total):
                return CampaignStatus(planned_s=planned_s, done=done, total=total)
            case StateChanged(state=state, reason=reason):
                changed = replace(self, state=state, since=logged.at, reason=reason, tried=None)
                return changed if changed.goes_on else replace(changed, position=None)
            case SessionEnded(state=state, done=done):
                return replace(self, state=state, tried=None, done=done, position=None, record=None)
            case ReconnectTried() as tried if self.state is State.RECOVERING:
                return replace(self, tried=tried)
            case Fault() as fault:
                return replace(self, fault=fault)
            case Progress(done=done, total=total) as progress:
                return replace(self, done=done, total=total, progress=progress, progress_at=logged.at)
            case PositionStarted(position=position):
                return replace(self, position=position, record=None)
            case RecordTaken() as record:
                return replace(self, record=record)
            case PositionKept(position=position, reason=reason):
                return replace(self, kept={**self.kept, position: reason})
        return self


def campaign_status(bank: Path, owner: Owner | None, beat: Heartbeat | None) -> CampaignStatus:
    """Status by the log of a bank; idle without an owner, and what the latest session did is left.

    The log is the quicker of the two, but a full disk may have ended it: then the heartbeat of the owner is used.
    """
    session: list[Logged] = []
    for logged in last_events(bank):
        session.append(logged)
        if isinstance(logged.event, SessionStarted):
            break
    status = CampaignStatus()
    for logged in reversed(session):
        status = status.after(logged)
    status = replace(status, last_event_at=session[0].at if session else None, kept=dict(sorted(status.kept.items())))
    if owner is None:
        return CampaignStatus(kept=status.kept, last_event_at=status.last_event_at)
    if status.goes_on:
        return status
    if beat is not None and beat.pid == owner.pid:
        return replace(status, state=beat.state, since=beat.since, reason=beat.reason)
    return replace(status, state=State.IDLE, since=None, reason="")


# A machine that is busy may miss some beats.
_SILENT_AFTER_S = 15.0


class Heartbeat(Message, frozen=True):
    """State of a running capture, written every second.

    `since` is when it entered its state, `position` the one being measured, `remaining_s` by the wall's clock (None
    before the first position), `fault` the latest in words and `order` the number of the latest order taken, both
    empty where there was none, `pause_asked` whether a pause was asked for and not taken back, in whatever state.
    """

    at: Instant
    pid: int
    host: str
    state: State = State.IDLE
    reason: str = ""
    since: Instant | None = None
    position: int | None = None
    done: int = 0
    total: int = 0
    remaining_s: float | None = None
    fault: str = ""
    order: str = ""
    pause_asked: bool = False

    @property
    def finish_at(self) -> datetime | None:
        """When it will have finished, if nothing holds it up."""
        return None if self.remaining_s is None else finish_time(self.remaining_s, self.at).astimezone(UTC)

    def age_s(self) -> float:
        """Seconds since then; below 0 where the clock was set back since, or is another machine's."""
        return (datetime.now(UTC) - self.at).total_seconds()

    def is_silent(self) -> bool:
        """Whether a process that lives would have written another one since.

        One that lives writes the time of now: a heartbeat from far ahead was written before the clock was set back.
        """
        return abs(self.age_s()) > _SILENT_AFTER_S

    def age_words(self) -> str:
        """Its age for people: ``12 s ago``, or that its time is still to come."""
        age_s = self.age_s()
        return f"{hours(age_s)} ago" if age_s > -1 else f"{hours(-age_s)} ahead of this computer's clock"

    @classmethod
    def of(cls, status: CampaignStatus, order: str = "", *, pause_asked: bool = False) -> Heartbeat:
        """The heartbeat of this process now."""
        fault, progress = status.fault, status.progress
        return cls(
            at=datetime.now(UTC), pid=os.getpid(), host=socket.gethostname(), state=status.state, reason=status.reason,
            since=status.since, position=status.position, done=status.done, total=status.total, order=order,
            remaining_s=None if progress is None else progress.wall_remaining_s,
            fault="" if fault is None else f"{fault.instrument}: {fault.operation}: {fault.cause}",
            pause_asked=pause_asked,
        )  # fmt: skip


def instant(at: datetime) -> str:
    """An instant as logs have it."""
    return at.isoformat(timespec="milliseconds")


# What a person at the terminal asked for, or must see; recovery and the end have lines of their own.
_SHOWN_STATES = frozenset({State.PAUSING, State.PAUSED, State.SUSPENDED, State.STOPPING})

_WAITING = frozenset({State.PAUSED, State.SUSPENDED, State.RECOVERING})


# A rig on a virtual clock takes hundreds of records a second; no eye follows more than this.
_RECORDS_SHOWN_EVERY_S = 0.1


class CampaignView:
    """Subscribes to a campaign's events and shows them on standard error."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._status = CampaignStatus()
        self._repeats = 0
        self._record_shown_s = -_RECORDS_SHOWN_EVERY_S

    def __call__(self, event: Event) -> None:
        """Show one event."""
        former = self._status.state
        self._status = self._status.after(Logged(datetime.now(UTC), event))
        match event:
            case SessionStarted():
                say(sentence(event))
                if event.instruments:
                    say(f"instruments: {'; '.join(event.instruments)}")
            case StateChanged():
                self._show_state(event, former)
            case Progress():
                self._show_bar(self._left)
            case RecordTaken():
                if time.monotonic() - self._record_shown_s < _RECORDS_SHOWN_EVERY_S:
                    return
                self._record_shown_s = time.monotonic()
                at = f"position {event.position}: record {event.record} of {event.records}"
                self._show_bar(f"{at}; {self._left}" if self._left else at)
            case SessionEnded():
                say(f"{sentence(event)}, {self._repeats} repeats")
            case _:
                self._repeats += isinstance(event, PositionRepeated)
                if _is_shown(event):
                    say(sentence(event))

    @property
    def _left(self) -> str:
        progress = self._status.progress
        return "" if progress is None else remaining(progress)

    def _show_bar(self, note: str) -> None:
        self._report(self._status.done, self._status.total, note)

    def _show_state(self, event: StateChanged, former: State) -> None:
        """Report a state; while nothing is measured, no time is left that could be told."""
        if event.state in _WAITING:
            self._show_bar(str(event.state))
        elif former in _WAITING and event.state is State.RUNNING:
            self._show_bar(self._left)
        if event.state in _SHOWN_STATES or (event.state is State.RUNNING and former in _SHOWN_STATES):
            say(sentence(event) + ("; wavefocus resume, or stop" if event.state is State.PAUSED else ""))


def remaining(event: Progress) -> str:
    """What is left by the latest positions on the wall's clock; where the rig's differs, on that too."""
    wall_s, rig_s = event.wall_remaining_s, event.remaining_s
    note = f"about {a_while(wall_s)} left, finished at {finish_clock(wall_s)}" if wall_s > 0 else ""
    # A rig on a virtual clock lives through hours in seconds; then both clocks are shown.
    if rig_s <= 0 or abs(rig_s - wall_s) < 0.2 * rig_s:
        return note
    return f"{note} (rig's clock: {hours(rig_s)} left)".strip()


def _is_shown(event: Event) -> bool:
    """Whether a person at the terminal is to see an event; the log has all."""
    match event:
        case PositionRepeated() | PassStarted() | PositionKept() | Fault() | ReconnectTried():
            return True
        case PositionCommitted():
            return any(name.startswith("neighbour ") for name in event.defects)
        case ConditionsSeen():
            return not event.back
        case Drift():
            return event.occasion == "resume" or event.verdict != "steady"
        case CrosstalkMeasured():
            return event.named and bool(event.marked)
    return False
