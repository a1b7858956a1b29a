"""Recovery: a lost instrument is waited for, connected afresh, and what it interrupted is done again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import TypeVar

from acquisition.durations import hours
from acquisition.engine.session import Session
from acquisition.measuring.attempt import Attempt
from acquisition.measuring.setup import Setup, as_lost, instrument_of, silence
from config.messages.campaign import ReconnectTried, State
from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError

Result = TypeVar("Result")

LONGEST_BACK_OFF_S = 30.0
# An instrument that says "lost" is believed at once; one that only fails passingly, when it does so again.
PASSING_IN_A_ROW = 2
# Instruments that come back but do not live to the end of one measurement are a loose plug: a person must look.
LOSSES_IN_A_ROW = 10


def back_off_s(number: int) -> float:
    """Seconds to wait before try `number`, counted from 0: 0, 1, 2, 4, ... up to half a minute."""
    return 0.0 if number == 0 else min(LONGEST_BACK_OFF_S, 2.0 ** min(number - 1, 10))


class Recovery:
    """Brings lost instruments back, for a campaign as for a scan; the session is "recovering" meanwhile."""

    def __init__(self, setup: Setup, session: Session) -> None:
        self._setup, self._session, self._clock = setup, session, session.clock
        # All three are forgotten when a measurement comes to its end.
        self._tries: Counter[str] = Counter()
        self._passing: Counter[str] = Counter()
        self._losses = 0

    def until_done(self, measure: Callable[[], Result], attempt: Attempt | None = None) -> Result:
        """Measure, from the beginning again after each instrument that was lost and came back.

        measure: Points, plays and records; what it did before an interruption must not matter.
        attempt: What is measured, for the events.

        Raises StoppedWhileWaitingError: a person asked for a stop. InstrumentLostError: the instrument did not come
        back in time, or did not stay. InstrumentError: any other failure, at once; passing ones are for
        :meth:`renew_if_repeated`.
        """
        while True:
            try:
                result = measure()
            except InstrumentLostError as lost:
                if not lost.role:
                    raise  # nobody noted whose it was, so nobody can be asked for a fresh connection
                self._session.fault(lost, attempt, retried=True)
                self._bring_back(lost)
            else:
                self._tries.clear()
                self._passing.clear()
                self._losses = 0
                return result

    def renew_if_repeated(self, fault: TransientInstrumentError) -> None:
        """Give an instrument a fresh connection when it fails passingly again and again; raises as `until_done`."""
        self._passing[fault.role] += 1
        if self._passing[fault.role] >= PASSING_IN_A_ROW:
            self._bring_back(fault)

    def _bring_back(self, failure: InstrumentError) -> None:
        """Silence the rig and wait until all that was lost is connected again."""
        self._losses += 1
        if self._losses > LOSSES_IN_A_ROW:
            cause = f"{failure.cause}, also after {LOSSES_IN_A_ROW} fresh connections in a row"
            raise as_lost(failure, cause) from failure
        came_from, since_s = self._session.state, self._clock.now_s()
        gives_up_wall_s = time.monotonic() + self._setup.recovery_s
        self._session.enter(State.RECOVERING, f"{failure.instrument}: {failure.cause}")
        lost = {failure.role: failure}
        self._silence(lost)
        while lost:
            role = next(iter(lost))
            self._reconnect(role, lost[role], since_s, gives_up_wall_s)
            del lost[role]
            self._silence(lost)
            away_s = self._clock.now_s() - since_s
            if lost and away_s >= self._setup.recovery_s:
                also = next(iter(lost.values()))
                raise as_lost(also, f"{also.cause}; not cured within {hours(away_s)}") from also
        self._session.enter(came_from, f"{failure.instrument} is connected again after {hours(away_s)}")

    def _silence(self, lost: dict[str, InstrumentError]) -> None:
        """Mute the player and drop the record; an instrument that cannot be silenced is lost, too."""
        for failure in silence(self._setup.instruments):
            lost.setdefault(failure.role, failure)

    def _reconnect(self, role: str, failure: InstrumentError, since_s: float, gives_up_wall_s: float) -> None:
        """Try for a fresh connection until there is one, a person stops it or the time is over, on either clock.

        A call that hangs takes its time from the wall's clock, whatever clock the rig lives by.
        """
        until_s = since_s + self._setup.recovery_s
        while True:
            wait_s = min(back_off_s(self._tries[role]), until_s - self._clock.now_s())
            self._session.wait(wait_s, f" while {failure.instrument} was gone")
            self._tries[role] += 1
            try:
                instrument_of(self._setup.instruments, role).reconnect()
            except (InstrumentLostError, TransientInstrumentError) as absent:
                left_s = round(until_s - self._clock.now_s(), 3)  # slices of time do not add up exactly
                if time.monotonic() >= gives_up_wall_s:
                    left_s = 0.0
                self._publish_try(failure, absent.cause, left_s)
                if left_s <= 0:
                    wall_s = time.monotonic() - gives_up_wall_s + self._setup.recovery_s
                    waited = hours(max(self._clock.now_s() - since_s, wall_s))
                    tries = f"{self._tries[role]} tries (last: {absent.cause})"
                    raise as_lost(failure, f"{failure.cause}; not back within {waited}, {tries}") from absent
            except InstrumentError as other:
                self._publish_try(failure, other.cause, 0.0)
                raise
            else:
                self._publish_try(failure, "connected", None)
                return

    def _publish_try(self, failure: InstrumentError, outcome: str, left_s: float | None) -> None:
        """Publish how a try ended; `left_s` is the time until the session gives up, None when connected."""
        number = self._tries[failure.role]
        next_s = min(back_off_s(number), left_s) if left_s is not None and left_s > 0 else None
        gives_up_s = None if left_s is None else max(0.0, left_s)
        tried = failure.role, failure.instrument, number, left_s is None, outcome
        self._session.publish(ReconnectTried, *tried, next_s, gives_up_s)
