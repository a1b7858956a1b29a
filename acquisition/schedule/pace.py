"""How long the rest of a session will take, from how long its latest positions took."""

from __future__ import annotations

from collections import deque
from statistics import median

# Recent enough to follow a rig that slows down, long enough that a few slow positions do not move the finish.
LATEST = 30


class Pace:
    """Learns from every attempt; one clock per instance.

    The median of the latest attempts says how long one takes, so that single long ones (an audio server that stumbled)
    do not move it. How many attempts a position takes is their mean over as many positions: repeats are rare and
    cost time all the same. Outages are not counted, for `working_s` stands still meanwhile.

    working_s: What the clock says at the beginning.
    """

    def __init__(self, working_s: float) -> None:
        self._last_s = working_s
        self._attempt_s: deque[float] = deque(maxlen=LATEST)
        self._attempts_of: deque[int] = deque(maxlen=LATEST)
        self._sentinel_s: deque[float] = deque(maxlen=LATEST)

    def attempt_done(self, working_s: float) -> None:
        """An attempt had all its records at `working_s`."""
        self._attempt_s.append(working_s - self._last_s)
        self._last_s = working_s

    def sentinel_done(self, working_s: float) -> None:
        """A measurement of the sentinel position came to its end."""
        self._sentinel_s.append(working_s - self._last_s)
        self._last_s = working_s

    def position_settled(self, attempts: int) -> None:
        """A position is done with, after so many attempts in this session."""
        self._attempts_of.append(attempts)

    @property
    def position_s(self) -> float:
        """Seconds that a position takes, its expected repeats included; 0 before the first."""
        if not self._attempt_s:
            return 0.0
        attempts = sum(self._attempts_of) / len(self._attempts_of) if self._attempts_of else 1.0
        return median(self._attempt_s) * max(1.0, attempts)

    def remaining_s(self, positions: int, sentinel_passes: int, working_s: float | None = None) -> float:
        """Seconds for so many positions and measurements of the sentinel.

        positions: Positions not begun yet.
        sentinel_passes: Measurements of the sentinel to come.
        working_s: What the clock says, where one more position is being recorded: what that still takes counts, too.
        """
        under_way_s = 0.0 if working_s is None else max(0.0, self.position_s - (working_s - self._last_s))
        # Before the first, a sentinel is taken for a position like any other.
        sentinel_s = median(self._sentinel_s) if self._sentinel_s else self.position_s
        return under_way_s + positions * self.position_s + sentinel_passes * sentinel_s
