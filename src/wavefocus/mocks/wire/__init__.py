"""Faults on the wire, on order: which emulated instrument, which call or time, which fault."""

import threading
import time
from collections import Counter
from dataclasses import dataclass

_KINDS = {
    "mirror": ("silent", "late", "truncated", "garbled", "stalled", "refused", "unplugged", "impostor", "restarted"),
    "vibrometer": ("silent", "late", "truncated", "garbled", "stalled", "refused", "unplugged", "impostor"),
    "recorder": (
        "overwritten",
        "read_timeout",
        "unplugged",
        "absent",
        "wrong_name",
        "in_use",
        "usb_aborted",
        "wait_timeout",
        "unknown_code",
        "silent",
        "server_dead",
        "short_read",
        "missing_reference",
        "over_range",
        "warning",
        "internal",
        "exhausted",
    ),
    "player": ("underflow", "lost", "frozen"),
}
_ANY = "any"


@dataclass(frozen=True, slots=True)
class WireFault:
    """One entry of a wire's fault plan. Raises ValueError.

    role: Whose emulated instrument: a key of `_KINDS`.
    kind: What happens: one of `_KINDS[role]`.
    operation: The call that meets it: the verb of a serial dialect (``"identify"``, ``"move"``, ``"busy"``,
        ``"where"``...), the name of a remote procedure (``"ReadAnalogF64"``), ``"period"`` of an audio server, or
        ``"any"``.
    at_call: The first call of the operation that meets it, from 1.
    at_s: In its place: the first call this many seconds after the emulated instrument's start.
    count: How many calls in a row, > 0.
    seconds: How long a late answer is late, or a device stays unplugged, >= 0; 0 for good where it is unplugged.
    """

    role: str
    kind: str
    operation: str = _ANY
    at_call: int | None = None
    at_s: float | None = None
    count: int = 1
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if self.role not in _KINDS:
            raise ValueError(f"fault role is {self.role!r}; allowed: {', '.join(_KINDS)}")
        if self.kind not in _KINDS[self.role]:
            allowed = ", ".join(_KINDS[self.role])
            raise ValueError(f"fault kind of the {self.role} is {self.kind!r}; allowed: {allowed}")
        if (self.at_call is None) == (self.at_s is None):
            raise ValueError("a fault needs either at_call or at_s")
        if self.count < 1 or (self.at_call is not None and self.at_call < 1):
            raise ValueError(f"fault at_call is {self.at_call}, count {self.count}; both start at 1")
        if self.seconds < 0 or (self.at_s is not None and self.at_s < 0):
            raise ValueError(f"fault at_s is {self.at_s}, seconds {self.seconds}; neither may be negative")


class WireFaultPlan:
    """The faults that one emulated instrument has before it; safe to ask from several threads.

    faults: The plan of the whole rig.
    """

    def __init__(self, role: str, faults: tuple[WireFault, ...] = ()) -> None:
        self._faults = tuple(fault for fault in faults if fault.role == role)
        self._calls: Counter[str] = Counter()
        self._struck: Counter[int] = Counter()
        self._started_s = time.monotonic()
        self._lock = threading.Lock()

    def due(self, operation: str) -> tuple[WireFault, ...]:
        """Count a call of an operation and return the faults that it meets."""
        with self._lock:
            self._calls[operation] += 1
            self._calls[_ANY] += 1
            elapsed_s = time.monotonic() - self._started_s
            due = []
            for index, fault in enumerate(self._faults):
                if fault.operation not in (_ANY, operation) or self._struck[index] >= fault.count:
                    continue
                call = self._calls[fault.operation]
                reached = call >= fault.at_call if fault.at_call is not None else elapsed_s >= (fault.at_s or 0.0)
                if reached:
                    self._struck[index] += 1
                    due.append(fault)
            return tuple(due)
