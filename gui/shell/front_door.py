"""Services that the command line gives the window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint
    from rendering.drive.coil_limits import DriveLimits


@dataclass(frozen=True, slots=True)
class Pulse:
    """Latest heartbeat of a capture; `silent` when it is overdue."""

    at: datetime
    pid: int
    state: str
    reason: str
    position: int | None
    silent: bool


@dataclass(frozen=True, slots=True)
class RigLimits:
    """Limits of a rig's actuators; the coils' resistance where the rig file has it."""

    drive: DriveLimits
    actuators: int
    coil_resistance_ohm: float | None


@dataclass(frozen=True, slots=True)
class FrontDoor:
    """Services of the command line.

    Parameters
    ----------
    command : sequence of str
        Starts the command line in a separate process; arguments follow.
    log_path, raw_path, said_path : callable
        From a bank to its event log, its raw recordings, and the standard error of a capture that a window started.
    read_drift : callable
        From a bank to its drift history, oldest first.
    session_failure : callable
        From a bank and an instant to the failure of the session that ended last, as of `SessionEnded`; empty where
        none has ended since.
    read_pulse : callable
        From a bank to its latest heartbeat; None where there is none.
    read_rig_limits : callable
        From a rig file, or ``virtual``, to its limits.
    """

    command: Sequence[str]
    log_path: Callable[[Path], Path]
    raw_path: Callable[[Path], Path]
    said_path: Callable[[Path], Path]
    read_drift: Callable[[Path], list[DriftPoint]]
    session_failure: Callable[[Path, datetime], str]
    read_pulse: Callable[[Path], Pulse | None]
    read_rig_limits: Callable[[Path], RigLimits]
