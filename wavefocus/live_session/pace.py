"""Effort by load: a session that falls behind leaves out bins, then sources, and takes them back when it can."""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Literal

from config.messages.live import Degradation
from rendering.live.engine import Effort

BOUNDS_DB = (None, -30.0, -20.0)
"""Proved bounds on the relative error from bins left out, in the order in which they are given up. On the soft plate
the error itself is at most -54 and -44 dB, and a block of four fast sources takes 0.6 and 0.55 of its time; within
-60 dB next to no bin can be left out."""
BUSY, CALM = 0.8, 0.5
"""Share of a block's time above which computing it counts as too slow, and below which there is time to spare."""
LOOKED_AT = 5
LAG_SHARE = 1 / 3
"""A lag of so large a share of what waits to be played is no chance of the machine's scheduler."""
CALM_S, MOST_CALM_S = 2.0, 60.0
RELAPSE_S = 10.0
Change = Literal["slower", "faster"]


class Pace:
    """Chooses the effort from the time that each block took.

    It steps down when computing has fallen behind by a third of what waits to be played and most of the latest blocks
    were slow: first bins within -30 dB, then within -20 dB, then the latest source, one after the other. It steps up
    when blocks took less than half of their time for 2 s; for twice as long after each relapse, up to a minute.

    block_s: Time of a block. ahead_s: What waits to be played.
    """

    def __init__(self, block_s: float, ahead_s: float) -> None:
        self._block_s, self._ahead_s = block_s, ahead_s
        self._bound, self._most_sources = 0, None
        self._latest: deque[float] = deque(maxlen=LOOKED_AT)
        self._behind_s = self._calm_s = 0.0
        self._needed_s, self._since_faster_s = CALM_S, RELAPSE_S

    _most_sources: int | None

    @property
    def effort(self) -> Effort:
        """The effort now."""
        return Effort(BOUNDS_DB[self._bound], self._most_sources)

    @property
    def degradation(self) -> Degradation:
        """The last kind of thing that is left out."""
        return "sources" if self._most_sources is not None else "bins" if self._bound else "none"

    def add(self, computed_s: float, sources: int) -> Change | None:
        """Note what a block took, and how many sources there are; returns how the effort has changed."""
        self._latest.append(computed_s)
        self._since_faster_s += self._block_s
        self._behind_s = max(0.0, self._behind_s + computed_s - self._block_s)
        self._calm_s = self._calm_s + self._block_s if computed_s < CALM * self._block_s else 0.0
        slow = len(self._latest) == LOOKED_AT and median(self._latest) > BUSY * self._block_s
        if slow and self._behind_s > LAG_SHARE * self._ahead_s:
            return "slower" if self.slower(sources) else None
        return "faster" if self._calm_s >= self._needed_s and self._faster(sources) else None

    def slower(self, sources: int) -> bool:
        """Step down; returns whether there was a step left."""
        if self._since_faster_s < RELAPSE_S:
            self._needed_s = min(2 * self._needed_s, MOST_CALM_S)
        self._start_anew()
        if self._bound < len(BOUNDS_DB) - 1:
            self._bound += 1
            return True
        most = sources if self._most_sources is None else min(self._most_sources, sources)
        if most <= 1:
            return False
        self._most_sources = most - 1
        return True

    def _faster(self, sources: int) -> bool:
        self._start_anew()
        if self._most_sources is not None:
            self._most_sources = self._most_sources + 1 if self._most_sources + 1 < sources else None
        elif self._bound:
            self._bound -= 1
        else:
            self._needed_s = CALM_S
            return False
        self._since_faster_s = 0.0
        return True

    def _start_anew(self) -> None:
        self._latest.clear()
        self._behind_s = self._calm_s = 0.0
