"""Status of a campaign, folded from the events that its latest session has logged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from wavefocus.acquisition.heartbeat import Heartbeat
from wavefocus.campaign.sidecar_files import last_events
from wavefocus.config.messages.campaign import (
    Fault,
    Logged,
    PositionKept,
    PositionStarted,
    Progress,
    ReconnectTried,
    RecordTaken,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.config.messages.codec import Message
from wavefocus.storage.ledger.owner import Owner

GOING_ON = frozenset({State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.STOPPING, State.RECOVERING})


@dataclass(frozen=True)
class Recovering(Message):
    """The instrument that a campaign waits for, and the tries to connect to it again."""

    instrument: str | None = None
    tries: int | None = None
    outcome: str | None = None
    next_try_s: float | None = None
    gives_up_s: float | None = None


@dataclass(frozen=True, slots=True)
class CampaignStatus:
    """State of a session, since when and why; idle while it has not begun or is over.

    recovering: The instrument it waits for.
    progress, progress_at: The latest progress, and when it was logged; None before the first position.
    planned_s: Seconds that the session was to take when it began.
    record: The latest record of the position being measured.
    kept: Positions that were measured and stay as the bank had them, and why.
    last_event_at: When the latest event was logged.
    faulty: The instrument that failed last.
    """

    state: State = State.IDLE
    since: str | None = None
    reason: str | None = None
    recovering: Recovering | None = None
    progress: Progress | None = None
    progress_at: datetime | None = None
    planned_s: float | None = None
    record: RecordTaken | None = None
    kept: Mapping[int, str] = field(default_factory=dict)
    last_event_at: datetime | None = None
    faulty: str | None = None

    def after(self, logged: Logged) -> CampaignStatus:
        """The status once another event is logged."""
        match logged.event:
            case SessionStarted(planned_s=planned_s):
                return CampaignStatus(planned_s=planned_s)
            case StateChanged(state=state, reason=reason) if state in GOING_ON:
                recovering = Recovering(self.faulty) if state is State.RECOVERING else None
                return replace(self, state=state, since=instant(logged.at), reason=reason, recovering=recovering)
            case StateChanged():
                return replace(self, state=State.IDLE, since=None, reason=None, recovering=None)
            case SessionEnded():
                return replace(self, state=State.IDLE, since=None, reason=None, recovering=None, record=None)
            case ReconnectTried() as tried if self.state is State.RECOVERING:
                figures = tried.instrument, tried.number, tried.outcome, tried.next_try_s, tried.gives_up_s
                return replace(self, recovering=Recovering(*figures))
            case Fault(instrument=instrument):
                return replace(self, faulty=instrument)
            case Progress() as progress:
                return replace(self, progress=progress, progress_at=logged.at)
            case PositionStarted():
                return replace(self, record=None)
            case RecordTaken() as record:
                return replace(self, record=record)
            case PositionKept(position=position, reason=reason):
                return replace(self, kept={**self.kept, position: reason})
        return self


def campaign_status(bank: Path, owner: Owner | None, beat: Heartbeat | None) -> CampaignStatus:
    """Status by the log of a bank; without an owner nothing goes on, and what the latest session did is left.

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
    if status.state is State.IDLE and beat is not None and beat.pid == owner.pid:
        since = beat.since.isoformat() if beat.since else None
        return replace(status, state=beat.state, since=since, reason=beat.reason)
    return status


def instant(at: datetime) -> str:
    """An instant as logs have it."""
    return at.isoformat(timespec="milliseconds")
