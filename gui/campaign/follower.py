"""Follows a bank, its log and its heartbeat in a thread; events of the log as lines for the event list."""

from __future__ import annotations

import json
import math
import os
import queue
import threading
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from acquisition.wording import hours
from config.messages.campaign import (
    ConditionsSeen,
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
    ScheduleSettled,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
    event_of,
)
from gui.campaign.quality import DAMAGED, Float32Array, per_position, status_text
from gui.front_door import FrontDoor, Pulse
from gui.surface import Surface, surface_of
from storage.bank.ledger import VALID
from storage.errors import WavefocusError

if TYPE_CHECKING:
    from acquisition.limits import DriftPoint
    from storage.bank.reading import Bank
    from storage.ledger.owner import Owner


_LONGEST = 200


class Weight(IntEnum):
    """Importance of an event."""

    DETAIL = 0
    NOTE = 1
    WARNING = 2
    FAULT = 3


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the event list: seconds since 1970 or NaN, and the bank row concerned or -1."""

    at_s: float
    weight: Weight
    text: str
    position: int = -1


def read_record(record: Mapping[str, object]) -> Logged | Line:
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
    return Line(at_s, Weight.DETAIL, text[:_LONGEST])


def clock(at_s: float) -> str:
    """Weekday and time; empty where it is NaN."""
    return "" if math.isnan(at_s) else datetime.fromtimestamp(at_s).astimezone().strftime("%a %H:%M:%S")


def line_of(logged: Logged) -> Line | None:
    """Line of an event; None for progress, which is shown otherwise."""
    if isinstance(logged.event, Progress | RecordTaken):
        return None
    position: int | None = getattr(logged.event, "position", None)
    return Line(logged.at.timestamp(), *_sentence(logged.event), position=-1 if position is None else position)


def _sentence(event: Event) -> tuple[Weight, str]:
    match event:
        case SessionStarted():
            return Weight.NOTE, (
                f"session begins: {event.done} of {event.positions} positions measured, {event.to_do} to do with "
                f"{event.actuators} actuators; planned: {hours(event.planned_s)}"
            )
        case ScheduleSettled():
            return Weight.NOTE, f"schedule: {event.chosen}: {event.reason}"
        case StateChanged(state=state):
            weights = {State.FAILED: Weight.FAULT, State.RECOVERING: Weight.WARNING, State.SUSPENDED: Weight.WARNING}
            return weights.get(state, Weight.NOTE), f"{state}: {event.reason}"
        case PositionStarted():
            again = f", attempt {event.attempt}" if event.attempt > 1 else ""
            return Weight.DETAIL, f"position {event.position} at ({event.x_mm:.1f}, {event.y_mm:.1f}) mm begins{again}"
        case PositionCommitted():
            return Weight.DETAIL if event.status == VALID else Weight.WARNING, (
                f"position {event.position} is measured: {status_text(event.status)}, signal-to-noise ratio "
                f"{event.snr_db:.1f} dB, residual {event.residual_db:.1f} dB"
            )
        case PositionRepeated():
            return Weight.WARNING, f"position {event.position} is measured again: {event.reason}"
        case PositionKept():
            return Weight.NOTE, f"position {event.position} keeps its earlier measurement: {event.reason}"
        case PassStarted():
            return Weight.NOTE, f"all that is not valid is measured again: {len(event.positions)} positions"
        case Fault():
            then = "trying again" if event.retried else "not tried again"
            return Weight.FAULT, f"{event.instrument}: {event.operation}: {event.cause}; {event.remedy} ({then})"
        case ReconnectTried():
            attempt = f"{event.instrument}: attempt {event.number} to reconnect"
            if event.connected:
                return Weight.NOTE, f"{attempt} succeeded"
            then = "" if event.next_try_s is None else f"; next attempt in {hours(event.next_try_s)}"
            return Weight.WARNING, f"{attempt} failed: {event.outcome}{then}"
        case Drift():
            weight = {"steady": Weight.NOTE, "warn": Weight.WARNING}.get(event.verdict, Weight.FAULT)
            return weight, (
                f"sentinel position {event.position}: level {event.level_db:+.2f} dB, delay "
                f"{event.delay_samples:+.3f} samples, correlation {event.correlation:.5f}: {event.verdict}"
                f"{f' ({event.cause})' if event.cause else ''}"
            )
        case ConditionsSeen():
            return Weight.NOTE, f"{'conditions are back' if event.back else 'still suspended'}: {event.reason}"
        case SessionEnded():
            counts = ", ".join(f"{count} {word}" for word, count in event.counts.items() if count)
            return Weight.NOTE, (
                f"session over, {event.state}: {event.done} of {event.total} positions ({counts}); "
                f"{hours(event.time_s)} on the rig's clock"
            )
    return Weight.DETAIL, event.tag["event"]


# What is read at once: larger blocks leave the memory of their many small objects behind.
_BLOCK_BYTES = 1 << 17


class LogTail:
    """Reads what was appended since the last look; the file is never held open.

    Parameters
    ----------
    path : Path
        A file of JSON lines; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._identity: tuple[int, int] | None = None
        self._offset = 0

    def read(self) -> tuple[list[dict[str, object]], bool]:
        """Return new records, at most a block of them, and whether the file has begun anew.

        A line without its end is left for later; one that is no JSON object (torn by a power cut) is passed over.
        A file that is gone, or cannot be read just now, has nothing new.
        """
        try:
            found = self._path.stat()
        except OSError:
            return [], False
        identity = (found.st_dev, found.st_ino)
        anew = self._identity is not None and (identity != self._identity or found.st_size < self._offset)
        if anew or self._identity is None:
            self._offset = 0
        self._identity = identity
        if found.st_size == self._offset:
            return [], anew
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                block = file.read(_BLOCK_BYTES)
        except OSError:
            return [], anew
        end = block.rfind(b"\n") + 1
        if end == 0 and len(block) == _BLOCK_BYTES:
            end = len(block)  # no event is that long; do not wait for its end for ever
        self._offset += end
        return [record for line in block[:end].splitlines() if (record := _record(line)) is not None], anew


