"""Supervision of a running capture: orders to it, its heartbeat, and the thread that attends to both."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.acquisition.wording import hours
from wavefocus.campaign.sidecar_files import read_whole, write_whole
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
from wavefocus.config.messages.codec import Message, MessageError, from_record, to_record
from wavefocus.console import finish_time, say

Word = Literal["pause", "go-on", "stop"]


@dataclass(frozen=True)
class Order(Message):
    """An order to a running capture; its heartbeat repeats the number once the order was taken."""

    order: Word
    number: str


def orders_path(bank: Path) -> Path:
    """Where orders for a bank's capture are laid: ``plate.h5`` -> ``plate.h5.orders``."""
    return bank.with_name(bank.name + ".orders")


def give_order(bank: Path, word: Word) -> Order:
    """Lay an order; one that was not yet taken is replaced.

    Raises OSError: the file cannot be written.
    """
    order = Order(word, uuid.uuid4().hex)
    write_whole(orders_path(bank), to_record(order), by_many=True)
    return order


def take_order(bank: Path) -> Order | None:
    """Take the order that is there, if any; what is no order is taken away too.

    Raises OSError: it cannot be taken away.
    """
    path = orders_path(bank)
    return _order(_taken(path)) if path.exists() else None


def withdraw(bank: Path, order: Order) -> None:
    """Take an order back that nobody took."""
    path = orders_path(bank)
    if _order(read_whole(path) or {}) == order:
        taken = _taken(path)
        if _order(taken) not in (None, order):  # another one was laid in its place meanwhile
            write_whole(path, taken, by_many=True)


def _order(record: Mapping[str, object]) -> Order | None:
    with suppress(MessageError):
        return from_record(Order, record)
    return None


def _taken(path: Path) -> Mapping[str, object]:
    """Take a file away and return what it held; one that is laid meanwhile stays for the next call."""
    own = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    try:
        path.rename(own)
    except FileNotFoundError:
        return {}
    try:
        return read_whole(own) or {}
    finally:
        own.unlink(missing_ok=True)


BEATS_EVERY_S = 1.0
# Silence for longer is worth a word; a machine may be busy for some seconds.
SILENT_AFTER_S = 15.0


def heartbeat_path(bank: Path) -> Path:
    """Where a bank's heartbeat is: ``plate.h5`` -> ``plate.h5.heartbeat``."""
    return bank.with_name(bank.name + ".heartbeat")


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


class Pulse:
    """Gathers a campaign's events for the next heartbeat."""

    def __init__(self) -> None:
        self._beat = Heartbeat(datetime.now(UTC), os.getpid(), socket.gethostname())
        self._lock = threading.Lock()  # events come from the campaign's thread, orders from the attendance's

    def note(self, event: Event) -> bool:
        """Take an event; True where a heartbeat is due at once."""
        match event:
            case SessionStarted():
                self._set(done=event.done, total=event.positions)
            case StateChanged():
                self._set(state=event.state, reason=event.reason, since=datetime.now(UTC))
            case PositionStarted():
                self._set(position=event.position)
            case Progress():
                self._set(done=event.done, total=event.total, remaining_s=event.wall_remaining_s)
            case Fault():
                self._set(fault=f"{event.instrument}: {event.operation}: {event.cause}")
            case SessionEnded():
                self._set(done=event.done, position=None)
            case _:
                pass
        return isinstance(event, StateChanged | SessionEnded)

    def took(self, order: Order) -> None:
        """Let the next heartbeat acknowledge an order."""
        self._set(order=order.number)

    def beat(self) -> Heartbeat:
        """The heartbeat now."""
        return replace(self._beat, at=datetime.now(UTC))

    def _set(self, **facts: Any) -> None:
        with self._lock:
            self._beat = replace(self._beat, **facts)


def write_heartbeat(bank: Path, beat: Heartbeat) -> None:
    """Write a heartbeat.

    Raises OSError: it cannot be written.
    """
    finish = beat.finish_at
    content = {**to_record(beat), "finish_at": None if finish is None else finish.isoformat()}
    write_whole(heartbeat_path(bank), content)


def read_heartbeat(bank: Path) -> Heartbeat | None:
    """The latest heartbeat; None where there is none that can be read."""
    with suppress(MessageError):
        return from_record(Heartbeat, read_whole(heartbeat_path(bank)) or {})
    return None


LISTENS_EVERY_S = 0.2
# A single failure may be a file that somebody holds open, on Windows.
FAILURES_TOLD_AFTER = 3
ENDS_WITHIN_S = 5.0


class Attendance:
    """Subscribes to a campaign; whatever fails here, the campaign does not notice."""

    def __init__(self, bank: Path, stop: StopRequest) -> None:
        self._bank = bank
        self._stop = stop
        self._pulse = Pulse()
        self._wake = threading.Event()
        self._over = False
        self._failures = 0
        self._thread = threading.Thread(target=self._attend, name="attendance", daemon=True)

    def __call__(self, event: Event) -> None:
        """Take an event; the thread writes a change of state at once."""
        if self._pulse.note(event):
            self._wake.set()

    def __enter__(self) -> Attendance:
        self._take()  # an order that nobody took in an earlier session is not meant for this one
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over = True
        self._wake.set()
        # A disk that hangs must not hold up the way out.
        self._thread.join(ENDS_WITHIN_S)

    def _attend(self) -> None:
        beats_s = time.monotonic()
        while not self._over:
            order = self._take()
            if order is not None:
                self._carry_out(order)
            woken = self._wake.wait(LISTENS_EVERY_S)
            self._wake.clear()
            if order is not None or woken or time.monotonic() >= beats_s:
                self._beat()
                beats_s = time.monotonic() + BEATS_EVERY_S
        self._take()
        self._beat()

    def _carry_out(self, order: Order) -> None:
        {"pause": self._stop.pause, "go-on": self._stop.go_on, "stop": self._stop.finish_position}[order.order]()
        self._pulse.took(order)

    def _take(self) -> Order | None:
        try:
            return take_order(self._bank)
        except OSError as failure:
            self._report_failure(
                f"{orders_path(self._bank)} cannot be taken ({failure.strerror}); orders are not received"
            )
            return None

    def _beat(self) -> None:
        try:
            write_heartbeat(self._bank, self._pulse.beat())
        except OSError as failure:
            self._report_failure(
                f"the heartbeat of {self._bank} cannot be written ({failure.strerror}); the campaign goes on"
            )

    def _report_failure(self, sentence: str) -> None:
        """Report a failure that lasts, once."""
        self._failures += 1
        if self._failures == FAILURES_TOLD_AFTER:
            say(sentence)


def command_line(*words: object) -> str:
    """A command with its words quoted for this system's shell where they need it."""
    texts = [str(word) for word in words]
    return subprocess.list2cmdline(texts) if sys.platform == "win32" else shlex.join(texts)


def resume_line(bank: Path, rig_file: Path | None, *, word: str = "resume") -> str:
    """``wavefocus resume BANK``, with the rig file of this session where there is one: it may have been corrected."""
    return command_line("wavefocus", word, bank, *(("--rig", rig_file) if rig_file is not None else ()))
