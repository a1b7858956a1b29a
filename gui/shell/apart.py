"""Commands in processes apart from the window's: what is meant for the window does not reach them."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from typing import IO

_ON_ITS_OWN = 0x00000200 | 0x08000000  # Windows: CREATE_NEW_PROCESS_GROUP, CREATE_NO_WINDOW


def start_apart(command: Sequence[str], *, stdin: int, stdout: int, stderr: int | IO[bytes]) -> subprocess.Popen[bytes]:
    """Start a command that talks UTF-8 and hears no Ctrl-C and no hang-up of the window's.

    Raises
    ------
    OSError
        The process cannot be started.
    """
    return subprocess.Popen(
        command,
        stdin=stdin,
        stdout=stdout,
        stderr=stderr,
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        start_new_session=os.name == "posix",
        creationflags=0 if os.name == "posix" else _ON_ITS_OWN,
    )


def leave(process: subprocess.Popen[bytes]) -> None:
    """Leave it to itself, without a parent that would wait for it."""
    # Otherwise the interpreter warns on exit that a child is still running, which is what was asked for.
    if process.poll() is None:
        process.returncode = 0
