"""State of the followed campaign, made from the follower's findings, without Qt; orders that make sense in it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from config.messages.campaign import (
    Event,
    Fault,
    Logged,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    ReconnectTried,
    SessionStarted,
    State,
    StateChanged,
)
from gui.campaign.follower import DriftSeen, Ledger, Life, Line, Opened, Records, Seen, Trouble, line_of
from gui.campaign.quality import DAMAGED, Float32Array
from gui.front_door import Pulse
from gui.surface import Surface

if TYPE_CHECKING:
    from acquisition.limits import DriftPoint
    from storage.ledger.owner import Owner

# A week of a night's events; older ones are in the log. Lines are dropped in blocks.
KEPT_LINES = 20_000
_DROPPED_AT = 22_000
# A killed process may have logged its last event after its owner was last asked for.
_ASKED_AFTER_S = 0.05
_ROLES = ("mirror", "recorder", "player")

GOING = frozenset(
    {State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.RECOVERING, State.STOPPING},
)
_OVER = frozenset({State.IDLE, State.STOPPED, State.FINISHED, State.FAILED})


class Extra(StrEnum):
    """States that only the window sees."""

    NO_BANK = "no bank"
    STARTING = "starting"
    PREPARING = "preparing"
    SILENT = "silent"
    GONE = "gone"


class Order(StrEnum):
    """Orders of the buttons."""

    START = "start"
    PAUSE = "pause"
    CONTINUE = "go-on"
    STOP = "stop"
    RESUME = "resume"
    REMEASURE = "remeasure"


_ORDERS: dict[State | Extra, frozenset[Order]] = {
    State.RUNNING: frozenset({Order.PAUSE, Order.STOP}),
    State.RECOVERING: frozenset({Order.PAUSE, Order.STOP}),
    State.PAUSING: frozenset({Order.CONTINUE, Order.STOP}),
    State.PAUSED: frozenset({Order.CONTINUE, Order.STOP}),
    State.SUSPENDED: frozenset({Order.PAUSE, Order.STOP}),
    State.STOPPING: frozenset(),
    Extra.STARTING: frozenset(),
    Extra.PREPARING: frozenset({Order.STOP}),
    Extra.SILENT: frozenset({Order.STOP}),
}


@dataclass(frozen=True, slots=True)
class CampaignState:
    """A state and its reason."""

    word: State | Extra
    reason: str = ""

    @property
    def measuring(self) -> bool:
        """Whether a process owns the bank, in whatever state."""
        return self.word in _ORDERS


def possible_orders(state: CampaignState, *, has_run: bool, has_bank: bool, left: int) -> frozenset[Order]:
    """Orders that make sense: `has_run` with a run file and a bank name, `left` positions not measured."""
    if state.measuring:
        return _ORDERS[state.word]
    allowed = {Order.START: has_run, Order.REMEASURE: has_bank, Order.RESUME: has_bank and left > 0}
    return frozenset(order for order, makes_sense in allowed.items() if makes_sense)


@dataclass(frozen=True, slots=True)
class Attempt:
    """One line of a position's quality history; `status` 0 and NaN where nothing was committed."""

    at_s: float
    number: int
    outcome: str
    status: int = 0
    snr_db: float = math.nan
    residual_db: float = math.nan


@dataclass(frozen=True, slots=True)
class Pace:
    """Progress and rate of the session, as the capture last reported; its finish in seconds since 1970."""

    done: int
    total: int
    per_hour: float
    finish_s: float


@dataclass(slots=True)
class Instrument:
    """One instrument: ``"in use"``, ``"at rest"`` (the session is over), ``"faulty"`` or ``"away"``."""

    name: str
    state: str = "in use"
    message: str = ""
    at_s: float = math.nan


