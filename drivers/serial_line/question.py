"""What is asked over a serial line, and what an answer can mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Answer = TypeVar("Answer")


class UnreadableError(Exception):
    """The answer is not what this question can be answered with."""


class RefusedError(Exception):
    """The device says that it will not.

    Parameters
    ----------
    meaning : str
        What its answer means.
    remedy : str
        What to do about it.
    passing : bool
        Whether a new attempt can go well.
    again : bool
        Whether a disturbed command is answered so too, so that it is asked once more before the answer is believed.
    """

    def __init__(self, meaning: str, remedy: str, *, passing: bool = False, again: bool = False) -> None:
        super().__init__(meaning)
        self.meaning = meaning
        self.remedy = remedy
        self.passing = passing
        self.again = again


class RestartedError(Exception):
    """The device answers as it does after power-on: what it was told before is lost."""


@dataclass(frozen=True, slots=True)
class Query(Generic[Answer]):
    """A question to a device; asking it twice does no harm.

    Parameters
    ----------
    text : str
        The command, without its end.
    read : callable
        Turns the answer into its meaning; raises `UnreadableError`, `RefusedError` or `RestartedError`.
    """

    text: str
    read: Callable[[str], Answer]


@dataclass(frozen=True, slots=True)
class Marker:
    """A question that only one device answers in one way, to find the place in its answers again.

    Parameters
    ----------
    text : str
        The command, without its end.
    device : str
        Who answers, for messages.
    marks : callable
        Whether a line ends with the answer; half another answer may stand before it.
    stranger : callable
        Which other device a line comes from, or None where it says nothing of that; raises `RestartedError`.
    """

    text: str
    device: str
    marks: Callable[[str], bool]
    stranger: Callable[[str], str | None]
