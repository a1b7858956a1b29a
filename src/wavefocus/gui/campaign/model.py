"""State of the followed campaign and the lines of its log, without Qt; orders that make sense in it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.event_wording import sentence
from wavefocus.campaign.status import CampaignStatus
from wavefocus.config.messages.campaign import (
    CrosstalkMeasured,
    Drift,
    Event,
    Fault,
    Logged,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    ReconnectTried,
    RecordTaken,
    SessionStarted,
    State,
    StateChanged,
    event_of,
)
from wavefocus.gui.advice import in_window
from wavefocus.gui.campaign.quality import DAMAGED
from wavefocus.gui.surface import PlotSurface
from wavefocus.rendering.arrays import Float32Array
from wavefocus.storage.bank.ledger import VALID

if TYPE_CHECKING:
    from wavefocus.acquisition.limits import DriftPoint
    from wavefocus.campaign.status import Heartbeat
    from wavefocus.storage.ledger.owner import Owner

_LONGEST = 200


class Weight(IntEnum):
    """Importance of an event."""

    DETAIL = 0
    NOTE = 1
    WARNING = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class EventLine:
    """One line of the event list: seconds since 1970 or NaN, and the bank row concerned or -1."""

    at_s: float
    weight: Weight
    text: str
    position: int = -1


def read_record(record: Mapping[str, object]) -> Logged | EventLine:
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
    return EventLine(at_s, Weight.DETAIL, text[:_LONGEST])


def clock(at_s: float) -> str:
    """Weekday and time; empty where it is NaN."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def line_of(logged: Logged) -> EventLine | None:
    """Line of an event; None for progress, which is shown otherwise."""
    if isinstance(logged.event, Progress | RecordTaken):
        return None
    position: int | None = getattr(logged.event, "position", None)
    text = in_window(sentence(logged.event))
    return EventLine(logged.at.timestamp(), _weight(logged.event), text, -1 if position is None else position)


def _weight(event: Event) -> Weight:
    match event:
        case StateChanged(state=State.FAILED) | Fault() | CrosstalkMeasured(named=True):
            return Weight.FAULT
        case StateChanged(state=State.RECOVERING | State.SUSPENDED) | PositionRepeated() | Drift(verdict="warn"):
            return Weight.WARNING
        case ReconnectTried(connected=False):
            return Weight.WARNING
        case Drift(verdict=verdict) if verdict != "steady":
            return Weight.FAULT
        case PositionCommitted(status=status):
            return Weight.DETAIL if status == VALID else Weight.WARNING
    return Weight.DETAIL if isinstance(event, PositionStarted) else Weight.NOTE


# A week of a campaign's events; older ones are in the log. Lines are dropped in blocks.
KEPT_LINES = 20_000
_DROPPED_AT = 22_000
# A killed process may have logged its last event after its owner was last asked for.
_ASKED_AFTER_S = 0.05
_ROLES = ("mirror", "recorder", "player")


class Extra(StrEnum):
    """States that only the window sees."""

    NO_BANK = "no bank"
    STARTING = "starting"
    PREPARING = "preparing"
    SILENT = "silent"
    GONE = "gone"


class CampaignAction(StrEnum):
    """What the buttons ask for."""

    START = "start"
    PAUSE = "pause"
    CONTINUE = "go-on"
    STOP = "stop"
    RESUME = "resume"
    REMEASURE = "remeasure"


_ACTIONS: dict[State | Extra, frozenset[CampaignAction]] = {
    State.RUNNING: frozenset({CampaignAction.PAUSE, CampaignAction.STOP}),
    State.RECOVERING: frozenset({CampaignAction.PAUSE, CampaignAction.STOP}),
    State.PAUSING: frozenset({CampaignAction.CONTINUE, CampaignAction.STOP}),
    State.PAUSED: frozenset({CampaignAction.CONTINUE, CampaignAction.STOP}),
    State.SUSPENDED: frozenset({CampaignAction.PAUSE, CampaignAction.STOP}),
    State.STOPPING: frozenset(),
    Extra.STARTING: frozenset(),
    Extra.PREPARING: frozenset({CampaignAction.STOP}),
    Extra.SILENT: frozenset({CampaignAction.STOP}),
}