@dataclass(eq=False)
class Campaign:
    """A campaign; `revision` counts the changes of each part, so that only changes are drawn."""

    surface: Surface | None = None
    status: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    figures: Mapping[str, Float32Array] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)
    trimmed: int = 0
    history: dict[int, list[Attempt]] = field(default_factory=dict)
    instruments: list[Instrument] = field(default_factory=list)
    drift: list[DriftPoint] = field(default_factory=list)
    pace: Pace | None = None
    current: int = -1
    owner: Owner | None = None
    pulse: Pulse | None = None
    trouble: Trouble = field(default_factory=lambda: Trouble(""))
    revision: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("surface", "map", "lines", "instruments", "drift", "history"), 0)
    )
    _logged: CampaignState = field(default_factory=lambda: CampaignState(State.IDLE))
    _logged_s: float = 0.0
    _asked_s: float = 0.0

    def take(self, seen: Seen) -> None:
        match seen:
            case Records(records, anew):
                if anew:
                    self._forget_log()
                for record in records:
                    self._take_record(record)
            case Opened(surface):
                self.surface, self.status, self.figures = surface, np.zeros(surface.positions, np.uint8), {}
                self._changed("surface", "map", "history")
            case Ledger(status, figures):
                self.status, self.figures = status, figures
                self._changed("map")
            case Life(owner, pulse, asked_s):
                self.owner, self.pulse, self._asked_s = owner, pulse, asked_s
            case DriftSeen(points):
                self.drift = points
                self._changed("drift")
            case Trouble():
                self.trouble = seen

    @property
    def measured(self) -> int:
        return int(np.count_nonzero(self.status & ~np.uint8(DAMAGED)))

    def forget(self) -> None:
        """Reset everything: another bank will be followed."""
        self.surface, self.owner, self.pulse, self.trouble = None, None, None, Trouble("")
        self.status, self.figures, self.drift = np.zeros(0, np.uint8), {}, []
        self._forget_log()
        self._changed("surface", "drift")

    def state(self, *, starting: bool = False) -> CampaignState:
        """State of the campaign; `starting` while a capture of this window has not opened the bank yet."""
        owner, pulse, logged = self.owner, self.pulse, self._logged
        if owner is not None:
            if pulse is not None and pulse.silent and pulse.pid == owner.pid:
                reason = f"process {owner.pid} on {owner.host} is stopped, or its machine is asleep or hung"
                return CampaignState(Extra.SILENT, reason)
            if logged.word in _OVER:
                return CampaignState(Extra.PREPARING, "checking the bank and the instruments")
            return logged
        if logged.word in GOING:
            if self._asked_s <= self._logged_s + _ASKED_AFTER_S:
                return logged
            if not starting:
                reason = f"its process ended unexpectedly while {logged.word}; Resume continues from there"
                return CampaignState(Extra.GONE, reason)
        if starting:
            return CampaignState(Extra.STARTING, "the capture is being started")
        return CampaignState(Extra.NO_BANK) if self.surface is None else logged

    def _forget_log(self) -> None:
        self.lines.clear()
        self.history.clear()
        self.instruments.clear()
        self.pace, self.current = None, -1
        self._logged = CampaignState(State.IDLE)
        self.trimmed += 1
        self._changed("lines", "history", "instruments", "map")

    def _take_record(self, record: Logged | Line) -> None:
        line = record if isinstance(record, Line) else line_of(record)
        if line is not None:
            self.lines.append(line)
            if len(self.lines) > _DROPPED_AT:
                del self.lines[: len(self.lines) - KEPT_LINES]
                self.trimmed += 1
            self._changed("lines")
        self._logged_s = time.monotonic()
        if isinstance(record, Logged):
            self._take_event(record.event, record.at.timestamp(), "" if line is None else line.text)

    def _take_event(self, event: Event, at_s: float, text: str) -> None:
        match event:
            case SessionStarted():
                self._logged, self.pace = CampaignState(State.IDLE), None
                self.instruments = [Instrument(name) for name in event.instruments]
                self._changed("instruments")
            case StateChanged(state=state, reason=reason):
                self._logged = CampaignState(state, reason)
                if state in _OVER:
                    self.current = -1
                    self._changed("map")
                    self._change_instruments({"in use"}, "at rest")
            case PositionStarted(position=position):
                self.current = position
                self._changed("map")
            case PositionCommitted():
                self._commit(event, at_s)
                self._change_instruments({"at rest", "faulty", "away"}, "in use")  # it used all of them
            case PositionRepeated(position=position, attempt=attempt, reason=reason):
                self._note(position, Attempt(at_s, attempt, f"repeated: {reason}"))
            case PositionKept(position=position, attempt=attempt, reason=reason):
                self._note(position, Attempt(at_s, attempt, f"earlier measurement kept: {reason}"))
            case Fault(instrument=name):
                role = next((role for role in _ROLES if role in name), "")
                self._change_instrument(name, role, "faulty", text, at_s)
            case ReconnectTried(instrument=name, role=role, connected=connected):
                self._change_instrument(name, role, "in use" if connected else "away", text, at_s)
            case Progress():
                per_hour = event.wall_positions_per_hour or event.positions_per_hour  # old logs have only the latter
                self.pace = Pace(event.done, event.total, per_hour, at_s + event.wall_remaining_s)

    def _commit(self, event: PositionCommitted, at_s: float) -> None:
        position, status = event.position, event.status
        if 0 <= position < len(self.status) and 0 < status < 256 and self.status[position] != status:
            self.status = self.status.copy()
            self.status[position] = status
        self._changed("map")
        self._note(position, Attempt(at_s, event.attempts, "committed", status, event.snr_db, event.residual_db))

    def _note(self, position: int, attempt: Attempt) -> None:
        self.history.setdefault(position, []).append(attempt)
        self._changed("history")

    def _change_instrument(self, name: str, role: str, state: str, text: str, at_s: float) -> None:
        """Change the instrument of a name, or else of a role; a new one where there is none."""
        known = (
            one
            for wanted in (name, role)
            if wanted
            for one in self.instruments
            if wanted in one.name or one.name in wanted
        )
        instrument = next(known, None)
        if instrument is None:
            self.instruments.append(instrument := Instrument(name))
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
