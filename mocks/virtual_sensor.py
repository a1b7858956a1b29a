"""A sensor whose value follows a course given beforehand."""

from __future__ import annotations

import numpy as np

from mocks.clocks import VirtualClock


class VirtualSensor:
    """Reads a course on the rig's clock.

    Parameters
    ----------
    clock : VirtualClock
        The time.
    course : tuple of (float, float)
        Instants in s, rising, and the values then; in between it changes evenly, before and after it stays.
    """

    def __init__(self, clock: VirtualClock, course: tuple[tuple[float, float], ...]) -> None:
        self._clock = clock
        self._instants, self._values = np.array(course, dtype=np.float64).T

    def read(self) -> float:
        """The value now."""
        return float(np.interp(self._clock.now_s(), self._instants, self._values))
