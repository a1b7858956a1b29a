"""How a scanning mirror moves: a ramp to the target, then some time until it stands still."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from dataclasses import dataclass

from mocks.virtual.mirror import stood_between

NANOSECONDS = 1_000_000_000
KEPT_MOVES = 4096
# What rounding to a device's own units may add to an angle at the limit.
ROUNDING_MRAD = 0.1


@dataclass(frozen=True, slots=True)
class _Move:
    start_ns: int
    arrived_ns: int
    settled_ns: int
    origin_mrad: tuple[float, float]
    target_mrad: tuple[float, float]

    def at(self, instant_ns: int) -> tuple[float, float]:
        """Where the mirror looks at an instant after the move began; the swinging at its end is left out."""
        if instant_ns >= self.arrived_ns:
            return self.target_mrad
        part = (instant_ns - self.start_ns) / (self.arrived_ns - self.start_ns)
        (x0, y0), (x1, y1) = self.origin_mrad, self.target_mrad
        return x0 + part * (x1 - x0), y0 + part * (y1 - y0)


class MirrorMotion:
    """A mirror's moves; safe to ask from several threads. All instants are of `time.monotonic_ns`.

    park_mrad: Where it stands at first; optical angles in mrad, as all angles here.
    settle_s: Time from its arrival until it stands still, >= 0.
    slew_mrad_s: Speed of the slower axis of a move, > 0; infinite for a mirror that jumps.
    limit_mrad: Largest angle in x and in y, > 0.
    """

    def __init__(self, park_mrad: tuple[float, float], settle_s: float, slew_mrad_s: float, limit_mrad: float) -> None:
        self.park_mrad = park_mrad
        self.limit_mrad = limit_mrad
        self._settle_ns = round(settle_s * NANOSECONDS)
        self._slew_mrad_s = slew_mrad_s
        self._moves = deque([_Move(0, 0, 0, park_mrad, park_mrad)], maxlen=KEPT_MOVES)
        self._lock = threading.Lock()

    def start(self, x_mrad: float, y_mrad: float) -> None:
        """Begin a move now, from wherever the mirror looks. Raises ValueError."""
        if not self.reaches(x_mrad, y_mrad):
            raise ValueError(f"({x_mrad:g}, {y_mrad:g}) mrad is beyond +-{self.limit_mrad:g} mrad")
        with self._lock:
            now_ns = time.monotonic_ns()
            origin = self._moves[-1].at(now_ns)
            way_mrad = max(abs(x_mrad - origin[0]), abs(y_mrad - origin[1]))
            arrived_ns = now_ns + round(way_mrad / self._slew_mrad_s * NANOSECONDS)
            self._moves.append(_Move(now_ns, arrived_ns, arrived_ns + self._settle_ns, origin, (x_mrad, y_mrad)))

    def reaches(self, x_mrad: float, y_mrad: float) -> bool:
        """Whether a target is within the limit, or beyond it by no more than rounding can do."""
        return max(abs(x_mrad), abs(y_mrad)) <= self.limit_mrad + ROUNDING_MRAD

    def settled_at_ns(self) -> int:
        """When the latest move is over."""
        with self._lock:
            return self._moves[-1].settled_ns

    def busy(self) -> bool:
        """Whether it still moves or swings."""
        return time.monotonic_ns() < self.settled_at_ns()

    def where_mrad(self) -> tuple[float, float]:
        """Where it looks now."""
        with self._lock:
            return self._moves[-1].at(time.monotonic_ns())

    def aims(self, start_ns: int, stop_ns: int) -> list[tuple[int, tuple[float, float] | None]]:
        """Where it looked between two instants.

        Returns list of (instant_ns, angles_mrad): from each instant on, the first being `start_ns`, the mirror stands
        there; None while it moves or swings.
        """
        with self._lock:
            moves = list(self._moves)
        return stood_between(moves, start_ns, stop_ns, lambda move: move.target_mrad)


NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")


def number(text: str | None) -> float | None:
    """The number that a text is, or None."""
    return float(text) if text is not None and NUMBER.fullmatch(text) else None
