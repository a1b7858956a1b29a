"""Holding a session still between two positions: paused by a person, or suspended until the conditions are back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from acquisition.durations import hours
from acquisition.engine.events import State, SuspendedTooLongError
from acquisition.engine.recovery import Recovery
from acquisition.engine.session import Session
from acquisition.engine.states import Lifecycle
from acquisition.engine.stop_request import StoppedWhileWaitingError, StopRequest
from acquisition.measuring.attempt import Attempt
from acquisition.measuring.position_records import PositionRecords
from acquisition.measuring.setup import Setup, asking, silence
from acquisition.quality.conditions import Conditions
from drivers.errors import InstrumentError
from drivers.protocols import Recording

# Requests are looked for this often; a virtual clock cannot be woken from its sleep.
LOOKED_FOR_S = 0.1


class Suspension:
    """Pauses and suspends a session, outputs muted and the mirror parked.

    session: Publishes conditions and faults.
    stop: Requests of a person.
    conditions: Watched conditions.
    records: Takes probing records.
    recovery: Brings lost instruments back meanwhile.
    """

    def __init__(
        self,
        setup: Setup,
        life: Lifecycle,
        session: Session,
        stop: StopRequest,
        conditions: Conditions,
        records: PositionRecords,
        recovery: Recovery,
    ) -> None:
        self._setup, self._life, self._session, self._stop = setup, life, session, stop
        self._conditions, self._records, self._recovery = conditions, records, recovery
        self._last_good: int | None = None

    def follow_requests(self) -> None:
        """Enter the state that was asked for, while the position under way goes on."""
        state = self._life.state
        if self._stop.requested and state in (State.RUNNING, State.PAUSING):
            self._life.enter(State.STOPPING, f"{self._stop.reason}; the position under way is finished first")
        elif self._stop.pause_requested and state is State.RUNNING:
            self._life.enter(State.PAUSING, "a pause was asked for; the position under way is finished first")
        elif not self._stop.pause_requested and state is State.PAUSING:
            self._life.enter(State.RUNNING, "the pause was taken back")

    def pause(self) -> None:
        """Stand still until a person says to go on, or to stop: StoppedWhileWaitingError."""
        self._rest()
        self._life.enter(State.PAUSED, "paused by the user: outputs muted, mirror parked; wavefocus go-on, or stop")
        while self._stop.pause_requested:
            if self._stop.requested:
                raise StoppedWhileWaitingError(f"{self._stop.reason} while paused")
            # A person's time is the wall's, whatever clock the rig lives by.
            self._stop.wait_for_news(LOOKED_FOR_S)
        self._life.enter(State.RUNNING, "the user says to go on")

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
        watch, clock = self._conditions.watch, self._setup.instruments.clock
        if self._stop.requested:  # nothing to wait for: the position under way cannot be finished as it is
            raise StoppedWhileWaitingError(f"{self._stop.reason}; the position under way is not kept: {reason}")
        self._rest()
        self._life.enter(State.SUSPENDED, reason)
        since_s, back_since_s = clock.now_s(), None
        while True:
            settles_s = None if back_since_s is None else back_since_s + self._conditions.settle_s - clock.now_s()
            if settles_s is not None and settles_s <= 0:
                break
            self._wait(watch.probe_every_s if settles_s is None else min(settles_s, watch.probe_every_s))
            if self._stop.pause_requested:
                self.pause()
                return
            values = self._probe(attempt)
            back = self._conditions.are_back(values)
            self._session.conditions(values, self._conditions.left(values) or reason, back=back)
            back_since_s = (clock.now_s() if back_since_s is None else back_since_s) if back else None
            waited_s = clock.now_s() - since_s
            if not back and waited_s >= watch.give_up_after_s:
                raise SuspendedTooLongError(
                    f"suspended for {hours(waited_s)}: {reason}; it was not back within watch.give_up_after_s; "
                    "put it right (light on the spot, cables, room)"
                )
        self._life.enter(State.RUNNING, f"all conditions are back after {hours(clock.now_s() - since_s)}")

    def _probe(self, attempt: Attempt) -> Mapping[str, float]:
        """The conditions now, from one record at the last good position; where there is none, at the present one."""
        position = attempt.position if self._last_good is None else self._last_good
        probing = Attempt(position, attempt.number, attempt.of_session)
        try:
            recording = self._recovery.until_done(
                lambda: self._records.probe(probing), probing.position, probing.number
            )
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

    def _wait(self, seconds: float) -> None:
        """Let time pass on the rig's clock, in slices between which requests are looked for."""
        left_s = max(0.0, seconds)
        while left_s > 0 and not self._stop.pause_requested:
            if self._stop.requested:
                raise StoppedWhileWaitingError(f"{self._stop.reason} while suspended")
            self._setup.instruments.clock.sleep(min(left_s, LOOKED_FOR_S))
            left_s -= LOOKED_FOR_S

    def _report_mute_sensors(self, attempt: Attempt) -> None:
        """Publish sensors that do not answer; measuring goes on without them."""
        for failure in self._conditions.mute.values():
            self._session.fault(failure, attempt, retried=True)