def _record(line: bytes) -> dict[str, object] | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


_READ_EVERY_S = 0.05
_LIFE_EVERY_S = 1.0
# Reading the ledger of a large bank takes a while; at most this fraction of the time.
_LEDGER_SHARE = 0.005
_LEDGER_EVERY_S = 1.0
# Longer than the thread sleeps.
_ENDS_WITHIN_S = 0.2


@dataclass(frozen=True, slots=True)
class Opened:
    """The bank was opened, for the first time or after it was replaced."""

    surface: Surface


@dataclass(frozen=True, slots=True)
class Records:
    """New events; `anew` when the log was replaced."""

    records: list[Logged | Line]
    anew: bool


@dataclass(frozen=True, slots=True)
class Ledger:
    """Status bits and quality figures of all positions."""

    status: NDArray[np.uint8]
    figures: Mapping[str, Float32Array]


@dataclass(frozen=True, slots=True)
class Life:
    """Owner of the bank and its heartbeat; asked for at `asked_s` of the monotonic clock."""

    owner: Owner | None
    pulse: Pulse | None
    asked_s: float


@dataclass(frozen=True, slots=True)
class DriftSeen:
    """The whole drift history."""

    points: list[DriftPoint]


@dataclass(frozen=True, slots=True)
class Trouble:
    """A message about an unreadable file, empty when it can be read again; `details` is the traceback of a defect."""

    sentence: str
    details: str = ""


Seen = Opened | Records | Ledger | Life | DriftSeen | Trouble


