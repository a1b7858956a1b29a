"""Where a mirror stood between two instants, from its moves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar


class Move(Protocol):
    """A move, with the swinging at its end."""

    @property
    def start_ns(self) -> int:
        """When it began."""
        ...

    @property
    def settled_ns(self) -> int:
        """When the mirror stood."""
        ...


SomeMove = TypeVar("SomeMove", bound=Move)
Place = TypeVar("Place")


def stood_between(
    moves: Sequence[SomeMove], start_ns: int, stop_ns: int, where: Callable[[SomeMove], Place]
) -> list[tuple[int, Place | None]]:
    """Where the mirror stood between two instants.

    Parameters
    ----------
    moves : sequence of Move
        In the order of time.
    start_ns, stop_ns : int
        The instants.
    where : callable
        The place at which a move ends.

    Returns
    -------
    list of (instant_ns, place)
        From each instant on, the first being `start_ns`, it stands there; None while it moves or swings.
    """
    changes: list[tuple[int, Place | None]] = []
    ends_ns = stop_ns
    for move in reversed(moves):
        if max(move.settled_ns, start_ns) < ends_ns:
            changes.append((max(move.settled_ns, start_ns), where(move)))
        if max(move.start_ns, start_ns) < min(move.settled_ns, ends_ns):
            changes.append((max(move.start_ns, start_ns), None))
        ends_ns = min(ends_ns, move.start_ns)
        if ends_ns <= start_ns:
            break
    return changes[::-1]
