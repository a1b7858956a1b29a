"""Lines of a verification's log, besides the events of its scan."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from config.messages.codec import Message


@dataclass(frozen=True)
class VerifyStarted(Message, event="started"):
    """A verification begins, in a process of a host."""

    at: datetime
    pid: int
    host: str


@dataclass(frozen=True)
class VerifyStep(Message, event="step"):
    """A step has done so many of its items; `left_s` None until the first is done."""

    at: datetime
    step: str
    done: int
    total: int
    left_s: float | None = None


@dataclass(frozen=True)
class VerifyEnded(Message, event="ended"):
    """The verification is over, with its exit code and why."""

    at: datetime
    code: int
    reason: str


VERIFY_MESSAGES = (VerifyStarted, VerifyStep, VerifyEnded)
