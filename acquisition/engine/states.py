"""The state of a session: which follows which, and how long the session has been at work."""

from __future__ import annotations

import time
from typing import ClassVar

from acquisition.engine.events import State, StateChanged, Subscriber
from drivers.protocols import Clock

_ENDS = {State.STOPPED, State.FINISHED, State.FAILED}
_HELD_UP = {State.SUSPENDED, State.RECOVERING, State.STOPPING}


class IllegalStateError(RuntimeError):
    """A state that cannot follow the present one: a defect of the program, not of an instrument."""


class Lifecycle:
    """State and working time of a session; each change is published.

    clock: The rig's clock; times count from now.
    publish: Receives every event.
    """

    # Recovering and suspended return to where they came from; nothing follows what ends a session.
    FOLLOWS: ClassVar[dict[State, set[State]]] = {
        State.IDLE: {State.RUNNING, State.RECOVERING, State.STOPPED, State.FAILED},
        State.RUNNING: {State.PAUSING} | _HELD_UP | _ENDS,
        # The position under way is finished first; with the last one there is nothing left to pause.
        State.PAUSING: {State.PAUSED, State.RUNNING} | _HELD_UP | _ENDS,
        State.PAUSED: {State.RUNNING, State.STOPPED, State.FAILED},
        State.SUSPENDED: {State.RUNNING, State.PAUSED, State.RECOVERING, State.STOPPED, State.FAILED},
        State.RECOVERING: {State.IDLE, State.RUNNING, State.PAUSING, State.SUSPENDED, State.STOPPING}
        | (_ENDS - {State.FINISHED}),
        State.STOPPING: {State.RECOVERING} | _ENDS,
        State.STOPPED: set(),
        State.FINISHED: set(),
        State.FAILED: set(),
    }
    # Time spent in these says nothing of how long the other positions will take.
    AWAY: ClassVar = {State.PAUSED, State.SUSPENDED, State.RECOVERING}

    def __init__(self, clock: Clock, publish: Subscriber) -> None:
        self._clock = clock
        self._publish = publish
        self._started_s, self._started_wall_s = clock.now_s(), time.monotonic()
        self._away_since: tuple[float, float] | None = None
        self._away_s = self._away_wall_s = 0.0
        self.state, self.reason = State.IDLE, ""

    def enter(self, state: State, reason: str) -> None:
        """Change the state; raises IllegalStateError where the table does not have this change."""
        if state not in self.FOLLOWS[self.state]:
            raise IllegalStateError(f"{state} cannot follow {self.state}")
        if self._away_since is not None:
            self._away_s += self.time_s() - self._away_since[0]
            self._away_wall_s += self._wall_s() - self._away_since[1]
        self._away_since = (self.time_s(), self._wall_s()) if state in self.AWAY else None
        self.state, self.reason = state, reason
        self._publish(StateChanged(self.time_s(), state, reason))

    def time_s(self) -> float:
        """Seconds on the rig's clock since the session began."""
        return self._clock.now_s() - self._started_s

    def working_s(self) -> tuple[float, float]:
        """Seconds on the rig's and on the wall's clock that were not spent paused, suspended or recovering."""
        return self.time_s() - self._away_s, self._wall_s() - self._away_wall_s

    def _wall_s(self) -> float:
        return time.monotonic() - self._started_wall_s
