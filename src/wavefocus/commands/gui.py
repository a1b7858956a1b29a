"""``wavefocus gui``: opens the window, or that of trials; loads no Qt before there is a display for it."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from wavefocus.storage.errors import InputError

_LIBRARIES = "libgl1 libglib2.0-0 libfontconfig1 libdbus-1-3 libxkbcommon-x11-0 libxcb-icccm4 libxcb-keysyms1"


def gui(files: Sequence[Path]) -> int:
    """Show the window until it is closed.

    files: Run files and banks to open.

    Raises InputError: There is no display, Qt cannot be loaded, or the system has no font.
    """
    _require_display()
    try:
        from wavefocus.gui.window import show
    except ImportError as missing:
        raise InputError(_missing(missing)) from missing
    return show(files)


def open_trials(arguments: Sequence[str], say: Callable[[str], object]) -> int:
    """Run one participant's trials in a window of their own; return the command's exit code.

    arguments: Of ``wavefocus trials``, without ``--lines``; the same command runs as a child with it.
    say: Receives why the child ended early, a sentence.

    Raises InputError: There is no display, Qt cannot be loaded, or the system has no font.
    """
    _require_display()
    try:
        from wavefocus.gui.trials.window import show
    except ImportError as missing:
        raise InputError(_missing(missing)) from missing
    return show(arguments, say)


def _require_display() -> None:
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
