"""Faults on the wire, on order: which emulated instrument, which call or time, which fault."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wavefocus.config.emulation import WireFault

_ANY = "any"


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