@dataclass(frozen=True, slots=True)
class ShownState:
    """A state and its reason."""

    word: State | Extra
    reason: str = ""

    @property
    def measuring(self) -> bool:
        """Whether a process owns the bank, in whatever state."""
        return self.word in _ACTIONS

    @property
    def going_on(self) -> bool:
        """Whether positions are measured now, so that a remaining time holds."""
        return self.word is State.RUNNING


def possible_actions(state: ShownState, *, has_run: bool, has_bank: bool, left: int) -> frozenset[CampaignAction]:
    """Actions that make sense: `has_run` with a run file and a bank name, `left` positions not measured."""
    if state.measuring:
        return _ACTIONS[state.word]
    allowed = {
        CampaignAction.START: has_run,
        CampaignAction.REMEASURE: has_bank,
        CampaignAction.RESUME: has_bank and left > 0,
    }
    return frozenset(action for action, makes_sense in allowed.items() if makes_sense)


@dataclass(frozen=True, slots=True)
class PastAttempt:
    """One line of a position's quality history; `status` 0 and NaN where nothing was committed."""

    at_s: float
    number: int
    outcome: str
    status: int = 0
    snr_db: float = math.nan
    residual_db: float = math.nan
    reason: str = ""


@dataclass(slots=True)
class InstrumentState:
    """One instrument: ``"in use"``, ``"at rest"`` (the session is over), ``"faulty"`` or ``"away"``."""

    name: str
    state: str = "in use"
    message: str = ""
    at_s: float = math.nan


