"""The command that goes on with a campaign, as it is to be typed."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path


def command_line(*words: object) -> str:
    """A command with its words quoted for this system's shell where they need it."""
    texts = [str(word) for word in words]
    return subprocess.list2cmdline(texts) if sys.platform == "win32" else shlex.join(texts)


def resume_line(bank: Path, rig_file: Path | None, *, word: str = "resume") -> str:
    """``wavefocus resume BANK``, with the rig file of this session where there is one: it may have been corrected.

    Parameters
    ----------
    bank : Path
        The bank.
    rig_file : Path, optional
        The rig file that the session's run file or command line named.
    word : str
        The command.
    """
    return command_line("wavefocus", word, bank, *(("--rig", rig_file) if rig_file is not None else ()))
