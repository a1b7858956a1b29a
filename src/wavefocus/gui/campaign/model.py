"""State of the followed campaign, without Qt: statuses and figures of its positions, and the lines of its log."""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.event_wording import sentence
from wavefocus.campaign.status import GOING_ON, CampaignStatus
from wavefocus.config.messages import campaign as events
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.theme import LIGHT, Theme
from wavefocus.rendering.arrays import Float32Array
from wavefocus.storage.bank.ledger import Status

if TYPE_CHECKING:
    from wavefocus.campaign.status import Heartbeat
    from wavefocus.storage.ledger.owner import Owner

NOT_MEASURED = 0
DAMAGED = 128  # not in the bank: a row whose checksum does not hold
NOT_GOOD = Status.POOR_SIGNAL | Status.OVER_RANGE | Status.FAILED


@dataclass(frozen=True, slots=True)
class Look:
    """Look of a status: a colour per theme, pyqtgraph's name of a shape over the cell, and a sign like it."""

    word: str
    bit: int
    light: str
    dark: str
    symbol: str
    sign: str

    def colour(self, theme: Theme) -> str:
        return (self.light if theme is LIGHT else self.dark) or theme.cell


# A position with several bits has the look of the first of these; colours after Okabe and Ito.
LOOKS = (
    Look("damaged", DAMAGED, "#7d3c98", "#b57edc", "d", "◆"),
    Look("disabled", Status.DISABLED, "#8c959f", "#6b7580", "+", "+"),
    Look("failed", Status.FAILED, "#d55e00", "#ff7f3f", "x", "×"),
    Look("over-range", Status.OVER_RANGE, "#cc79a7", "#e29ac6", "s", "■"),
    Look("poor", Status.POOR_SIGNAL, "#e69f00", "#f0b030", "t", "▼"),
    Look("valid", Status.VALID, "#0072b2", "#2f8fd0", "", "&nbsp;"),
    Look("not measured", NOT_MEASURED, "", "", "", "&nbsp;"),
)


def status_text(status: int) -> str:
    """Status bits in words."""
    return ", ".join(look.word for look in reversed(LOOKS) if status & look.bit) or "not measured"


