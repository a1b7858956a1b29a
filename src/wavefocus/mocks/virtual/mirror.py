"""How a scanning mirror moves, the virtual mirror that moves so, and a virtual shutter."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Mirror, Shutter
from wavefocus.mocks.virtual import NANOSECONDS, VirtualClock
from wavefocus.mocks.virtual.faults import VirtualDevice
from wavefocus.mocks.virtual.settings import VirtualSettings

# What rounding to a device's own units may add to an angle at the limit.
_ROUNDING_MRAD = 0.1


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
    """A mirror's moves: a ramp to the target, then some time until it stands still; safe to ask from several threads.

    park_mrad: Where it stands at first; optical angles in mrad, as all angles here.
    settle_s: Time from its arrival until it stands still, >= 0.
    slew_mrad_s: Speed of the slower axis of a move, > 0; infinite for a mirror that jumps.
    limit_mrad: Largest angle in x and in y, > 0.
    now_ns: The clock of all instants; by default the wall's.
    """

    def __init__(
        self,
        park_mrad: tuple[float, float],
        settle_s: float,
        slew_mrad_s: float,
        limit_mrad: float,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.park_mrad = park_mrad
        self.limit_mrad = limit_mrad
        self._settle_ns = round(settle_s * NANOSECONDS)
        self._slew_mrad_s = slew_mrad_s
        self._now_ns = now_ns
        self._moves = deque([_Move(0, 0, 0, park_mrad, park_mrad)], maxlen=4096)
        self._lock = threading.Lock()

    def start(self, x_mrad: float, y_mrad: float) -> None:
        """Begin a move now, from wherever the mirror looks."""
        with self._lock:
            now_ns = self._now_ns()
            origin = self._moves[-1].at(now_ns)
            way_mrad = max(abs(x_mrad - origin[0]), abs(y_mrad - origin[1]))
            arrived_ns = now_ns + round(way_mrad / self._slew_mrad_s * NANOSECONDS)
            self._moves.append(_Move(now_ns, arrived_ns, arrived_ns + self._settle_ns, origin, (x_mrad, y_mrad)))

    def reaches(self, x_mrad: float, y_mrad: float) -> bool:
        """Whether a target is within the limit, or beyond it by no more than rounding can do."""
        return max(abs(x_mrad), abs(y_mrad)) <= self.limit_mrad + _ROUNDING_MRAD

    def settled_at_ns(self) -> int:
        """When the latest move is over."""
        with self._lock:
            return self._moves[-1].settled_ns

    def busy(self) -> bool:
        """Whether it still moves or swings."""
        return self._now_ns() < self.settled_at_ns()

    def where_mrad(self) -> tuple[float, float]:
        """Where it looks now."""
        with self._lock:
            return self._moves[-1].at(self._now_ns())

    def aims(self, start_ns: int, stop_ns: int) -> list[tuple[int, tuple[float, float] | None]]:
        """Where it looked between two instants.

        Returns list of (instant_ns, angles_mrad): from each instant on, the first being `start_ns`, the mirror stands
        there; None while it moves or swings.
        """
        with self._lock:
            moves = list(self._moves)
        changes: list[tuple[int, tuple[float, float] | None]] = []
        ends_ns = stop_ns
        for move in reversed(moves):
            if max(move.settled_ns, start_ns) < ends_ns:
                changes.append((max(move.settled_ns, start_ns), move.target_mrad))
            if max(move.start_ns, start_ns) < min(move.settled_ns, ends_ns):
                changes.append((max(move.start_ns, start_ns), None))
            ends_ns = min(ends_ns, move.start_ns)
            if ends_ns <= start_ns:
                break
        return changes[::-1]


class VirtualMirror(VirtualDevice, Mirror):
    """Points the virtual laser."""

    def __init__(self, settings: VirtualSettings, clock: VirtualClock) -> None:
        super().__init__("mirror", settings.fault_plan, f"within ±{settings.limit_mrad:g} mrad")
        self._limit_mrad = settings.limit_mrad
        self._clock = clock
        self.motion = MirrorMotion(
            settings.park_mrad, settings.settle_s, settings.slew_mrad_s, settings.limit_mrad, clock.now_ns
        )

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._check_open(doing)
        limit = self._limit_mrad
        if not (abs(x_mrad) <= limit and abs(y_mrad) <= limit):
            raise self._refusal(
                doing, f"beyond the limit of ±{limit:g} mrad", "choose a grid within the mirror's reach"
            )
        self._faults.meet("move_to", doing)
        self.motion.start(float(x_mrad), float(y_mrad))

    def wait_settled(self, timeout_s: float) -> None:
        self._check_open("settling")
        self._faults.meet("wait_settled", "settling")
        settled_ns = self.motion.settled_at_ns()
        latest_ns = self._clock.now_ns() + round(timeout_s * NANOSECONDS)
        self._clock.advance_to_ns(min(settled_ns, latest_ns))
        if settled_ns > latest_ns:
            raise TransientInstrumentError(
                self._name, "settling", f"still moving after {timeout_s:g} s", "allow more time to settle"
            )

    def park(self) -> None:
        self._faults.meet("park", "parking")
        self.motion.start(*self.motion.park_mrad)


class VirtualShutter(VirtualDevice, Shutter):
    """Blocks the virtual beam.

    is_open: Whether it lets the beam through.
    """

    def __init__(self) -> None:
        super().__init__("shutter", (), "closed by default")
        self.is_open = False

    def open_beam(self) -> None:
        self._check_open("opening")
        self.is_open = True

    def block_beam(self) -> None:
        self._check_open("closing")
        self.is_open = False
