"""Sources by load: a session that falls behind leaves out the latest ones, and takes them back when it can."""

from __future__ import annotations

from collections import deque
from typing import Literal

BUSY = 0.8
"""Share of a block's time above which computing it counts as too slow."""
LOOKED_AT = 10
LEFT_SHARE = 0.4
"""With less of it left to be played, computing has fallen behind."""
CALM_S, MAX_CALM_S = 2.0, 60.0
RELAPSE_S = 10.0
Change = Literal["slower", "faster"]


class Pace:
    """Chooses how many sources sound from the time that each block took.

    It steps down when less than 0.4 of what is to wait is left to be played and the latest blocks were slow on average:
    the latest source is left out, then the one before it; one remains. It steps up when at least as much was left for
    2 s; for twice as long after each relapse, up to a minute.

    block_s: Time of a block. ahead_s: What is to wait to be played.
    """

    def __init__(self, block_s: float, ahead_s: float) -> None:
        self._block_s, self._ahead_s = block_s, ahead_s
        self.most_sources: int | None = None
        """Sources that may sound; None: all."""
        self._latest: deque[float] = deque(maxlen=LOOKED_AT)
        self._calm_s, self._filled = 0.0, False
        self._needed_s, self._since_faster_s = CALM_S, RELAPSE_S

    def add(self, computed_s: float, waiting_s: float, sources: int) -> Change | None:
        """Note a block: what it took, how much was still to be played when it was written, and the number of sources.

        Returns how that number has changed.
        """
        self._latest.append(computed_s)
        self._since_faster_s += self._block_s
        # Not half: blocks are paced so that about half waits, and it would be calm at no time.
        plenty = waiting_s >= LEFT_SHARE * self._ahead_s
        self._filled |= plenty
        self._calm_s = self._calm_s + self._block_s if plenty else 0.0
        # Without the longest: one stall of the machine is not slow computing.
        typical_s = (sum(self._latest) - max(self._latest)) / (LOOKED_AT - 1)
        slow = len(self._latest) == LOOKED_AT and typical_s > BUSY * self._block_s
        if slow and self._filled and waiting_s < LEFT_SHARE * self._ahead_s:
            return "slower" if self.slower(sources) else None
        return "faster" if self._calm_s >= self._needed_s and self._faster(sources) else None

    def slower(self, sources: int) -> bool:
        """Step down; returns whether there was a step left."""
        if self._since_faster_s < RELAPSE_S:
            self._needed_s = min(2 * self._needed_s, MAX_CALM_S)
        self._start_anew()
        most = sources if self.most_sources is None else min(self.most_sources, sources)
        if most <= 1:
            return False
        self.most_sources = most - 1
        return True

    def _faster(self, sources: int) -> bool:
        self._start_anew()
        if self.most_sources is None:
            self._needed_s = CALM_S
            return False
        self.most_sources = self.most_sources + 1 if self.most_sources + 1 < sources else None
        self._since_faster_s = 0.0
        return True

    def _start_anew(self) -> None:
        self._latest.clear()
        self._calm_s, self._filled = 0.0, False
