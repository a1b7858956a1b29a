"""What the window is given by the front door: how to start commands, and which files lie beside a bank."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rendering.report_drift import DriftPoint


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a running capture last said of itself in its heartbeat.

    Parameters
    ----------
    at : datetime
        When, with a time zone.
    pid : int
        Its process.
    state, reason : str
        Where it stands, and why.
    position : int or None
        What it measures.
    silent : bool
        Whether that is so long ago that it is worth a word.
    """

    at: datetime
    pid: int
    state: str
    reason: str
    position: int | None
    silent: bool


@dataclass(frozen=True, slots=True)
class FrontDoor:
    """The command line, and the names of what lies beside a bank.

    Parameters
    ----------
    command : sequence of str
        Starts the command line in a process of its own; arguments follow.
    log_path, raw_path, said_path : callable
        From a bank to its event log, its raw recordings, and what its capture told people when a window started it.
    read_drift : callable
        From a bank to its drift history, oldest first.
    read_pulse : callable
        From a bank to the latest heartbeat; None where there is none.
    """

    command: Sequence[str]
    log_path: Callable[[Path], Path]
    raw_path: Callable[[Path], Path]
    said_path: Callable[[Path], Path]
    read_drift: Callable[[Path], list[DriftPoint]]
    read_pulse: Callable[[Path], Pulse | None]
