"""Pace of a live session: when blocks begin; latencies, priority."""

import math
import os
import sys
import threading
from contextlib import suppress

import numpy as np


class Pace:
    """Chooses when the next block begins, and whether orders wait for it.

    Where computing falls behind, orders wait for one block or two: a computation is enough for three blocks, so that
    computing keeps pace as long as it takes less than the time of them.

    block_s: Time of a block. ahead_s: What is to wait to be played.
    """

    def __init__(self, block_s: float, ahead_s: float) -> None:
        self._block_s, self._ahead_s = block_s, ahead_s
        self._begin_s = -math.inf
        self.short = False
        """Whether little was left to be played at the last block: orders are to wait if a block is there without."""

    def begin_s(self, now_s: float, waiting_s: float) -> float:
        """When the next block begins; in the past where computing is behind.

        now_s: When the block before was taken. waiting_s: How much was still to be played before it.
        """
        # With less of it left to be played, a block that was computed beforehand is played before orders are taken.
        self.short = waiting_s < 0.75 * self._ahead_s
        # Without room the player took it only when there was some.
        full = waiting_s + self._block_s >= self._ahead_s
        earliest_s = now_s if full else now_s - self._ahead_s
        # Blocks begin so many block times apart: an interface asks for a period at a time, and several blocks computed
        # in a burst would leave positions waiting for the next one.
        self._begin_s = max(self._begin_s + 0.95 * self._block_s, earliest_s)
        return self._begin_s


LEAST_MS, MOST_MS = 0.01, 1e7
STEP = 1.01
"""Ratio of neighbouring steps: a percentile is known to 1 %."""


class LatencyHistogram:
    """Counts latencies in steps of 1 %, from 10 us to nearly three hours."""

    def __init__(self) -> None:
        self._counts = np.zeros(math.ceil(math.log(MOST_MS / LEAST_MS, STEP)) + 1, dtype=np.int64)
        self._largest_ms = 0.0
        self._largest_since_ms: float | None = None

    def add(self, latency_s: float) -> None:
        """Count one."""
        latency_ms = 1e3 * latency_s
        step = math.ceil(math.log(max(latency_ms / LEAST_MS, 1.0), STEP))
        self._counts[min(step, len(self._counts) - 1)] += 1
        self._largest_ms = max(self._largest_ms, latency_ms)
        before = self._largest_since_ms
        self._largest_since_ms = latency_ms if before is None else max(before, latency_ms)

    def take_largest_ms(self) -> float | None:
        """Largest since this was last asked; None where there was none."""
        largest_ms, self._largest_since_ms = self._largest_since_ms, None
        return largest_ms

    def percentile_ms(self, percent: float) -> float | None:
        """A percentile of all, rounded up to a whole step, at most the largest; None where there are none."""
        running = np.cumsum(self._counts)
        if not running[-1]:
            return None
        step = int(np.searchsorted(running, percent / 100 * running[-1]))
        return float(min(LEAST_MS * STEP**step, self._largest_ms))


_HIGH_PRIORITY_CLASS = 0x80


def raise_priority(*others: threading.Thread) -> None:
    """Let this thread, and threads and processes that it starts from now on, run before other programs, if it may.

    others: Threads of this process that do so too. One that holds Python's lock holds up this one for as long as
        other programs run in its place.

    On Linux by a real-time priority, which a limit (``rtprio`` in /etc/security/limits.d, as audio servers ask for it)
    or root allows; on Windows by the high priority class; elsewhere not at all.
    """
    if sys.platform == "linux":
        for thread in (threading.current_thread(), *others):
            with suppress(OSError):
                # The lowest of the real-time priorities: audio servers stay above.
                os.sched_setscheduler(thread.native_id or 0, os.SCHED_RR, os.sched_param(1))
    elif sys.platform == "win32":
        import ctypes

        kernel = ctypes.windll.kernel32
        kernel.SetPriorityClass(kernel.GetCurrentProcess(), _HIGH_PRIORITY_CLASS)
