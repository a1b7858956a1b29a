"""Reading a verification in the background: how far it is, and giving it up for a newer one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from gui.process.background import Background
from gui.verification.results import Results, read_results


class Reading:
    """Reads one verification at a time; a newer request makes an older one void.

    Parameters
    ----------
    background : Background
        Where it is read.
    done : callable
        Called with the results.
    failed : callable
        Called with the error.
    """

    def __init__(
        self, background: Background, done: Callable[[Results], object], failed: Callable[[Exception], object]
    ) -> None:
        self._background, self._done, self._failed = background, done, failed
        self._number = 0
        self._what = ""
        self._share = 0, 0

    def read(self, record: Path) -> None:
        """Read a verification."""
        self._number += 1
        number = self._number
        self._what, self._share = record.parent.name, (0, 0)
        work = partial(read_results, record, self._tell, lambda: number == self._number)
        self._background.ask("verification", work, partial(self._over, self._done), partial(self._over, self._failed))

    def give_up(self) -> None:
        """Let a reading under way end soon."""
        self._number += 1

    def told(self) -> str:
        """How far it is, in words; empty when nothing is read."""
        if not self._what:
            return ""
        done, total = self._share
        return f"reading {self._what}: {done} of {total} fields" if total else f"reading {self._what}…"

    def _tell(self, done: int, total: int) -> None:
        """Called in the thread that reads: one assignment, read by the window's."""
        self._share = done, total

    def _over(self, tell: Callable[..., object], outcome: object) -> None:
        self._what = ""
        tell(outcome)
