"""The calls to one instrument, in a thread of their own: a call that hangs is given up, not waited for."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import TypeVar

Answer = TypeVar("Answer")

# No lock is woken by a signal on Windows; this often Python gets to look for one there.
SLICE_S = 0.25


class HungError(Exception):
    """A call did not return in its time and was given up."""


class Lane:
    """Carries out calls one after another in one thread, each for so long and no longer.

    A thread whose call hangs is abandoned: it is a daemon, so that it holds up no exit, and the next call
    gets a fresh thread. What an abandoned call returns in the end is of no interest to anybody.

    Parameters
    ----------
    name : str
        Of the threads.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: _Thread | None = None
        self._under_way: _Call | None = None

    def call(
        self, ask: Callable[[], Answer], limit_s: float, *, yields_s: float | None = None, anyhow: bool = False
    ) -> Answer:
        """Carry out one call and wait for its end.

        Parameters
        ----------
        ask : callable
            The call.
        limit_s : float
            Longest wait on the wall's clock, > 0.
        yields_s : float, optional
            How long a call before this one, whose wait was broken off by a signal, may still take; `limit_s`, if
            absent. With 0 this call overtakes it, which its instrument must be made for.
        anyhow : bool
            Where no thread can be started, carry the call out in this one, without a limit: to fall silent.

        Returns
        -------
        object
            What the call returned.

        Raises
        ------
        HungError
            It did not return in time.
        RuntimeError
            No thread can be started.
        BaseException
            Whatever it raised.
        """
        before = self._under_way
        if before is not None:
            before.wait(limit_s if yields_s is None else yields_s)
            if not before.over:
                self.abandon()
        if self._thread is None:
            try:
                self._thread = _Thread(self._name)
            except (RuntimeError, MemoryError):
                if not anyhow:
                    raise
                return ask()
        call = self._under_way = _Call(ask)
        self._thread.calls.put(call)
        # Left set when a signal breaks the wait off: the thread is then still at it.
        if not call.wait(limit_s):
            self.abandon()
            raise HungError
        self._under_way = None
        if call.failure is not None:
            try:
                raise call.failure
            finally:
                call.failure = None  # its traceback holds this frame, and this frame the call
        answer: Answer = call.answer  # type: ignore[assignment]
        return answer

    def abandon(self) -> None:
        """Let the present thread end by itself, now or never."""
        if self._thread is not None:
            self._thread.calls.put(None)
        self._thread = self._under_way = None


class _Call:
    def __init__(self, ask: Callable[[], object]) -> None:
        self._ask = ask
        self._waiting = threading.Lock()
        self._waiting.acquire()
        self.answer: object = None
        self.failure: BaseException | None = None
        self.over = False

    def run(self) -> None:
        try:
            self.answer = self._ask()
        except BaseException as failure:  # raised again where the answer is waited for
            self.failure = failure
        self.over = True
        self._waiting.release()

    def wait(self, limit_s: float) -> bool:
        """Whether the call came to its end within `limit_s`."""
        if self._waiting.acquire(timeout=min(max(0.0, limit_s), SLICE_S)):
            return True
        until_s = time.monotonic() + limit_s - SLICE_S
        while (left_s := until_s - time.monotonic()) > 0:
            if self._waiting.acquire(timeout=min(left_s, SLICE_S)):
                return True
        return self.over


class _Thread:
    def __init__(self, name: str) -> None:
        self.calls: SimpleQueue[_Call | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def _run(self) -> None:
        while (call := self.calls.get()) is not None:
            call.run()
            del call  # what it returned may be large, and the next call may be long in coming
