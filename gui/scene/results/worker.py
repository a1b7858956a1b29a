"""The process that calculates scenes beside the window: it takes the latest order, and tells what it finds.

A thread of the window would hold it up: with 1500 positions its ticks came up to 0.24 s late. The process also keeps
its memory to itself, goes with the window, and can be ended at any time.
"""

from __future__ import annotations

import os
import time
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection

from gui.scene.results.calculator import Calculator, ReadRig, ReadScene, SupersededError
from gui.scene.results.messages import Broken, Done, Failed, Order, Progress, Request, Told
from storage.errors import InputError

QUIET_S = 0.12
LOOKS_EVERY_S = 1.0
_PROGRESS_EVERY_S = 0.1
# Runs come first: a capture must not notice that somebody draws.
_NICE = 10


def serve(connection: Connection, read_scene: ReadScene, read_rig: ReadRig) -> None:
    """Calculate what is asked for until the window is gone."""
    if hasattr(os, "nice"):
        with suppress(OSError):
            os.nice(_NICE)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        _Server(connection, read_scene, read_rig).serve()


class _Server:
    def __init__(self, connection: Connection, read_scene: ReadScene, read_rig: ReadRig) -> None:
        self._connection = connection
        self._told_progress_s = -1.0
        self._calculator = Calculator(self._tell, self._check, read_scene, read_rig)

    def serve(self) -> None:
        order: Order = self._connection.recv()
        while True:
            order = self._latest(order)
            complete = True
            if isinstance(order, Request):
                try:
                    complete = self._carry_out(order)
                except SupersededError:
                    order = self._latest(None)
                    continue
            else:
                self._connection.send(Done(order.number))
            order = self._wait(order, complete=complete)

    def _carry_out(self, request: Request) -> bool:
        try:
            return self._calculator.calculate(request, QUIET_S)
        except (EOFError, OSError, SupersededError):
            raise
        except Exception:
            self._connection.send(Broken(request.number, traceback.format_exc()))
            return True

    def _wait(self, order: Order, *, complete: bool) -> Order:
        """Wait for the next order; the last one comes again when the bank may have what it lacked."""
        gone = False
        while not self._connection.poll(LOOKS_EVERY_S):
            if not isinstance(order, Request):
                continue
            try:
                changed = self._calculator.bank_changed(order.bank)
            except (InputError, OSError) as failure:
                if complete:
                    self._connection.send(Failed(order.number, str(failure)))
                    complete = False
                gone = True
                continue
            if gone or (changed and not complete):
                return order
        return self._latest(None)

    def _latest(self, order: Order | None) -> Order:
        while order is None or self._connection.poll():
            order = self._connection.recv()
        return order

    def _check(self, wait_s: float) -> None:
        if self._connection.poll(wait_s):
            raise SupersededError

    def _tell(self, told: Told) -> None:
        if isinstance(told, Progress):
            now_s = time.monotonic()
            if told.share > 0.0 and now_s - self._told_progress_s < _PROGRESS_EVERY_S:
                return
            self._told_progress_s = now_s
        self._connection.send(told)
