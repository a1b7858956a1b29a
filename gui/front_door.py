"""Services that the command line gives the window, and the way to open it; loads no Qt before it is needed."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.acquisition.heartbeat import Heartbeat
    from wavefocus.acquisition.limits import DriftPoint
    from wavefocus.rendering.arrays import Float64Array
    from wavefocus.rendering.drive.coil_limits import DriveLimits


@dataclass(frozen=True, slots=True)
class RigLimits:
    """Limits of a rig's actuators; the coils' resistance where the rig file has it."""

    drive: DriveLimits
    actuators: int
    coil_resistance_ohm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class PlannedCampaign:
    """A campaign before it has a bank.

    position_mm, float64 (positions, 2); actuator_mm, float64 (actuators, 2); outline_mm, float64 (points, 2): What is
        measured, in mm on the surface.
    duration_s: Seconds that it takes, repeats of the sentinel included.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    outline_mm: Float64Array
    duration_s: float


@dataclass(frozen=True, slots=True)
class FrontDoor:
    """Services of the command line.

    command: Starts the command line in a separate process; arguments follow.
    log_path, raw_path, said_path: From a bank to its event log, its raw recordings, and the standard error of a capture
        that a window started.
    read_drift: From a bank to its drift history, oldest first.
    session_failure: From a bank and an instant to the failure of the session that ended last, as of `SessionEnded`;
        empty where none has ended since.
    read_heartbeat: From a bank to its latest heartbeat; None where there is none.
    read_rig_limits: From a rig file, or ``virtual``, to its limits.
    read_plan: From a run file to the campaign that it describes.
    """

    command: Sequence[str]
    log_path: Callable[[Path], Path]
    raw_path: Callable[[Path], Path]
    said_path: Callable[[Path], Path]
    read_drift: Callable[[Path], list[DriftPoint]]
    session_failure: Callable[[Path, datetime], str]
    read_heartbeat: Callable[[Path], Heartbeat | None]
    read_rig_limits: Callable[[Path], RigLimits]
    read_plan: Callable[[Path], PlannedCampaign]


_LIBRARIES = "libgl1 libglib2.0-0 libfontconfig1 libdbus-1-3 libxkbcommon-x11-0 libxcb-icccm4 libxcb-keysyms1"


def open_window(front: FrontDoor, files: Sequence[Path]) -> int:
    """Show the window until it is closed.

    files: Run files and banks to open.

    Raises InputError: There is no display, or Qt cannot be loaded.
    """
    require_display()
    try:
        from wavefocus.gui.window import show
    except ImportError as missing:
        raise InputError(_missing(missing)) from missing
    return show(front, files)


def open_trials(front: FrontDoor, arguments: Sequence[str], say: Callable[[str], object]) -> int:
    """Run one participant's trials in a window of their own; return the command's exit code.

    arguments: Of ``wavefocus trials``, without ``--lines``; the same command runs as a child with it.
    say: Receives why the child ended early, a sentence.

    Raises InputError: There is no display, or Qt cannot be loaded.
    """
    require_display()
    try:
        from wavefocus.gui.trials.window import show
    except ImportError as missing:
        raise InputError(_missing(missing)) from missing
    return show(front, arguments, say)


def require_display() -> None:
    """Refuse where Qt would abort for want of a display.

    Raises InputError: There is none.
    """
    platform = os.environ.get("QT_QPA_PLATFORM", "").partition(":")[0]
    if not sys.platform.startswith("linux") or platform not in ("", "xcb", "wayland"):
        return
    display, wayland = os.environ.get("DISPLAY"), os.environ.get("WAYLAND_DISPLAY")
    if {"": display or wayland, "xcb": display, "wayland": wayland}[platform]:
        if platform in ("", "xcb") and display and not (wayland and not platform):
            _require_answer(display)
        return
    raise InputError(
        "the window needs a display and there is none (neither DISPLAY nor WAYLAND_DISPLAY is set): run it on the "
        "desktop, or through ssh -X; every command works without it, wavefocus --help shows them"
    )


def _require_answer(display: str) -> None:
    """Ask the X server of a local display for a connection; of others Qt has to find out itself."""
    import socket

    host, colon, number = display.rpartition(":")
    number = number.partition(".")[0]
    if not colon or host not in ("", "unix") or not number.isdigit():
        return
    for address in (f"/tmp/.X11-unix/X{number}", f"\0/tmp/.X11-unix/X{number}"):
        with socket.socket(socket.AF_UNIX) as server:
            server.settimeout(5.0)
            try:
                server.connect(address)
            except OSError:
                continue
            return
    raise InputError(
        f"the window needs a display, and no X server answers at DISPLAY={display}: run it on the desktop, or through "
        "ssh -X; every command works without it, wavefocus --help shows them"
    )


def _missing(missing: ImportError) -> str:
    reason = " ".join(str(missing).split())
    if isinstance(missing, ModuleNotFoundError):
        return f'the window needs PyQt5 and pyqtgraph ({reason}): pip install "wavefocus[window]"'
    install = f"sudo apt-get install {_LIBRARIES}"
    return f"Qt cannot be loaded ({reason}): install what it needs, on Debian and Ubuntu: {install}"
