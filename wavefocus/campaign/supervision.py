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
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType

from acquisition.engine.events import (
    Event,
    Fault,
    PositionStarted,
    Progress,
    SessionEnded,
    SessionStarted,
    StateChanged,
)
from acquisition.engine.stop_request import StopRequest
from wavefocus.campaign.sidecar_files import read_whole, write_whole
from wavefocus.console import say

WORDS = ("pause", "go-on", "stop")


@dataclass(frozen=True, slots=True)
class Order:
    """One order.

    Parameters
    ----------
    word : str
        One of `WORDS`.
    number : str
        What the capture repeats in its heartbeat, so that the order is known to have been heard.
    """

    word: str
    number: str


def orders_path(bank: Path) -> Path:
    """Where orders for a bank's capture are laid: ``plate.h5`` -> ``plate.h5.orders``."""
    return bank.with_name(bank.name + ".orders")


def give_order(bank: Path, word: str) -> Order:
    """Lay an order; one that was not yet taken is replaced.

    Raises OSError: the file cannot be written.
    """
    order = Order(word, uuid.uuid4().hex)
    write_whole(orders_path(bank), {"order": order.word, "number": order.number}, by_many=True)
    return order


def take_order(bank: Path) -> Order | None:
    """Take the order that is there, if any; what is no order is taken away too.

    Raises OSError: it cannot be taken away.
    """
    path = orders_path(bank)
    if not path.exists():
        return None
    found = _taken(path)
    word, number = found.get("order"), found.get("number")
    return Order(word, number) if isinstance(word, str) and word in WORDS and isinstance(number, str) else None


def withdraw(bank: Path, order: Order) -> None:
    """Take an order back that nobody took."""
    path = orders_path(bank)
    found = read_whole(path)
    if found is not None and found.get("number") == order.number:
        taken = _taken(path)
        if taken.get("number") not in (None, order.number):  # another one was laid in its place meanwhile
            write_whole(path, taken, by_many=True)


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


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """What a capture says of itself.

    Parameters
    ----------
    at : datetime
        When.
    pid, host : int, str
        Who.
    state, reason, since : str, str, datetime
        Where it stands, why, and since when.
    position : int, optional
        What it measures.
    done, total : int
        Positions.
    remaining_s : float, optional
        On the wall's clock; None before the first position.
    fault : str
        The latest fault in words; empty where there was none.
    order : str
        Number of the latest order that it took; empty where there was none.
    """

    at: datetime
    pid: int
    host: str
    state: str = "idle"
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
        return None if self.remaining_s is None else self.at + timedelta(seconds=self.remaining_s)

    def age_s(self, now: datetime | None = None) -> float:
        """Seconds since then."""
        return ((now or datetime.now(UTC)) - self.at).total_seconds()


class Pulse:
    """Gathers from a campaign's events what the next beat will say.

    The attributes are replaced one by one; a beat between two of them is right a second later.
    """

    def __init__(self) -> None:
        self._said: dict[str, object] = {}

    def note(self, event: Event) -> bool:
        """Take an event up; tells whether it is worth a beat at once."""
        match event:
            case SessionStarted():
                self._said |= {"done": event.done, "total": event.positions}
            case StateChanged():
                self._said |= {"state": str(event.state), "reason": event.reason, "since": datetime.now(UTC)}
                return True
            case PositionStarted():
                self._said["position"] = event.position
            case Progress():
                self._said |= {"done": event.done, "total": event.total, "remaining_s": event.wall_remaining_s}
            case Fault():
                self._said["fault"] = f"{event.instrument}: {event.operation}: {event.cause}"
            case SessionEnded():
                self._said |= {"done": event.done, "position": None}
                return True
            case _:
                pass
        return False

    def took(self, order: Order) -> None:
        """Let the next beat acknowledge an order."""
        self._said["order"] = order.number

    def beat(self) -> Heartbeat:
        """What there is to say now."""
        return Heartbeat(datetime.now(UTC), os.getpid(), socket.gethostname(), **dict(self._said))  # type: ignore[arg-type]


def write_heartbeat(bank: Path, beat: Heartbeat) -> None:
    """Write a beat.

    Raises OSError: it cannot be written.
    """
    content = {key: value.isoformat() if isinstance(value, datetime) else value for key, value in asdict(beat).items()}
    finish = beat.finish_at
    write_whole(heartbeat_path(bank), {**content, "finish_at": finish.isoformat() if finish else None})


def read_heartbeat(bank: Path) -> Heartbeat | None:
    """The latest beat; None where there is none that can be read."""
    found = read_whole(heartbeat_path(bank))
    if found is None:
        return None
    found.pop("finish_at", None)
    try:
        at, since = datetime.fromisoformat(str(found.pop("at"))), found.pop("since", None)
        beat = Heartbeat(at, since=None if since is None else datetime.fromisoformat(str(since)), **found)  # type: ignore[arg-type]
        _ = beat.age_s()  # only an instant with a time zone has one
    except (TypeError, ValueError, KeyError):
        return None
    return beat


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
        """Take up an event; a change of state is told at once, by the thread."""
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
                self._obey(order)
            woken = self._wake.wait(LISTENS_EVERY_S)
            self._wake.clear()
            if order is not None or woken or time.monotonic() >= beats_s:
                self._beat()
                beats_s = time.monotonic() + BEATS_EVERY_S
        self._take()
        self._beat()

    def _obey(self, order: Order) -> None:
        if order.word == "pause":
            self._stop.pause()
        elif order.word == "go-on":
            self._stop.go_on()
        else:
            self._stop.finish_position()
        self._pulse.took(order)

    def _take(self) -> Order | None:
        try:
            return take_order(self._bank)
        except OSError as failure:
            self._tell(f"{orders_path(self._bank)} cannot be taken ({failure.strerror}); orders are not heard")
            return None

    def _beat(self) -> None:
        try:
            write_heartbeat(self._bank, self._pulse.beat())
        except OSError as failure:
            self._tell(f"the heartbeat of {self._bank} cannot be written ({failure.strerror}); the campaign goes on")

    def _tell(self, sentence: str) -> None:
        """Tell a failure that lasts, once."""
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
