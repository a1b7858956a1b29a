"""A mirror that takes its time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.protocols import DeviceIdentity
from mocks.virtual.faults import FaultPlan
from mocks.virtual.settings import VirtualSettings
from mocks.virtual.surroundings import NANOSECONDS, VirtualClock


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

    Returns list of (instant_ns, place): from each instant on, the first being `start_ns`, it stands there; None while
    it moves or swings.
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


NAME = "virtual mirror"


@dataclass(frozen=True, slots=True)
class _Move:
    start_ns: int
    settled_ns: int
    target_mrad: tuple[float, float]
    place_mm: tuple[float, float] | None


class VirtualMirror:
    """Points the virtual laser; implements `drivers.protocols.Mirror`."""

    def __init__(self, settings: VirtualSettings, clock: VirtualClock) -> None:
        self._settings = settings
        self._clock = clock
        self._faults = FaultPlan("mirror", NAME, settings.fault_plan)
        self._moves = deque([self._move(0, 0, settings.park_mrad)], maxlen=64)
        self._closed = False
        self._lock = threading.Lock()

    @property
    def identity(self) -> DeviceIdentity:
        """Who it is: the same in every run."""
        return DeviceIdentity("wavefocus", NAME)

    def identify(self) -> str:
        """Name of the device."""
        self._check_open("identifying")
        self._faults.meet("identify", "identifying")
        return f"{NAME}, within +-{self._settings.limit_mrad:g} mrad"

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        """Start a move; angles in mrad, each within the limit."""
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._check_open(doing)
        limit = self._settings.limit_mrad
        if not (abs(x_mrad) <= limit and abs(y_mrad) <= limit):
            cause = f"beyond the limit of +-{limit:g} mrad"
            raise InstrumentError(NAME, doing, cause, "choose a grid within the mirror's reach")
        self._faults.meet("move_to", doing)
        self._start((float(x_mrad), float(y_mrad)))

    def wait_settled(self, timeout_s: float) -> None:
        """Return when the beam stands still, at the latest after `timeout_s`."""
        self._check_open("settling")
        self._faults.meet("wait_settled", "settling")
        with self._lock:
            settled_ns = self._moves[-1].settled_ns
        latest_ns = self._clock.now_ns() + round(timeout_s * NANOSECONDS)
        self._clock.advance_to_ns(min(settled_ns, latest_ns))
        if settled_ns > latest_ns:
            raise TransientInstrumentError(
                NAME, "settling", f"still moving after {timeout_s:g} s", "allow more time to settle"
            )

    def park(self) -> None:
        """Move to the safe direction, from any state."""
        self._faults.meet("park", "parking")
        self._start(self._settings.park_mrad)

    def reconnect(self) -> None:
        """Open the device afresh."""
        self._check_open("reconnecting")
        self._faults.meet("reconnect", "reconnecting")

    def close(self) -> None:
        """Release the device; twice does no harm."""
        self._closed = True

    def places_mm(self, start_ns: int, stop_ns: int) -> list[tuple[int, tuple[float, float] | None]]:
        """Where the laser met the surface between two instants.

        Returns list of (instant_ns, place_mm): from each instant on the laser is at that place; None while it moves or
        misses the surface.
        """
        with self._lock:
            moves = list(self._moves)
        return stood_between(moves, start_ns, stop_ns, lambda move: move.place_mm)

    def _move(self, start_ns: int, settled_ns: int, target_mrad: tuple[float, float]) -> _Move:
        spot_mm = self._settings.mirror.spot_mm(*target_mrad)
        on_surface = bool(self._settings.outline.contains(spot_mm))
        return _Move(start_ns, settled_ns, target_mrad, spot_mm if on_surface else None)

    def _start(self, target_mrad: tuple[float, float]) -> None:
        now_ns = self._clock.now_ns()
        with self._lock:
            origin = self._moves[-1].target_mrad
            way = max(abs(target_mrad[0] - origin[0]), abs(target_mrad[1] - origin[1]))
            taken_s = self._settings.settle_s + way / self._settings.slew_mrad_s
            self._moves.append(self._move(now_ns, now_ns + round(taken_s * NANOSECONDS), target_mrad))

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(NAME, doing, "it is closed", "open the rig again")
