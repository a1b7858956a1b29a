"""A capture or a verification that this window started: a process that goes on when the window is closed."""

from __future__ import annotations

import io
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gui.shell.apart import leave, start_apart
from gui.shell.front_door import FrontDoor
from storage.sidecar_files import create

_TAIL_BYTES = 4096
_RESUME = "resume goes on from what is in the bank"


class OwnRun:
    """Starts a command that plays and records, and knows how it ended.

    What the process tells people goes to a file beside what it works at, which outlives the window. It hears no Ctrl-C
    and no hang-up that are meant for the window.

    Parameters
    ----------
    front : FrontDoor
        Starts commands.
    arguments : sequence of str
        Command and arguments.
    subject : Path
        What it works at: a bank, or a folder.
    said : Path
        Where what it tells people goes.
    what : str
        What it is called in sentences.
    after_loss : str
        What to do when its process is lost.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(
        self,
        front: FrontDoor,
        arguments: Sequence[str],
        subject: Path,
        said: Path,
        *,
        what: str = "capture",
        after_loss: str = _RESUME,
    ) -> None:
        self.subject = subject
        self._said, self._what, self._after_loss = said, what, after_loss
        try:
            self._said.unlink(missing_ok=True)
            heard = create(self._said)
        except OSError:
            # A folder that cannot be written ends the command with a sentence, which must be kept somewhere.
            fd, name = tempfile.mkstemp(prefix="wavefocus-", suffix=".said")
            self._said, heard = Path(name), io.FileIO(fd, "w")
        with heard:
            self._process = start_apart(
                [*front.command, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=heard,
            )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Its exit code, None while it runs; negative when a signal ended it."""
        return self._process.poll()

    def last_said(self) -> str:
        """The last line that it told people; empty when there was none."""
        try:
            with self._said.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(max(0, size - _TAIL_BYTES))
                lines = file.read().decode("utf-8", "replace").splitlines()
        except OSError:
            return ""
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def ending(self) -> str:
        """How it ended, in a sentence; empty when all went well or while it runs."""
        code = self.exit_code
        if code is None or code == 0:
            return ""
        said = self.last_said().removeprefix("wavefocus: ")
        if code < 0:
            return (
                f"the {self._what} ended without a good-bye: its process was killed, or the machine ran out of memory; "
                f"{self._after_loss}"
            )
        return said or f"the {self._what} ended with exit code {code}"

    def let_go(self) -> None:
        """Leave it running without a parent that would wait for it."""
        leave(self._process)
