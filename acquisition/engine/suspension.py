"""Holding a session still between two positions: paused by a person, or suspended until the conditions are back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from acquisition.durations import hours
from acquisition.engine.recovery import Recovery
from acquisition.engine.session import LOOKED_FOR_S, Session
from acquisition.measuring.attempt import Attempt
from acquisition.measuring.position_records import PositionRecords
from acquisition.measuring.setup import Setup, asking, silence
from acquisition.quality.conditions import Conditions
from config.messages.campaign import ConditionsSeen, State
from drivers.errors import InstrumentError
from drivers.protocols import Recording
from storage.errors import WavefocusError


class SuspendedTooLongError(WavefocusError):
    """A watched condition left its band and did not come back."""


class Suspension:
    """Pauses and suspends a session, outputs muted and the mirror parked."""

    def __init__(
        self, setup: Setup, session: Session, conditions: Conditions, records: PositionRecords, recovery: Recovery
    ) -> None:
        self._setup, self._session, self._stop = setup, session, session.stop
        self._conditions, self._records, self._recovery = conditions, records, recovery
        self._last_good: int | None = None

    def pause(self) -> None:
        """Stand still until a person says to go on, or to stop: StoppedWhileWaitingError."""
        self._rest()
        self._session.enter(State.PAUSED, "paused by the user: outputs muted, mirror parked; wavefocus go-on, or stop")
        while self._stop.pause_requested:
            self._session.require_no_stop(" while paused")
            # A person's time is the wall's, whatever clock the rig lives by.
            self._stop.wait_for_news(LOOKED_FOR_S)
        self._session.enter(State.RUNNING, "the user says to go on")

    def take_under_conditions(
        self, attempt: Attempt, take: Callable[[], tuple[Recording, ...]]
    ) -> tuple[Recording, ...]:
        """Records of an attempt, taken again after each suspension.

        A condition that has left its band at one position alone (a dark spot) is for the point quality to judge: where
        the last good position is still good, the session is not suspended.

        Raises SuspendedTooLongError: the conditions did not come back in time. StoppedWhileWaitingError: a person asked
        for a stop. InstrumentError: an instrument failed for good meanwhile.
        """
        while True:
            recordings = take()
            reason = self._left(attempt, recordings)
            if not reason:
                return recordings
            self._suspend(attempt, reason)

    def _left(self, attempt: Attempt, recordings: Sequence[Recording]) -> str:
        """Conditions that left their bands for the whole rig; empty where none did."""
        if not self._conditions.watch.bands:
            return ""
        reason = self._conditions.left(self._conditions.values(self._records.plays, recordings))
        self._report_mute_sensors(attempt)
        if not reason:
            self._last_good = attempt.position
        elif self._last_good not in (None, attempt.position) and not self._conditions.left(self._probe(attempt)):
            return ""
        return reason

    def _suspend(self, attempt: Attempt, reason: str) -> None:
        """Wait for the conditions to come back and to stay for as long as they must."""
        watch, clock = self._conditions.watch, self._session.clock
        # Nothing to wait for then: the position under way cannot be finished as it is.
        self._session.require_no_stop(f"; the position under way is not kept: {reason}")
        self._rest()
        self._session.enter(State.SUSPENDED, reason)
        since_s, back_since_s = clock.now_s(), None
        while True:
            wait_s = watch.probe_every_s
            if back_since_s is not None:
                wait_s = min(wait_s, back_since_s + self._conditions.settle_s - clock.now_s())
            if wait_s <= 0:
                break
            self._session.wait(wait_s, " while suspended", until_pause=True)
            if self._stop.pause_requested:
                self.pause()
                return
            values = self._probe(attempt)
            back = self._conditions.are_back(values)
            self._session.publish(ConditionsSeen, dict(values), back, self._conditions.left(values) or reason)
            back_since_s = (clock.now_s() if back_since_s is None else back_since_s) if back else None
            waited_s = clock.now_s() - since_s
            if not back and waited_s >= watch.give_up_after_s:
                raise SuspendedTooLongError(
                    f"suspended for {hours(waited_s)}: {reason}; it was not back within watch.give_up_after_s; "
                    "put it right (light on the spot, cables, room)"
                )
        self._session.enter(State.RUNNING, f"all conditions are back after {hours(clock.now_s() - since_s)}")

    def _probe(self, attempt: Attempt) -> Mapping[str, float]:
        """The conditions now, from one record at the last good position; where there is none, at the present one."""
        position = attempt.position if self._last_good is None else self._last_good
        probing = Attempt(position, attempt.number, attempt.of_session)
        try:
            recording = self._recovery.until_done(lambda: self._records.probe(probing), probing)
        except InstrumentError as failure:
            self._session.fault(failure, probing, retried=False)
            raise
        values = self._conditions.values(self._records.plays[:1], [recording])
        self._report_mute_sensors(attempt)
        return values

    def _rest(self) -> None:
        """Mute and park; an instrument that fails at that is met again, and waited for, when it is needed."""
        failures = silence(self._setup.instruments)
        try:
            with asking("mirror"):
                self._setup.instruments.mirror.park()
        except InstrumentError as failure:
            failures.append(failure)
        for one in failures:
            self._session.fault(one, None, retried=True)

    def _report_mute_sensors(self, attempt: Attempt) -> None:
        """Publish sensors that do not answer; measuring goes on without them."""
        for failure in self._conditions.mute.values():
            self._session.fault(failure, attempt, retried=True)
