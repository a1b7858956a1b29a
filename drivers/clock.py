"""The wall's clock, as instruments live by it."""

from __future__ import annotations

import time


class WallClock:
    """Real time; implements `drivers.protocols.Clock`."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start, from a clock that nobody sets."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` pass; a negative time is none."""
        time.sleep(max(0.0, seconds))
