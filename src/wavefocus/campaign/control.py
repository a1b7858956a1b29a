"""Control of a running capture: orders to it, its heartbeat, and the thread that attends to both."""

from __future__ import annotations

import shlex
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.campaign.sidecar_files import read_whole, write_whole
from wavefocus.campaign.status import CampaignStatus, Heartbeat
from wavefocus.config.messages import Message, MessageError, from_record, to_record
from wavefocus.config.messages.campaign import Event, Logged, SessionEnded, StateChanged
from wavefocus.console import say

Word = Literal["pause", "go-on", "stop"]


class CampaignOrder(Message, frozen=True):
    """An order to a running capture; its heartbeat repeats the number once the order was taken."""

    order: Word
    number: str


def orders_path(bank: Path) -> Path:
    """Where orders for a bank's capture are laid: ``plate.h5`` -> ``plate.h5.orders``."""
    return bank.with_name(bank.name + ".orders")


def give_order(bank: Path, word: Word) -> CampaignOrder:
    """Lay an order; one that was not yet taken is replaced.

    Raises OSError: the file cannot be written.
    """
    order = CampaignOrder(word, uuid.uuid4().hex)
    write_whole(orders_path(bank), to_record(order), by_many=True)
    return order


def take_order(bank: Path) -> CampaignOrder | None:
    """Take the order that is there, if any; what is no order is taken away too.

    Raises OSError: it cannot be taken away.
    """
    path = orders_path(bank)
    return _order(_taken(path)) if path.exists() else None


def withdraw(bank: Path, order: CampaignOrder) -> None:
    """Take an order back that nobody took."""
    path = orders_path(bank)
    if _order(read_whole(path) or {}) == order:
        taken = _taken(path)
        if _order(taken) not in (None, order):  # another one was laid in its place meanwhile
            write_whole(path, taken, by_many=True)


def _order(record: Mapping[str, object]) -> CampaignOrder | None:
    with suppress(MessageError):
        return from_record(CampaignOrder, record)
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


def heartbeat_path(bank: Path) -> Path:
    """Where a bank's heartbeat is: ``plate.h5`` -> ``plate.h5.heartbeat``."""
    return bank.with_name(bank.name + ".heartbeat")


def read_heartbeat(bank: Path) -> Heartbeat | None:
    """The latest heartbeat; None where there is none that can be read."""
    with suppress(MessageError):
        return from_record(Heartbeat, read_whole(heartbeat_path(bank)) or {})
    return None


class CampaignControl:
    """Subscribes to a campaign; whatever fails here, the campaign does not notice."""

    def __init__(self, bank: Path, stop: StopRequest) -> None:
        self._bank = bank
        self._stop = stop
        self._status, self._order = CampaignStatus(), ""
        self._wake = threading.Event()
        self._over = False
        self._failures = 0
        self._thread = threading.Thread(target=self._attend, name="campaign control", daemon=True)

    def __call__(self, event: Event) -> None:
        """Take an event; the thread writes a change of state at once."""
        self._status = self._status.after(Logged(datetime.now(UTC), event))
        if isinstance(event, StateChanged | SessionEnded):
            self._wake.set()

    def __enter__(self) -> CampaignControl:
        self._take()  # an order that nobody took in an earlier session is not meant for this one
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        self._wake.set()
        # A disk that hangs must not hold up the way out.
        self._thread.join(5.0)

    def _attend(self) -> None:
        beats_s = time.monotonic()
        while not self._over:
            order = self._take()
            if order is not None:
                stop, self._order = self._stop, order.number
                {"pause": stop.pause, "go-on": stop.go_on, "stop": stop.finish_position}[order.order]()
            woken = self._wake.wait(0.2)
            self._wake.clear()
            if order is not None or woken or time.monotonic() >= beats_s:
                self._beat()
                beats_s = time.monotonic() + 1.0
        self._take()
        self._beat()

    def _take(self) -> CampaignOrder | None:
        try:
            return take_order(self._bank)
        except OSError as failure:
            self._report_failure(
                f"{orders_path(self._bank)} cannot be taken ({failure.strerror}); orders are not received"
            )
            return None

    def _beat(self) -> None:
        pause_asked = self._stop.pause_requested and not self._stop.requested
        beat = Heartbeat.of(self._status, self._order, pause_asked=pause_asked)
        finish = None if beat.finish_at is None else beat.finish_at.isoformat()
        try:
            write_whole(heartbeat_path(self._bank), {**to_record(beat), "finish_at": finish})
        except OSError as failure:
            self._report_failure(
                f"the heartbeat of {self._bank} cannot be written ({failure.strerror}); the campaign goes on"
            )

    def _report_failure(self, sentence: str) -> None:
        """Report a failure that lasts, once."""
        self._failures += 1
        # A single failure may be a file that somebody holds open, on Windows.
        if self._failures == 3:
            say(sentence)


def command_line(*words: object) -> str:
    """A command with its words quoted for this system's shell where they need it."""
    texts = [str(word) for word in words]
    return subprocess.list2cmdline(texts) if sys.platform == "win32" else shlex.join(texts)


def resume_line(bank: Path, rig_file: Path | None, *, word: str = "resume") -> str:
    """``wavefocus resume BANK``, with the rig file of this session where there is one: it may have been corrected."""
    return command_line("wavefocus", word, bank, *(("--rig", rig_file) if rig_file is not None else ()))
