"""A clock that stands still until someone waits."""

from __future__ import annotations

import threading
import time

NANOSECONDS = 1_000_000_000


class VirtualClock:
    """Virtual time in whole nanoseconds, so that differences do not depend on the hour.

    Parameters
    ----------
    realtime : bool
        Let the wall's clock keep pace: a wait of one virtual second lasts one second.
    """

    def __init__(self, *, realtime: bool = False) -> None:
        self._now_ns = 0
        self._lock = threading.Lock()
        self._wall_start_ns = time.monotonic_ns() if realtime else None

    def now_s(self) -> float:
        """Virtual seconds since the clock was made."""
        return self.now_ns() / NANOSECONDS

    def now_ns(self) -> int:
        """Virtual nanoseconds since the clock was made."""
        with self._lock:
            return self._now_ns

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of virtual time pass; a negative time is none."""
        with self._lock:
            self._now_ns += max(0, round(seconds * NANOSECONDS))
            target_ns = self._now_ns
        self._keep_pace(target_ns)

    def advance_to_ns(self, instant_ns: int) -> None:
        """Let time pass until `instant_ns`, if that lies ahead."""
        with self._lock:
            self._now_ns = max(self._now_ns, instant_ns)
        self._keep_pace(instant_ns)

    def _keep_pace(self, instant_ns: int) -> None:
        if self._wall_start_ns is None:
            return
        ahead_ns = self._wall_start_ns + instant_ns - time.monotonic_ns()
        if ahead_ns > 0:
            time.sleep(ahead_ns / NANOSECONDS)
