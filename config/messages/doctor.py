"""Findings of ``wavefocus doctor``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from config.messages.codec import Message

Verdict = Literal["ok", "warn", "fail", "skipped"]
Action = Literal["calibrate", "edit-rig", "open-folder", "reset-usb", "run", "test-message"]


@dataclass(frozen=True)
class Act:
    """The part of a remedy that a program can do, or make ready, for a person.

    Parameters
    ----------
    do : str
        ``"calibrate"`` a part; ``"edit-rig"``: a key of the rig file; ``"open-folder"``; ``"reset-usb"`` of a role;
        ``"run"`` a command in a terminal; ``"test-message"``: send one to every address.
    on : str
        The part, the key (``"player.channels"``), the folder, the role or the command.
    """

    do: Action
    on: str = ""


@dataclass(frozen=True)
class Finding:
    """One check of one instrument, or of what else was examined.

    Parameters
    ----------
    instrument : str
        The role, or what else was examined.
    check : str
        Name of the check.
    verdict : str
        ``"ok"``, ``"warn"`` (usable, but look at it), ``"fail"`` or ``"skipped"``.
    what : str
        What was found, or why it was skipped.
    remedy : str
        What to do about it; empty where there is nothing to do.
    act : Act, optional
        The part of the remedy that a program can do.
    """

    instrument: str
    check: str
    verdict: Verdict
    what: str
    remedy: str = ""
    act: Act | None = None


@dataclass(frozen=True)
class FindingMade(Message):
    """One finding, as soon as it is made."""

    finding: Finding


@dataclass(frozen=True)
class Examination(Message):
    """All findings of a rig, their counts by verdict, and the versions of the packages that matter."""

    rig: str
    name: str
    good: bool
    counts: Mapping[str, int]
    findings: tuple[Finding, ...]
    versions: Mapping[str, str]


DOCTOR_MESSAGES = (FindingMade, Examination)
