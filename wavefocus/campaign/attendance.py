"""Attendance: while a capture runs, a thread beats its heart and listens for orders."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import TracebackType

from acquisition.engine.events import Event
from acquisition.engine.stopping import StopRequest
from wavefocus.campaign.heartbeat import BEATS_EVERY_S, Pulse, write_heartbeat
from wavefocus.campaign.orders import Order, orders_path, take_order
from wavefocus.console import say

LISTENS_EVERY_S = 0.2
# A single failure may be a file that somebody holds open, on Windows.
FAILURES_TOLD_AFTER = 3
ENDS_WITHIN_S = 5.0


class Attendance:
    """Subscribes to a campaign; whatever fails here, the campaign does not notice.

    Parameters
    ----------
    bank : Path
        Whose.
    stop : StopRequest
        Where orders go.
    """

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
