"""One session at the instruments: its state, its time, its events, and the requests of a person to it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar, Concatenate, ParamSpec, TypeVar

from wavefocus.config.messages.campaign import Event, Fault, State, StateChanged, Subscriber
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Clock

if TYPE_CHECKING:
    from wavefocus.acquisition.attempt import Attempt  # with it comes the estimator, and every command imports this

Content = ParamSpec("Content")
Published = TypeVar("Published", bound=Event)
LOG = logging.getLogger(__name__)
BY_THE_USER = "stopped by the user"
# Requests are looked for this often: no clock can be woken from its sleep.
LOOKED_FOR_S = 0.1
_ENDS = {State.STOPPED, State.FINISHED, State.FAILED}
_HELD_UP = {State.SUSPENDED, State.RECOVERING, State.STOPPING}


class IllegalStateError(RuntimeError):
    """A state that cannot follow the present one: a defect of the program, not of an instrument."""


class StoppedWhileWaitingError(Exception):
    """A person asked for a stop while something was waited for; there is no position to finish."""


class StopRequest:
    """Shared between the engine and those who may stop or pause it; safe from any thread."""

    def __init__(self) -> None:
        self._stop, self._pause = threading.Event(), threading.Event()
        # Set at every request, for those who wait for the next one; taken back by them.
        self._news = threading.Event()
        self.reason = BY_THE_USER

    def finish_position(self, reason: str = BY_THE_USER) -> None:
        """Ask for a stop once the position under way is committed; the reason of the first request counts."""
        if not self._stop.is_set():
            self.reason = reason
        self._stop.set()
        self._news.set()

    def pause(self) -> None:
        """Ask the engine to stand still once the position under way is committed."""
        self._pause.set()
        self._news.set()

    def go_on(self) -> None:
        """Take a pause back."""
        self._pause.clear()
        self._news.set()

    @property
    def requested(self) -> bool:
        """Whether the engine was asked to stop."""
        return self._stop.is_set()

    @property
    def pause_requested(self) -> bool:
        """Whether the engine was asked to pause and not yet to go on."""
        return self._pause.is_set()

    def wait_for_news(self, seconds: float) -> None:
        """Wait on the wall's clock for the next request, at most so long."""
        self._news.wait(seconds)
        self._news.clear()


class EventPublisher:
    """Calls every subscriber with every event; the first failure of each is reported, and the others go on.

    A subscriber that failed gets the later events too: what failed may pass, as a full disk does.

    subscribers: By the name under which a failure is reported.
    report: Receives one sentence about the first failure of a subscriber; by default it goes to Python's log.
    """

    def __init__(self, subscribers: Mapping[str, Subscriber], report: Callable[[str], object] = LOG.error) -> None:
        self._subscribers, self._report = dict(subscribers), report
        self._failed: set[str] = set()

    def __call__(self, event: Event) -> None:
        """Publish one event. Ctrl-C and the like pass through."""
        for name, subscriber in self._subscribers.items():
            try:
                subscriber(event)
            except Exception as failure:
                if name not in self._failed:
                    self._failed.add(name)
                    what = " ".join(str(failure).split())
                    self._report(f"{name} failed ({type(failure).__name__}: {what}); the campaign goes on")


class Session:
    """State and time of a session of a campaign or a scan; each change of state is published.

    clock: The rig's clock; times count from now.
    subscriber: Receives every event; a failure of it is reported once.
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
        **{end: set() for end in _ENDS},
    }
    # Time spent in these says nothing of how long the other positions will take.
    AWAY: ClassVar = {State.PAUSED, State.SUSPENDED, State.RECOVERING}

    def __init__(self, clock: Clock, subscriber: Subscriber, stop: StopRequest) -> None:
        self.clock, self.stop, self.state = clock, stop, State.IDLE
        self._publish = EventPublisher({"a subscriber of the session's events": subscriber})
        self._started_s, self._started_wall_s = clock.now_s(), time.monotonic()
        self._away_since: tuple[float, float] | None = None
        self._away_s = self._away_wall_s = 0.0

    def enter(self, state: State, reason: str) -> None:
        """Change the state; raises IllegalStateError where the table does not have this change."""
        if state not in self.FOLLOWS[self.state]:
            raise IllegalStateError(f"{state} cannot follow {self.state}")
        now_s, wall_s = self.time_s(), self._wall_s()
        if self._away_since is not None:
            self._away_s += now_s - self._away_since[0]
            self._away_wall_s += wall_s - self._away_since[1]
        self._away_since = (now_s, wall_s) if state in self.AWAY else None
        self.state = state
        self.publish(StateChanged, state, reason)

    def follow_requests(self) -> None:
        """Enter the state that was asked for, while the position under way goes on."""
        if self.stop.requested and self.state in (State.RUNNING, State.PAUSING):
            self.enter(State.STOPPING, f"{self.stop.reason}; the position under way is finished first")
        elif self.stop.pause_requested and self.state is State.RUNNING:
            self.enter(State.PAUSING, "a pause was asked for; the position under way is finished first")
        elif not self.stop.pause_requested and self.state is State.PAUSING:
            self.enter(State.RUNNING, "the pause was taken back")

    def publish(
        self, kind: Callable[Concatenate[float, Content], Published], *content: Content.args, **named: Content.kwargs
    ) -> Published:
        """Publish an event of now, and return it; the arguments are its other fields."""
        event = kind(self.time_s(), *content, **named)
        self._publish(event)
        return event

    def fault(self, fault: InstrumentError, attempt: Attempt | None, *, retried: bool) -> None:
        """Publish that an instrument failed, at an attempt or at none."""
        position, number = (None, None) if attempt is None else (attempt.position, attempt.number)
        says = fault.instrument, fault.operation, fault.cause, fault.remedy
        self.publish(Fault, *says, position, number, retried)

    def time_s(self) -> float:
        """Seconds on the rig's clock since the session began."""
        return self.clock.now_s() - self._started_s

    def working_s(self) -> tuple[float, float]:
        """Seconds on the rig's and on the wall's clock that were not spent paused, suspended or recovering."""
        return self.time_s() - self._away_s, self._wall_s() - self._away_wall_s

    def require_no_stop(self, words: str) -> None:
        """Raise StoppedWhileWaitingError where a person has asked for a stop; `words` say what was waited for."""
        if self.stop.requested:
            raise StoppedWhileWaitingError(self.stop.reason + words)

    def wait(self, seconds: float, words: str, *, until_pause: bool = False) -> None:
        """Let time pass on the rig's clock, until a pause is asked for if so wished; raises as `require_no_stop`."""
        self.require_no_stop(words)
        while seconds > 0 and not (until_pause and self.stop.pause_requested):
            self.clock.sleep(min(seconds, LOOKED_FOR_S))
            seconds -= LOOKED_FOR_S
            self.require_no_stop(words)

    def _wall_s(self) -> float:
        return time.monotonic() - self._started_wall_s
