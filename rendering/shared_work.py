"""Work shared out to threads of which the calling one is the first, so that it never waits for one to wake up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from rendering.threads import WORKERS, workers

Item = TypeVar("Item")


def share_out(items: Sequence[Item], task: Callable[[Item], None]) -> None:
    """Do a task for each of some items, begun in their order; an error in one stops the rest and is raised.

    Parameters
    ----------
    items : sequence
        What is to be done.
    task : callable
        Does one; called by `WORKERS` threads, the calling one among them.
    """
    # The iterator of a tuple gives each item to one thread only.
    left = iter(tuple(items))
    errors: list[BaseException] = []

    def work() -> None:
        try:
            for item in left:
                if errors:
                    return
                task(item)
        except BaseException as error:  # raised in the calling thread, below
            errors.append(error)

    with workers() as threads:
        for _ in range(min(WORKERS, len(items)) - 1):
            threads.submit(work)
        work()
    if errors:
        raise errors[0]


def shares(count: int) -> list[slice]:
    """Slices of 0 to count - 1, one for each thread; fewer where there are fewer numbers."""
    each = max(1, -(-count // WORKERS))
    return [slice(first, min(first + each, count)) for first in range(0, count, each)]