class Follower:
    """Follows one bank, which may not exist yet, until it is ended."""

    def __init__(self, bank: Path, front: FrontDoor) -> None:
        self.bank = bank
        self._front = front
        self._tail = LogTail(front.log_path(bank))
        self._seen: queue.SimpleQueue[Seen] = queue.SimpleQueue()
        self._over = threading.Event()
        self._identity: tuple[int, int] | None = None
        self._owner: Owner | None = None
        self._trouble = ""
        self._stale = False
        self._ledger_due_s = self._life_due_s = 0.0
        self._thread = threading.Thread(target=self._follow, name=f"follower of {bank.name}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Stop following, without waiting for a disk that hangs."""
        self._over.set()
        self._thread.join(_ENDS_WITHIN_S)

    def take(self, most: int) -> list[Seen]:
        """Findings since the last call, at most so many."""
        found: list[Seen] = []
        while len(found) < most:
            try:
                found.append(self._seen.get_nowait())
            except queue.Empty:
                break
        return found

    def _follow(self) -> None:
        while not self._over.is_set():
            try:
                self._look()
            except Exception as failure:  # the thread must not end unnoticed
                if isinstance(failure, WavefocusError | OSError):
                    self._report(str(failure))
                else:
                    sentence = f"{self.bank.name} is not followed ({type(failure).__name__}: {failure})"
                    details = "".join(traceback.format_exception(failure))
                    self._report(f"{sentence}; the display may be out of date", details)
                self._identity = None
                self._over.wait(_LIFE_EVERY_S)
            self._over.wait(_READ_EVERY_S)

    def _look(self) -> None:
        now_s = time.monotonic()
        # A new bank is opened before its events are reported, which name its positions.
        if now_s >= self._life_due_s or (self._identity is None and self.bank.exists()):
            self._life_due_s = now_s + _LIFE_EVERY_S
            self._look_at_bank()
        records, anew = self._tail.read()
        if records or anew:
            entries = [read_record(record) for record in records]
            kinds = {type(entry.event) if isinstance(entry, Logged) else Line for entry in entries}
            self._stale |= not kinds.isdisjoint({PositionCommitted, SessionEnded, Line})
            self._seen.put(Records(entries, anew))
            if Drift in kinds:
                self._seen.put(DriftSeen(self._front.read_drift(self.bank)))
        if self._stale and self._identity is not None and time.monotonic() >= self._ledger_due_s:
            with _opened(self.bank) as bank:
                self._put_ledger(bank)

    def _look_at_bank(self) -> None:
        try:
            found = self.bank.stat()
        except FileNotFoundError:
            if self._identity is not None:
                self._report(f"{self.bank} has been deleted or moved; put it back, or open another bank")
            self._identity = None
            self._put_life(None)
            return
        identity = (found.st_dev, found.st_ino)
        if identity != self._identity:
            with _opened(self.bank) as bank:
                self._seen.put(Opened(surface_of(bank)))
                self._put_ledger(bank)
            self._seen.put(DriftSeen(self._front.read_drift(self.bank)))
            self._identity = identity
        owner = _owner_of(self.bank)
        self._stale |= owner != self._owner
        self._put_life(owner)
        self._report("")

    def _put_life(self, owner: Owner | None) -> None:
        self._owner = owner
        self._seen.put(Life(owner, self._front.read_pulse(self.bank), time.monotonic()))

    def _put_ledger(self, bank: Bank) -> None:
        began_s = time.monotonic()
        status = bank.status
        figures = per_position(bank.quality, status > 0)
        status[bank.broken] = DAMAGED
        self._seen.put(Ledger(status, figures))
        took_s = time.monotonic() - began_s
        self._ledger_due_s = time.monotonic() + max(_LEDGER_EVERY_S, took_s / _LEDGER_SHARE)
        self._stale = False

    def _report(self, sentence: str, details: str = "") -> None:
        if sentence != self._trouble:
            self._trouble = sentence
            self._seen.put(Trouble(sentence, details))


def same_file(one: Path, other: Path) -> bool:
    """Whether two paths name one file, also where it does not exist yet."""
    return os.path.normcase(one.absolute()) == os.path.normcase(other.absolute())


def _opened(path: Path) -> Bank:
    from storage.bank.reading import open_bank  # h5py is slow to import

    return open_bank(path)


def _owner_of(path: Path) -> Owner | None:
    from storage.ledger.owner import bank_owner

    return bank_owner(path)
