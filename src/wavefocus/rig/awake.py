"""Keeps the operating system from sleeping while a run is on, and names the run as the reason."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from wavefocus.config.messages.rig_checks import Finding

# SetThreadExecutionState, Windows API: the state lasts until it is changed, and is the display's affair no further.
_ES_CONTINUOUS = 0x80000000
_ES_SYSTEM_REQUIRED = 0x00000001


@contextmanager
def kept_awake(reason: str) -> Iterator[bool]:
    """Keep the system awake while the block runs; it may sleep again when this process is gone, however it ends.

    Linux: ``systemd-inhibit``, which ``systemd-inhibit --list`` shows with the reason. macOS: ``caffeinate``, which
    ``pmset -g assertions`` shows. Windows: SetThreadExecutionState, which ``powercfg /requests`` shows with the
    program. The screen may go dark.

    reason: What is going on, for people.

    Yields whether the system has accepted it; no run is held up where it does not.
    """
    if sys.platform == "win32":
        import ctypes

        set_state = ctypes.windll.kernel32.SetThreadExecutionState
        accepted = bool(set_state(_ES_CONTINUOUS | _ES_SYSTEM_REQUIRED))
        try:
            yield accepted
        finally:
            set_state(_ES_CONTINUOUS)
        return
    holder = next(filter(None, map(_started, inhibitors(sys.platform, reason))), None)
    try:
        yield holder is not None
    finally:
        if holder is not None:
            _end(holder)


def awake_finding() -> Finding:
    """Whether this system can be kept awake."""
    with kept_awake("wavefocus doctor") as accepted:
        if accepted:
            return Finding("computer", "sleep", "ok", "kept awake while a run is on")
    what = "this system takes no request to stay awake"
    return Finding("computer", "sleep", "skipped", what, "set its power settings to never sleep")


def inhibitors(platform: str, reason: str) -> list[list[str]]:
    """Commands that keep a platform (as `sys.platform`) awake, the first that it accepts being enough.

    On Linux they end when their standard input is closed, on macOS when this process is gone.
    """
    if platform == "darwin":
        return [["caffeinate", "-i", "-s", "-w", str(os.getpid())]]
    if platform.startswith("linux"):
        who = ["--who=wavefocus", f"--why={reason}", "--mode=block", "cat"]
        # A user who is logged in over the network may only refuse idling (org.freedesktop.login1.policy).
        return [["systemd-inhibit", f"--what={what}", *who] for what in ("sleep:idle:handle-lid-switch", "idle")]
    return []


def _started(command: list[str]) -> subprocess.Popen[bytes] | None:
    """Start a command; None where it is not there, or ends at once, for the system refused it."""
    if shutil.which(command[0]) is None:
        return None
    null = subprocess.DEVNULL
    try:
        holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=null, stderr=null, start_new_session=True)
    except OSError:
        return None
    try:
        # A system without a session manager refuses within milliseconds.
        holder.wait(0.2)
    except subprocess.TimeoutExpired:
        return holder
    _end(holder)
    return None


def _end(holder: subprocess.Popen[bytes]) -> None:
    with suppress(OSError):
        if holder.stdin is not None:
            holder.stdin.close()
    if sys.platform == "darwin":
        holder.terminate()
    try:
        holder.wait(5.0)
    except subprocess.TimeoutExpired:
        holder.kill()
        holder.wait()