@dataclass(eq=False)
class CampaignModel:
    """A campaign; `revision` counts the changes of each part, so that only changes are drawn."""

    surface: PlotSurface | None = None
    status: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    figures: Mapping[str, Float32Array] = field(default_factory=dict)
    lines: list[EventLine] = field(default_factory=list)
    trimmed: int = 0
    history: dict[int, list[PastAttempt]] = field(default_factory=dict)
    instruments: list[InstrumentState] = field(default_factory=list)
    drift: list[DriftPoint] = field(default_factory=list)
    session: CampaignStatus = field(default_factory=CampaignStatus)
    """As the log has it."""
    owner: Owner | None = None
    heartbeat: Heartbeat | None = None
    trouble: tuple[str, str] = "", ""
    """Why the bank or its log cannot be read, empty while they can; and the traceback of a defect."""
    revision: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("surface", "map", "lines", "instruments", "drift", "history"), 0)
    )
    _logged_s: float = 0.0
    _asked_s: float = 0.0

    def open(self, surface: PlotSurface) -> None:
        """Show the bank, for the first time or after it was replaced."""
        self.surface, self.status, self.figures = surface, np.zeros(surface.positions, np.uint8), {}
        self._changed("surface", "map", "history")

    def add_records(self, records: Sequence[Logged | EventLine], *, anew: bool) -> None:
        """Add new records of the log; `anew` when the log was replaced."""
        if anew:
            self._forget_log()
        for record in records:
            self._take_record(record)

    def show_ledger(self, status: NDArray[np.uint8], figures: Mapping[str, Float32Array]) -> None:
        """Show status bits and quality figures of all positions."""
        self.status, self.figures = status, figures
        self._changed("map")

    def show_owner(self, owner: Owner | None, heartbeat: Heartbeat | None, asked_s: float) -> None:
        """Show the bank's owner and heartbeat; asked for at `asked_s` of the monotonic clock."""
        self.owner, self.heartbeat, self._asked_s = owner, heartbeat, asked_s

    def show_drift(self, points: list[DriftPoint]) -> None:
        """Show the whole drift history."""
        self.drift = points
        self._changed("drift")

    def show_trouble(self, why: str, details: str) -> None:
        self.trouble = why, details

    @property
    def measured(self) -> int:
        return int(np.count_nonzero(self.status & ~np.uint8(DAMAGED)))

    def forget(self) -> None:
        """Reset everything: another bank will be followed."""
        self.surface, self.owner, self.heartbeat, self.trouble = None, None, None, ("", "")
        self.status, self.figures, self.drift = np.zeros(0, np.uint8), {}, []
        self._forget_log()
        self._changed("surface", "drift")

    def state(self, *, starting: bool = False) -> ShownState:
        """State of the campaign; `starting` while a capture of this window has not opened the bank yet."""
        owner, beat, session = self.owner, self.heartbeat, self.session
        logged = ShownState(session.state, session.reason)
        if owner is not None:
            if beat is not None and beat.is_silent() and beat.pid == owner.pid:
                reason = f"process {owner.pid} on {owner.host} is stopped, or its machine is asleep or hung"
                return ShownState(Extra.SILENT, reason)
            if not session.goes_on:
                return ShownState(Extra.PREPARING, "checking the bank and the instruments")
            return logged
        if session.goes_on:
            if self._asked_s <= self._logged_s + _ASKED_AFTER_S:
                return logged
            if not starting:
                reason = f"its process ended unexpectedly while {logged.word}; Resume continues from there"
                return ShownState(Extra.GONE, reason)
        if starting:
            return ShownState(Extra.STARTING, "the capture is being started")
        return ShownState(Extra.NO_BANK) if self.surface is None else logged

    def _forget_log(self) -> None:
        self.lines.clear()
        self.history.clear()
        self.instruments.clear()
        self.session = CampaignStatus()
        self.trimmed += 1
        self._changed("lines", "history", "instruments", "map")

    def _take_record(self, record: Logged | EventLine) -> None:
        line = record if isinstance(record, EventLine) else line_of(record)
        if line is not None:
            self.lines.append(line)
            if len(self.lines) > _DROPPED_AT:
                del self.lines[: len(self.lines) - KEPT_LINES]
                self.trimmed += 1
            self._changed("lines")
        self._logged_s = time.monotonic()
        if isinstance(record, Logged):
            former, self.session = self.session, self.session.after(record)
            if self.session.position != former.position:
                self._changed("map")
            self._take_event(record.event, record.at.timestamp(), "" if line is None else line.text)

    def _take_event(self, event: Event, at_s: float, text: str) -> None:
        match event:
            case SessionStarted():
                self.instruments = [InstrumentState(name) for name in event.instruments]
                self._changed("instruments")
            case StateChanged() if not self.session.goes_on:
                self._change_instruments({"in use"}, "at rest")
            case PositionCommitted():
                self._commit(event, at_s)
                self._change_instruments({"at rest", "faulty", "away"}, "in use")  # it used all of them
            case PositionRepeated(position=position, attempt=attempt, reason=reason):
                self._note(position, PastAttempt(at_s, attempt, f"repeated: {reason}"))
            case PositionKept(position=position, attempt=attempt, reason=reason):
                self._note(position, PastAttempt(at_s, attempt, f"earlier measurement kept: {reason}"))
            case Fault(instrument=name):
                role = next((role for role in _ROLES if role in name), "")
                self._change_instrument(name, role, "faulty", text, at_s)
            case ReconnectTried(instrument=name, role=role, connected=connected):
                self._change_instrument(name, role, "in use" if connected else "away", text, at_s)

    def _commit(self, event: PositionCommitted, at_s: float) -> None:
        position, status = event.position, event.status
        if 0 <= position < len(self.status) and 0 < status < 256 and self.status[position] != status:
            self.status = self.status.copy()
            self.status[position] = status
        self._changed("map")
        quality = status, event.snr_db, event.residual_db
        self._note(position, PastAttempt(at_s, event.attempts, "committed", *quality, reason=event.reason))

    def _note(self, position: int, attempt: PastAttempt) -> None:
        self.history.setdefault(position, []).append(attempt)
        self._changed("history")

    def _change_instrument(self, name: str, role: str, state: str, text: str, at_s: float) -> None:
        """Change the instrument of a name, or else of a role; a new one where there is none."""
        wanted = [one for one in (name, role) if one]
        known = (one for part in wanted for one in self.instruments if part in one.name or one.name in part)
        instrument = next(known, None)
        if instrument is None:
            self.instruments.append(instrument := InstrumentState(name))
        instrument.state, instrument.message, instrument.at_s = state, text.removeprefix(f"{name}: "), at_s
        self._changed("instruments")

    def _change_instruments(self, former: set[str], state: str) -> None:
        for instrument in self.instruments:
            if instrument.state in former:
                instrument.state = state
                self._changed("instruments")

    def _changed(self, *parts: str) -> None:
        for part in parts:
            self.revision[part] += 1
