"""What the window knows of a campaign: gathered from what the follower saw, without any Qt."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acquisition.engine.events import State
from gui.campaign.event_words import Line, Record, instant_s, line_of, number, whole
from gui.campaign.figures import Float32Array
from gui.campaign.follower import DriftSeen, Ledger, Life, Opened, Records, Seen, Trouble
from gui.campaign.instruments import Instruments
from gui.campaign.standing import GOING, OVER, Extra, Standing
from gui.shell.front_door import Pulse
from gui.surface.surface import Surface

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint
    from storage.ledger.owner import Owner

# A week of a night's events; what is older is in the log.
KEPT_LINES = 20_000
_TRIMMED_AT = 22_000
# A process that was just killed may have told its last event after its owner was last asked for.
_ASKED_AFTER_S = 0.05

_RATE = "wall_positions_per_hour"


@dataclass(frozen=True, slots=True)
class Attempt:
    """One line of a position's quality history.

    Parameters
    ----------
    at_s : float
        Seconds since 1970.
    number : int
        Which attempt, -1 where the log does not say.
    outcome : str
        What became of it.
    status : int
        The contract's bits, 0 where nothing was committed.
    snr_db, residual_db : float
        NaN where nothing was committed.
    """

    at_s: float
    number: int
    outcome: str
    status: int = 0
    snr_db: float = float("nan")
    residual_db: float = float("nan")


@dataclass(frozen=True, slots=True)
class Pace:
    """How far the session is and how fast it goes, as the capture last told."""

    done: int
    total: int
    elapsed_s: float
    per_hour: float
    wall_remaining_s: float
    told_s: float


@dataclass(eq=False)
class Campaign:
    """A campaign as it is known now; `revision` counts the changes of each part, so that only news is drawn."""

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
    trouble: str = ""
    trouble_details: str = ""
    revision: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("surface", "map", "lines", "instruments", "drift", "history"), 0)
    )
    _state: State = State.IDLE
    _reason: str = ""
    _heard_s: float = 0.0
    _asked_s: float = 0.0

    def take(self, seen: Seen) -> None:
        """Take up one finding of the follower."""
        match seen:
            case Records(records, anew):
                if anew:
                    self._forget_log()
                for record in records:
                    self._take_record(record)
            case Opened(surface):
                self._open(surface)
            case Ledger(status, figures):
                self.status, self.figures = status, figures
                self._changed("map")
            case Life(owner, pulse, asked_s):
                self.owner, self.pulse, self._asked_s = owner, pulse, asked_s
            case DriftSeen(points):
                self.drift = points
                self._changed("drift")
            case Trouble(sentence, details):
                self.trouble, self.trouble_details = sentence, details

    @property
    def measured(self) -> int:
        """Positions that the bank holds."""
        return int(np.count_nonzero(self.status))

    def forget(self) -> None:
        """Know nothing: another bank will be followed."""
        self.surface, self.owner, self.pulse, self.trouble, self.trouble_details = None, None, None, "", ""
        self.status, self.figures, self.drift = np.zeros(0, np.uint8), {}, []
        self._forget_log()
        self._changed("surface", "drift")

    def standing(self, *, starting: bool = False) -> Standing:
        """How the campaign stands; `starting` when a process of the window's own has not shown itself yet."""
        if self.owner is None:
            return self._unowned(starting)
        if self.pulse is not None and self.pulse.silent and self.pulse.pid == self.owner.pid:
            return Standing(
                Extra.SILENT, f"process {self.owner.pid} on {self.owner.host} is held, or its machine is asleep or hung"
            )
        if self._state in OVER:
            return Standing(Extra.PREPARING, "checking the bank and asking the instruments")
        return Standing(self._state, self._reason)

    def _unowned(self, starting: bool) -> Standing:
        asked_since = self._asked_s > self._heard_s + _ASKED_AFTER_S
        if self._state in GOING:
            if not asked_since:
                return Standing(self._state, self._reason)
            if not starting:
                return Standing(
                    Extra.GONE, f"its process ended without a good-bye while {self._state}; resume goes on from there"
                )
        if starting:
            return Standing(Extra.STARTING, "the capture is being started")
        if self.surface is None:
            return Standing(Extra.NO_BANK)
        return Standing(self._state, self._reason)

    def _open(self, surface: Surface) -> None:
        self.surface = surface
        self.status = np.zeros(surface.positions, np.uint8)
        self.figures = {}
        self._changed("surface", "map", "history")

    def _forget_log(self) -> None:
        self.lines.clear()
        self.history.clear()
        self.instruments = Instruments()
        self.pace, self.current = None, -1
        self._state, self._reason = State.IDLE, ""
        self.trimmed += 1
        self._changed("lines", "history", "instruments", "map")

    def _take_record(self, record: Record) -> None:
        line = line_of(record)
        if line is not None:
            self.lines.append(line)
            if len(self.lines) > _TRIMMED_AT:
                del self.lines[: len(self.lines) - KEPT_LINES]
                self.trimmed += 1
            self._changed("lines")
        self._heard_s = time.monotonic()
        if self.instruments.take(record):
            self._changed("instruments")
        position = whole(record, "position")
        match record.get("event"):
            case "session_started":
                self._state, self._reason = State.IDLE, ""
                self.pace = None
            case "state_changed":
                self._enter(record)
            case "position_started":
                self.current = position
                self._changed("map")
            case "position_committed":
                self._commit(record, position)
            case "position_repeated" | "position_kept" as kind:
                outcome = "repeated" if kind == "position_repeated" else "kept what was there"
                self._note(position, record, f"{outcome}: {record.get('reason')}")
            case "progress":
                self.pace = Pace(
                    whole(record, "done"),
                    whole(record, "total"),
                    number(record, "elapsed_s"),
                    # Logs of earlier versions have the rate on the rig's clock alone.
                    number({_RATE: record.get("positions_per_hour"), **record}, _RATE),
                    number(record, "wall_remaining_s"),
                    instant_s(record),
                )

    def _enter(self, record: Record) -> None:
        try:
            self._state = State(str(record.get("state")))
        except ValueError:
            return  # a later version's
        self._reason = str(record.get("reason", ""))
        if self._state in OVER:
            self.current = -1
            self._changed("map")

    def _commit(self, record: Record, position: int) -> None:
        status = whole(record, "status")
        if 0 <= position < len(self.status) and 0 < status < 256 and self.status[position] != status:
            self.status = self.status.copy()
            self.status[position] = status
        self._changed("map")
        self._note(
            position, record, "committed", status, number(record, "snr_db"), number(record, "residual_db"), "attempts"
        )

    def _note(
        self,
        position: int,
        record: Record,
        outcome: str,
        status: int = 0,
        snr_db: float = float("nan"),
        residual_db: float = float("nan"),
        counted: str = "attempt",
    ) -> None:
        attempt = Attempt(instant_s(record), whole(record, counted), outcome, status, snr_db, residual_db)
        self.history.setdefault(position, []).append(attempt)
        self._changed("history")

    def _changed(self, *parts: str) -> None:
        for part in parts:
            self.revision[part] += 1
