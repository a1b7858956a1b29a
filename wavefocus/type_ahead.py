"""Type-ahead: keys that were pressed at a terminal before anything asked for them."""

from __future__ import annotations

import sys


def forget_typed() -> None:
    """Drop what was typed and not read yet; what comes through a pipe or from a file stays."""
    if sys.stdin is None or not sys.stdin.isatty():
        return
    if sys.platform == "win32":
        import msvcrt

        while msvcrt.kbhit():
            msvcrt.getwch()
    else:
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)
