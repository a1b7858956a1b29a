"""Which signals end a campaign on this system, and how: POSIX and Windows do not have the same ones."""

from __future__ import annotations

import signal
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EndingSignals:
    """Numbers of signals by what is meant with them.

    Parameters
    ----------
    finish : tuple of int
        Finish the position first; once more: at once.
    terminal_gone : tuple of int
        Nobody watches any more; finish the position.
    at_once : tuple of int
        Do not wait for the position.
    """

    finish: tuple[int, ...]
    terminal_gone: tuple[int, ...]
    at_once: tuple[int, ...]

    @classmethod
    def here(cls, source: object = signal) -> EndingSignals:
        """The signals of this system.

        Parameters
        ----------
        source : object
            Where to look for SIGINT, SIGHUP, SIGTERM and SIGBREAK; the module `signal`. SIGBREAK is what Windows
            sends for Ctrl-Break and, with seconds to live, when the console window is closed.
        """

        def those_of(*names: str) -> tuple[int, ...]:
            return tuple(int(getattr(source, name)) for name in names if hasattr(source, name))

        return cls(those_of("SIGINT"), those_of("SIGHUP"), those_of("SIGTERM", "SIGBREAK"))

    @property
    def all(self) -> tuple[int, ...]:
        """Every one of them."""
        return (*self.finish, *self.terminal_gone, *self.at_once)
