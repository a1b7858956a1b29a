"""Heartbeat of a running capture: its state, folded from the events of the campaign."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.config.messages.campaign import (
    Event,
    Fault,
    PositionStarted,
    Progress,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.config.messages.codec import Message

# A machine that is busy may miss some beats.
SILENT_AFTER_S = 15.0


@dataclass(frozen=True)
class Heartbeat(Message):
    """State of a running capture, written every second.

    `since` is when it entered its state, `position` the one being measured, `remaining_s` by the wall's clock (None
    before the first position), `fault` the latest in words and `order` the number of the latest order taken, both
    empty where there was none.
    """

    at: datetime
    pid: int
    host: str
    state: State = State.IDLE
    reason: str = ""
    since: datetime | None = None
    position: int | None = None
    done: int = 0
    total: int = 0
    remaining_s: float | None = None
    fault: str = ""
    order: str = ""

    @property
    def finish_at(self) -> datetime | None:
        """When it will have finished, if nothing holds it up."""
        return None if self.remaining_s is None else finish_time(self.remaining_s, self.at).astimezone(UTC)

    def age_s(self, now: datetime | None = None) -> float:
        """Seconds since then; below 0 where the clock was set back since, or is another machine's."""
        return ((now or datetime.now(UTC)) - self.at).total_seconds()

    def is_silent(self, now: datetime | None = None) -> bool:
        """Whether a process that lives would have written another one since.

        One that lives writes the time of now: a heartbeat from far ahead was written before the clock was set back.
        """
        return abs(self.age_s(now)) > SILENT_AFTER_S

    def age_words(self, now: datetime | None = None) -> str:
        """Its age for people: ``12 s ago``, or that its time is still to come."""
        age_s = self.age_s(now)
        return f"{hours(age_s)} ago" if age_s > -1 else f"{hours(-age_s)} ahead of this computer's clock"

    @classmethod
    def of_this_process(cls) -> Heartbeat:
        """The first one of a capture."""
        return cls(datetime.now(UTC), os.getpid(), socket.gethostname())

    def after(self, event: Event) -> Heartbeat:
        """The heartbeat once an event has happened."""
        match event:
            case SessionStarted():
                return replace(self, done=event.done, total=event.positions)
            case StateChanged():
                return replace(self, state=event.state, reason=event.reason, since=datetime.now(UTC))
            case PositionStarted():
                return replace(self, position=event.position)
            case Progress():
                return replace(self, done=event.done, total=event.total, remaining_s=event.wall_remaining_s)
            case Fault():
                return replace(self, fault=f"{event.instrument}: {event.operation}: {event.cause}")
            case SessionEnded():
                return replace(self, done=event.done, position=None)
        return self
