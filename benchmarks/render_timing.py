"""Timing side by side: methods take turns, so that what else the machine does meets them all alike."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Timing:
    """Best of some runs.

    Parameters
    ----------
    wall_s, cpu_s : float
        Least time on the wall, and least CPU time of all threads together; not necessarily of the same run.
    result : object
        What the last run returned.
    """

    wall_s: float
    cpu_s: float
    result: Any

    def times(self, factor: float) -> Timing:
        """The time of so much more of the same work."""
        return replace(self, wall_s=self.wall_s * factor, cpu_s=self.cpu_s * factor)


@dataclass(frozen=True, slots=True)
class Mark:
    """What a figure should reach.

    Parameters
    ----------
    figure : str
        "times": times faster than the peer. Otherwise a figure that is given here.
    value : float
        The mark.
    at_most : bool
        Whether the figure is to stay below it.
    measured : float, optional
        The figure, where it is not "times".
    """

    figure: str
    value: float
    at_most: bool = False
    measured: float | None = None

    def met(self, result: Result) -> bool:
        """Whether a result reaches the mark; by wall time where both are timed."""
        figure = result.times if self.measured is None else self.measured
        return figure is not None and (figure <= self.value if self.at_most else figure >= self.value)

    def told(self, result: Result) -> str:
        """The mark in words."""
        wanted = f"at {'most' if self.at_most else 'least'} {self.value:g}"
        return f"  [mark: {self.figure} {wanted}: {'met' if self.met(result) else 'NOT met'}]"


@dataclass(frozen=True, slots=True)
class Result:
    """One line of the table.

    Parameters
    ----------
    work, method : str
        What was done, and how.
    wall_s, cpu_s : float
        Best of the repeats.
    error : float or None
        Relative L2 error, None for the reference itself and for the floor.
    times, cpu_times : float or None
        How many times faster than the method that the work names as its peer: its wall or CPU time, whichever is
        less, over our wall time; and by CPU time.
    remark : str
        What a reader must know to judge the figure.
    mark : Mark, optional
        What it should reach.
    """

    work: str
    method: str
    wall_s: float
    cpu_s: float
    error: float | None
    times: float | None
    cpu_times: float | None
    remark: str = ""
    mark: Mark | None = None

    @classmethod
    def of(
        cls,
        work: str,
        method: str,
        timing: Timing,
        peer: Timing,
        *,
        error: float | None = None,
        remark: str = "",
        mark: Mark | None = None,
    ) -> Result:
        """A line of a timing beside its peer's."""
        # A peer that others kept from the cores was not slow: it counts no more than its CPU time.
        times = min(peer.wall_s, peer.cpu_s) / timing.wall_s
        cpu_times = peer.cpu_s / max(timing.cpu_s, 1e-9)
        return cls(work, method, timing.wall_s, timing.cpu_s, error, times, cpu_times, remark, mark)


def best_of(
    actions: dict[str, Callable[[], Any]], repeats: int, *, once: tuple[str, ...] = (), slow_s: float = 2.0
) -> dict[str, Timing]:
    """Run actions in turns and keep the best time of each."""
    best: dict[str, Timing] = {}
    for turn in range(repeats):
        for name, action in actions.items():
            known = best.get(name)
            if known is not None and (name in once or (known.wall_s > slow_s and turn % 3)):
                continue
            wall, cpu = time.perf_counter(), time.process_time()
            result = action()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            if known is not None:
                wall, cpu = min(wall, known.wall_s), min(cpu, known.cpu_s)
            best[name] = Timing(wall, cpu, result)
    return best


def relative_error(found: NDArray[Any], expected: NDArray[Any]) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
