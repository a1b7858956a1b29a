"""A campaign for people: a progress bar, and a line for each important event."""

import time
from datetime import UTC, datetime

from wavefocus.acquisition.event_wording import sentence
from wavefocus.acquisition.wording import a_while, hours
from wavefocus.campaign.status import CampaignStatus
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
                for instrument in event.instruments:
                    say(f"  {instrument}")
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