def look_index(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Index into `LOOKS` of each position."""
    index = np.full(len(status), len(LOOKS) - 1, np.uint8)
    for number in reversed(range(len(LOOKS) - 1)):
        index[(status & LOOKS[number].bit) > 0] = number
    return index


# Title of each quality figure, and what reduces (positions, actuators) to (positions,), ignoring NaN.
FIGURES: Mapping[str, tuple[str, Callable[..., Float32Array]]] = {
    "snr_db": ("signal-to-noise ratio of the records, median of the actuators (dB)", np.nanmedian),
    "residual_db": ("residual, worst actuator (dB)", np.nanmax),
    "coherence": ("coherence, worst actuator", np.nanmin),
    "peak_v": ("peak at the DAQ, largest of the actuators (V)", np.nanmax),
    "attempts": ("attempts", np.nanmax),
}


def per_position(quality: Mapping[str, Float32Array], measured: NDArray[np.bool_]) -> dict[str, Float32Array]:
    """One number per position and figure, NaN where a position is not measured or the bank has no such figure.

    quality, mapping of array (positions,) or (positions, actuators): Figures of the bank.
    measured, bool (positions,): Positions to use.
    """
    found = {}
    for key, (_, reduce) in FIGURES.items():
        values = quality.get(key)
        reduced = np.full(len(measured), np.nan, np.float32)
        if values is not None and measured.any():
            rows = np.asarray(values)[measured].reshape(int(measured.sum()), -1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # a row of nothing but NaN stays NaN
                reduced[measured] = reduce(rows, axis=1)
        found[key] = reduced
    return found


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


def read_record(record: Mapping[str, object]) -> events.Logged | EventLine:
    """Read a record of the log; one of another version becomes a line that holds whatever it says."""
    logged = events.event_of(record)
    if logged is not None:
        return logged
    facts = ", ".join(f"{key} {value}" for key, value in record.items() if key not in ("at", "event", "time_s"))
    text = f"{record.get('event')}: {facts}" if facts else str(record.get("event"))
    try:
        at_s = datetime.fromisoformat(str(record.get("at"))).timestamp()
    except ValueError:
        at_s = math.nan
    return EventLine(at_s, Weight.DETAIL, text[:200])


def clock(at_s: float) -> str:
    """Weekday and time; empty where it is NaN."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def line_of(logged: events.Logged) -> EventLine | None:
    """Line of an event; None for progress, which is shown otherwise."""
    if isinstance(logged.event, events.Progress | events.RecordTaken):
        return None
    position: int | None = getattr(logged.event, "position", None)
    row = -1 if position is None else position
    return EventLine(logged.at.timestamp(), _weight(logged.event), sentence(logged.event), row)


def _weight(event: events.Event) -> Weight:
    match event:
        case events.StateChanged(state=events.State.FAILED) | events.Fault() | events.CrosstalkMeasured(named=True):
            return Weight.FAULT
        case (
            events.StateChanged(state=events.State.RECOVERING | events.State.SUSPENDED)
            | events.PositionRepeated()
            | events.Drift(verdict="warn")
            | events.ReconnectTried(connected=False)
        ):
            return Weight.WARNING
        case events.Drift(verdict=verdict) if verdict != "steady":
            return Weight.FAULT
        case events.PositionCommitted(status=status):
            return Weight.DETAIL if status == Status.VALID else Weight.WARNING
    return Weight.DETAIL if isinstance(event, events.PositionStarted) else Weight.NOTE


# A week of a campaign's events; older ones are in the log. Lines are dropped in blocks.
KEPT_LINES = 20_000
_DROPPED_AT = 22_000
# A killed process may have logged its last event after its owner was last asked for.
_ASKED_AFTER_S = 0.05


class Extra(StrEnum):
    """States that only the window sees."""

    NO_BANK = "no bank"
    STARTING = "starting"
    PREPARING = "preparing"
    SILENT = "silent"
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class ShownState:
    """A state and its reason."""

    word: events.State | Extra
    reason: str = ""
    pause_asked: bool = False

    @property
    def paused(self) -> bool:
        """Whether the second press of Pause continues."""
        waits = self.word in (events.State.SUSPENDED, events.State.RECOVERING)
        return self.word in (events.State.PAUSING, events.State.PAUSED) or (self.pause_asked and waits)

    @property
    def measuring(self) -> bool:
        """Whether a process owns the bank, in whatever state."""
        return self.word in GOING_ON or self.word in (Extra.STARTING, Extra.PREPARING, Extra.SILENT)


@dataclass(eq=False)
class CampaignModel:
    """A campaign; arrays and lists but `lines` are replaced when they change, so that only changes are drawn."""

    surface: PlotSurface | None = None
    status: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    figures: Mapping[str, Float32Array] = field(default_factory=dict)
    lines: list[EventLine] = field(default_factory=list)
    trimmed: int = 0
    """How many of the oldest lines have been dropped."""
    instrument_faults: dict[str, str] = field(default_factory=dict)
    """Instruments whose last word in the log is a fault, and that word."""
    commits: Counter[int] = field(default_factory=Counter)
    """How often the log has each position committed."""
    drift: list[tuple[datetime, events.Drift]] = field(default_factory=list)
    session: CampaignStatus = field(default_factory=CampaignStatus)
    """As the log has it."""
    owner: Owner | None = None
    heartbeat: Heartbeat | None = None
    _begun: set[int] = field(default_factory=set)
    """Positions begun since the last fault of an instrument."""
    asked_s: float = 0.0
    """When owner and heartbeat were asked for, on the monotonic clock."""
    _logged_s: float = 0.0

    def add_records(self, records: Sequence[events.Logged | EventLine], *, anew: bool) -> None:
        """Add new records of the log; `anew` when the log was replaced."""
        if anew:
            self.trimmed += len(self.lines)
            self.lines.clear()
            self.instrument_faults.clear()
            self.commits.clear()
            self.session = CampaignStatus()
        for record in records:
            self._take_record(record)

    @property
    def measured(self) -> int:
        return int(np.count_nonzero(self.status & ~np.uint8(DAMAGED)))

    def forget(self) -> None:
        """Reset everything: another bank will be followed."""
        vars(self).update(vars(CampaignModel(trimmed=self.trimmed + len(self.lines))))

    def state(self, *, starting: bool = False) -> ShownState:
        """State of the campaign; `starting` while a capture of this window has not opened the bank yet."""
        owner, beat, session = self.owner, self.heartbeat, self.session
        logged = ShownState(session.state, session.reason, beat is not None and beat.pause_asked)
        if owner is not None:
            if beat is not None and beat.is_silent() and beat.pid == owner.pid:
                reason = f"process {owner.pid} on {owner.host} is stopped, or its machine is asleep or hung"
                return ShownState(Extra.SILENT, reason)
            if not session.goes_on:
                return ShownState(Extra.PREPARING, "checking the bank and the instruments")
            return logged
        if session.goes_on:
            if self.asked_s <= self._logged_s + _ASKED_AFTER_S:
                return logged
            if not starting:
                reason = f"its process ended unexpectedly while {logged.word}; Resume continues from there"
                return ShownState(Extra.GONE, reason)
        if starting:
            return ShownState(Extra.STARTING, "the capture is being started")
        return ShownState(Extra.NO_BANK) if self.surface is None else logged

    def _take_record(self, record: events.Logged | EventLine) -> None:
        line = record if isinstance(record, EventLine) else line_of(record)
        if line is not None:
            self.lines.append(line)
            if len(self.lines) > _DROPPED_AT:
                self.trimmed += len(self.lines) - KEPT_LINES
                del self.lines[:-KEPT_LINES]
        self._logged_s = time.monotonic()
        if isinstance(record, events.Logged):
            self.session = self.session.after(record)
            self._take_event(record.event, "" if line is None else line.text)

    def _take_event(self, event: events.Event, text: str) -> None:
        match event:
            case events.SessionStarted() | events.StateChanged(state=events.State.RUNNING):  # all instruments work
                self.instrument_faults.clear()
            case events.ReconnectTried(instrument=name, connected=True):
                self.instrument_faults.pop(name, None)
            case events.Fault(instrument=name) | events.ReconnectTried(instrument=name):
                self.instrument_faults[name] = text.removeprefix(f"{name}: ")
                self._begun.clear()
            case events.PositionStarted(position=position):
                self._begun.add(position)
            case events.PositionCommitted(position=position, status=status):
                self.commits[position] += 1
                if position in self._begun:  # it used all instruments
                    self.instrument_faults.clear()
                if 0 <= position < len(self.status) and 0 < status < 256 and self.status[position] != status:
                    self.status = self.status.copy()
                    self.status[position] = status
