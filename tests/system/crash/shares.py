"""Which trials of a list are gone through, and by which of several workers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Share:
    """Share `index` of `of`, of `count` trials in all.

    count: Trials wanted of all shares together.
    index, of: Which share of how many.
    """

    count: int
    index: int = 0
    of: int = 1

    @property
    def mine(self) -> int:
        """Trials of this share."""
        return -(-self.count // self.of)

    def evenly(self, found: Iterable[T], total: int) -> Iterator[T]:
        """Choose among `total` things, the same for every share, evenly from the first to the last."""
        chosen = 0
        for place, one in enumerate(found):
            if place * self.count // total == (place - 1) * self.count // total and self.count < total and place:
                continue
            if chosen % self.of == self.index:
                yield one
            chosen += 1
