"""Latencies counted in constant memory."""

import math

import numpy as np

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
