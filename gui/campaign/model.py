"""Model of the followed campaign, made from the follower's findings, without Qt."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acquisition.engine.events import State
from gui.campaign.events import Line, Record, instant_s, line_of, number, whole
from gui.campaign.follower import DriftSeen, Ledger, Life, Opened, Records, Seen, Trouble
from gui.campaign.quality import DAMAGED, Float32Array
from gui.campaign.state import GOING, OVER, CampaignState, Extra
from gui.shell.front_door import Pulse
from gui.surface.surface import Surface

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint
    from storage.ledger.owner import Owner

# A week of a night's events; older ones are in the log. Lines are dropped in blocks.
KEPT_LINES = 20_000
_DROPPED_AT = 22_000
# A killed process may have logged its last event after its owner was last asked for.
_ASKED_AFTER_S = 0.05
_ROLES = ("mirror", "recorder", "player")
_RATE = "wall_positions_per_hour"


@dataclass(frozen=True, slots=True)
class Attempt:
    """One line of a position's quality history; `status` 0 and NaN where nothing was committed, `number` -1 unknown."""

    at_s: float
    number: int
    outcome: str
    status: int = 0
    snr_db: float = float("nan")
    residual_db: float = float("nan")


@dataclass(frozen=True, slots=True)
class Pace:
    """Progress and rate of the session, as the capture last reported."""

    done: int
    total: int
    per_hour: float
    wall_remaining_s: float
    told_s: float


@dataclass(slots=True)
class Instrument:
    """One instrument: ``"in use"``, ``"at rest"`` (the session is over), ``"faulty"`` or ``"away"``."""

    name: str
    state: str = "in use"
    message: str = ""
    at_s: float = float("nan")


class Instruments:
    """States of the instruments, from events."""

    def __init__(self) -> None:
        self.all: list[Instrument] = []

    def take(self, record: Record) -> bool:
        match record:
            case {"event": "session_started", "instruments": list(names)}:
                self.all = [Instrument(str(name)) for name in names]
            case {"event": "fault", "instrument": str(name)}:
                self._note(name, "faulty", record)
            case {"event": "reconnect_tried", "instrument": str(name), "connected": connected}:
                self._note(name, "in use" if connected else "away", record)
            case {"event": "position_committed"}:  # a measured position used all instruments
                return self._change_all({"at rest", "faulty", "away"}, "in use")
            case {"event": "state_changed", "state": "finished" | "stopped" | "failed"}:
                return self._change_all({"in use"}, "at rest")
            case _:
                return False
        return True

    def _note(self, name: str, state: str, record: Record) -> None:
        line, instrument = line_of(record), self._find(name, str(record.get("role", "")))
        instrument.state, instrument.at_s = state, instant_s(record)
        instrument.message = line.text.removeprefix(f"{name}: ") if line else ""

    def _find(self, name: str, role: str) -> Instrument:
        """The instrument of a name, or else of a role; a new one where there is none."""
        for wanted in filter(None, (name, role or next((role for role in _ROLES if role in name), ""))):
            for instrument in self.all:
                if wanted in instrument.name or instrument.name in wanted:
                    return instrument
        self.all.append(Instrument(name))
        return self.all[-1]

    def _change_all(self, former: set[str], state: str) -> bool:
        concerned = [instrument for instrument in self.all if instrument.state in former]
        for instrument in concerned:
            instrument.state = state
        return bool(concerned)


@dataclass(eq=False)
class Campaign:
    """A campaign; `revision` counts the changes of each part, so that only changes are drawn."""

    surface: Surface | None = None
    status: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    figures: Mapping[str, Float32Array] = field(default_factory=dict)
    lines: list[Line] = field(default_factory=list)
    trimmed: int = 0
    history: dict[int, list[Attempt]] = field(default_factory=dict)
    instruments: Instruments = field(default_factory=Instruments)
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
            if logged.word in OVER:
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
        self.instruments = Instruments()
        self.pace, self.current = None, -1
        self._logged = CampaignState(State.IDLE)
        self.trimmed += 1
        self._changed("lines", "history", "instruments", "map")

    def _take_record(self, record: Record) -> None:
        line = line_of(record)
        if line is not None:
            self.lines.append(line)
            if len(self.lines) > _DROPPED_AT:
                del self.lines[: len(self.lines) - KEPT_LINES]
                self.trimmed += 1
            self._changed("lines")
        self._logged_s = time.monotonic()
        if self.instruments.take(record):
            self._changed("instruments")
        position = whole(record, "position")
        match record.get("event"):
            case "session_started":
                self._logged, self.pace = CampaignState(State.IDLE), None
            case "state_changed" if record.get("state") in set(State):  # not one of a later version
                self._logged = CampaignState(State(str(record["state"])), str(record.get("reason", "")))
                if self._logged.word in OVER:
                    self.current = -1
                    self._changed("map")
            case "position_started":
                self.current = position
                self._changed("map")
            case "position_committed":
                self._commit(record, position)
            case "position_repeated" | "position_kept" as kind:
                outcome = "repeated" if kind == "position_repeated" else "earlier measurement kept"
                self._note(position, Attempt(instant_s(record), whole(record, "attempt"),
                                             f"{outcome}: {record.get('reason')}"))  # fmt: skip
            case "progress":
                self.pace = Pace(
                    whole(record, "done"),
                    whole(record, "total"),
                    number({_RATE: record.get("positions_per_hour"), **record}, _RATE),  # the former key of old logs
                    number(record, "wall_remaining_s"),
                    instant_s(record),
                )

    def _commit(self, record: Record, position: int) -> None:
        status = whole(record, "status")
        if 0 <= position < len(self.status) and 0 < status < 256 and self.status[position] != status:
            self.status = self.status.copy()
            self.status[position] = status
        self._changed("map")
        snr_db, residual_db = number(record, "snr_db"), number(record, "residual_db")
        attempts = whole(record, "attempts")
        self._note(position, Attempt(instant_s(record), attempts, "committed", status, snr_db, residual_db))

    def _note(self, position: int, attempt: Attempt) -> None:
        self.history.setdefault(position, []).append(attempt)
        self._changed("history")

    def _changed(self, *parts: str) -> None:
        for part in parts:
            self.revision[part] += 1
