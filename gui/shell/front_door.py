"""What the window is given by the front door: how to start commands, and which files lie beside a bank."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint
    from rendering.drive.coil_limits import DriveLimits
    from rendering.scene.model import Scene


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
class RigLimits:
    """What a rig's actuators may get.

    Parameters
    ----------
    drive : DriveLimits
        Volts, with the keys of the rig file.
    actuators : int
        How many it has.
    coil_resistance_ohm : float or None
        Of each actuator, where the rig file says.
    """

    drive: DriveLimits
    actuators: int
    coil_resistance_ohm: float | None


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
    read_scene : callable
        From a scene file's text, the file that it is or will be, and whether it may be large, to the scene that
        commands make of it.
    read_scene_tables : callable
        From the same to its tables, valid and with all defaults, whether or not the files that it names are there.
    read_rig_limits : callable
        From a rig file, or ``virtual``, to what its actuators may get.
    """

    command: Sequence[str]
    log_path: Callable[[Path], Path]
    raw_path: Callable[[Path], Path]
    said_path: Callable[[Path], Path]
    read_drift: Callable[[Path], list[DriftPoint]]
    read_pulse: Callable[[Path], Pulse | None]
    read_scene: Callable[..., Scene]
    read_scene_tables: Callable[[str, Path], dict[str, Any]]
    read_rig_limits: Callable[[Path], RigLimits]
