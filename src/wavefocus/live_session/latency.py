"""Latencies counted in constant memory."""

from __future__ import annotations

import numpy as np

STEP_MS = 0.05
MAX_MS = 1000.0


class LatencyHistogram:
    """Counts latencies in steps of `STEP_MS`; what is beyond `MAX_MS` counts as that."""

    def __init__(self) -> None:
        self._counts = np.zeros(round(MAX_MS / STEP_MS) + 1, dtype=np.int64)
        self._largest_ms: float | None = None

    def add(self, latency_s: float) -> None:
        """Count one."""
        latency_ms = 1e3 * latency_s
        self._counts[min(int(latency_ms / STEP_MS), len(self._counts) - 1)] += 1
        self._largest_ms = latency_ms if self._largest_ms is None else max(self._largest_ms, latency_ms)

    def take_largest_ms(self) -> float | None:
        """Largest since this was last asked; None where there was none."""
        largest_ms, self._largest_ms = self._largest_ms, None
        return largest_ms

    def percentile_ms(self, percent: float) -> float | None:
        """A percentile of all, rounded up to a whole step; None where there are none."""
        running = np.cumsum(self._counts)
        if not running[-1]:
            return None
        return float(STEP_MS * (1 + np.searchsorted(running, percent / 100 * running[-1])))
