"""Interruptions of a session: lost instruments are reconnected, pauses and unfit conditions are waited out."""

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from wavefocus.acquisition.attempt import Attempt, Play
from wavefocus.acquisition.engine.session import LOOKED_FOR_S, Session
from wavefocus.acquisition.setup import Setup, naming_role, silence, to_lost_error
from wavefocus.acquisition.wording import hours
from wavefocus.calibration.excitation import Excitation
from wavefocus.config.messages.campaign import ConditionsSeen, ReconnectTried, State
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError, UnknownFaultError
from wavefocus.drivers.protocols import Recording
from wavefocus.storage.errors import WavefocusError

REFERENCE, NOISE = "reference", "noise"
"""What every record shows by itself; other conditions have sensors."""

# What a vibrometer without light puts out is broad; above this many times the sweep's end nothing else is.
ABOVE_BAND = 1.5
NOISE_SAMPLES = 8192


class Conditions:
    """Finds the values of all watched conditions.

    setup: Whose records they are.
    excitation: Rate and band of what is played.
    """

    def __init__(self, setup: Setup, excitation: Excitation) -> None:
        self.watch, self._setup = setup.watch, setup
        self._rate_hz = excitation.sample_rate_hz
        self._above_hz = ABOVE_BAND * excitation.stop_hz

    def values(
        self, plays: Sequence[Play], recordings: Sequence[Recording], failed: Callable[[InstrumentError], object]
    ) -> dict[str, float]:
        """Values after these records, without those of sensors that do not answer.

        plays, recordings: What was played, and what was recorded of it.
        failed: Called with the failure of each sensor.
        """
        values: dict[str, float] = {}
        if REFERENCE in self.watch.bands:
            levels = [self._reference_db(play, recording) for play, recording in zip(plays, recordings, strict=True)]
            # The value that is farthest outside of its band; the median where all are inside.
            middle, allowed = float(np.median(levels)), self.watch.bands[REFERENCE]
            outside = [level for level in levels if allowed.left(level)]
            values[REFERENCE] = max(outside, key=lambda level: abs(level - middle), default=middle)
        if NOISE in self.watch.bands and self._above_hz < self._rate_hz / 2:
            # Speckle hides the surface for milliseconds of one record; what lasts is in most of them.
            values[NOISE] = float(np.median([self._noise_v(recording) for recording in recordings]))
        for name, sensor in self.watch.sensors.items():
            try:
                values[name] = sensor()
            except InstrumentError as failure:
                failed(failure)
        return values

    def left(self, values: Mapping[str, float]) -> str:
        """Which conditions have left their bands, in words; empty where none has."""
        reasons = (self.watch.bands[name].left(value) for name, value in values.items())
        return "; ".join(reason for reason in reasons if reason)

    @property
    def settle_s(self) -> float:
        """The longest settling time of all bands."""
        return max((allowed.band.settle_s for allowed in self.watch.bands.values()), default=0.0)

    def _reference_db(self, play: Play, recording: Recording) -> float:
        """Energy of the reference over that of the loopback's signal, in what counts of the record."""
        signal_v = play.signals_v[self._setup.loopback_channel]
        expected = float(np.sum(np.square(signal_v)))
        if play.used is not None:
            expected *= recording.volts.shape[1] / len(signal_v)
        energy = float(np.sum(np.square(recording.volts[0], dtype=np.float64)))
        # A silent reference still has a level, so that it can be reported.
        return 10.0 * math.log10(max(energy, 1e-12) / max(expected * self._setup.reference_gain**2, 1e-12))

    def _noise_v(self, recording: Recording) -> float:
        """Rms of white noise as strong as what the response holds above the sweep's band."""
        response_v = recording.volts[1, :NOISE_SAMPLES].astype(np.float64)
        window = np.hanning(len(response_v))
        power = np.abs(np.fft.rfft(window * response_v)) ** 2
        above = power[int(np.ceil(self._above_hz * len(response_v) / self._rate_hz)) :]
        return float(np.sqrt(np.mean(above) / np.sum(window**2))) if len(above) else 0.0


Result = TypeVar("Result")

MAX_BACK_OFF_S = 30.0
# An instrument that says "lost" is believed at once; one that only fails passingly, when it does so again.
PASSING_IN_A_ROW = 2
# Instruments that come back but do not live to the end of one measurement are a loose plug: a person must look.
LOSSES_IN_A_ROW = 10


def back_off_s(number: int) -> float:
    """Seconds to wait before try `number`, counted from 0: 0, 1, 2, 4, ... up to half a minute."""
    return 0.0 if number == 0 else min(MAX_BACK_OFF_S, 2.0 ** min(number - 1, 10))


class Recovery:
    """Brings lost instruments back, for a campaign as for a scan; the session is "recovering" meanwhile."""

    def __init__(self, setup: Setup, session: Session) -> None:
        self._setup, self._session, self._clock = setup, session, session.clock
        # All four are forgotten when a measurement comes to its end.
        self._tries: Counter[str] = Counter()
        self._unknown: set[str] = set()
        self._passing: Counter[str] = Counter()
        self._losses = 0

    def retry_after_reconnect(self, measure: Callable[[], Result], attempt: Attempt | None = None) -> Result:
        """Measure, from the beginning again after each instrument that was lost and came back.

        measure: Points, plays and records; what it did before an interruption must not matter.
        attempt: What is measured, for the events.

        Raises StoppedWhileWaitingError: a person asked for a stop. InstrumentLostError: the instrument did not come
        back in time, or did not stay; or its failure is unknown to its driver and recurred after one fresh connection.
        InstrumentError: any other failure, at once; passing ones are for `renew_if_repeated`.
        """
        while True:
            try:
                result = measure()
            except InstrumentLostError as lost:
                if not lost.role:
                    raise  # nobody noted whose it was, so nobody can be asked for a fresh connection
                self._allow_once(lost)
                self._session.fault(lost, attempt, retried=True)
                self._bring_back(lost)
            else:
                self._tries.clear()
                self._unknown.clear()
                self._passing.clear()
                self._losses = 0
                return result

    def renew_if_repeated(self, fault: TransientInstrumentError) -> None:
        """Give an instrument a fresh connection when it fails passingly again and again.

        Raises as `retry_after_reconnect`.
        """
        self._passing[fault.role] += 1
        if self._passing[fault.role] >= PASSING_IN_A_ROW:
            self._bring_back(fault)

    def _allow_once(self, failure: InstrumentError) -> None:
        """Note a failure that its driver does not know; raises it where it recurs."""
        if isinstance(failure, UnknownFaultError):
            if failure.role in self._unknown:
                raise to_lost_error(failure, f"{failure.cause}; again after a fresh connection") from failure
            self._unknown.add(failure.role)

    def _bring_back(self, failure: InstrumentError) -> None:
        """Silence the rig and wait until all that was lost is connected again."""
        self._losses += 1
        if self._losses > LOSSES_IN_A_ROW:
            cause = f"{failure.cause}, also after {LOSSES_IN_A_ROW} fresh connections in a row"
            raise to_lost_error(failure, cause) from failure
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
                raise to_lost_error(also, f"{also.cause}; not cured within {hours(away_s)}") from also
        self._session.enter(came_from, f"{failure.instrument} is connected again after {hours(away_s)}")

    def _silence(self, lost: dict[str, InstrumentError]) -> None:
        """Mute the player and drop the record; an instrument that cannot be silenced is lost, too."""
        for failure in silence(self._setup):
            lost.setdefault(failure.role, failure)

    def _reconnect(self, role: str, failure: InstrumentError, since_s: float, gives_up_wall_s: float) -> None:
        """Try for a fresh connection until there is one, a person stops it or the time is over, on either clock.

        Hung calls count against wall-clock time, even on a virtual clock.
        """
        until_s = since_s + self._setup.recovery_s
        while True:
            wait_s = min(back_off_s(self._tries[role]), until_s - self._clock.now_s())
            self._session.wait(wait_s, f" while {failure.instrument} was gone")
            self._tries[role] += 1
            try:
                getattr(self._setup, role).reconnect()
            except (InstrumentLostError, TransientInstrumentError) as absent:
                if isinstance(failure, UnknownFaultError) and isinstance(absent, UnknownFaultError):
                    absent.role = role
                    self._allow_once(absent)
                left_s = round(until_s - self._clock.now_s(), 3)  # slices of time do not add up exactly
                if time.monotonic() >= gives_up_wall_s:
                    left_s = 0.0
                self._publish_try(failure, absent.cause, left_s)
                if left_s <= 0:
                    wall_s = time.monotonic() - gives_up_wall_s + self._setup.recovery_s
                    waited = hours(max(self._clock.now_s() - since_s, wall_s))
                    tries = f"{self._tries[role]} tries (last: {absent.cause})"
                    raise to_lost_error(failure, f"{failure.cause}; not back within {waited}, {tries}") from absent
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


class SuspendedTooLongError(WavefocusError):
    """A watched condition left its band and did not come back."""


class Suspension:
    """Pauses and suspends a session, outputs muted and the mirror parked.

    excitation: Rate and band of `plays`.
    probe: Takes one record of the first of `plays` at a position.
    """

    def __init__(
        self,
        setup: Setup,
        session: Session,
        excitation: Excitation,
        plays: tuple[Play, ...],
        probe: Callable[[Attempt], Recording],
    ) -> None:
        self._setup, self._session, self._stop = setup, session, session.stop
        self._conditions, self._plays, self._probed = Conditions(setup, excitation), plays, probe
        self._last_good: Attempt | None = None

    def pause(self) -> None:
        """Stand still until a person says to go on, or to stop: StoppedWhileWaitingError."""
        self._rest()
        self._session.enter(State.PAUSED, "paused by the user: outputs muted, mirror parked")
        while self._stop.pause_requested:
            self._session.require_no_stop(" while paused")
            # A person's time is the wall's, whatever clock the rig lives by.
            self._stop.wait_for_news(LOOKED_FOR_S)
        self._session.enter(State.RUNNING, "the user says to go on")

    def take_under_conditions(
        self, attempt: Attempt, take: Callable[[], tuple[Recording, ...]]
    ) -> tuple[Recording, ...]:
        """Records of an attempt, taken again after each suspension.

        A condition that has left its band at only one position (a dark spot) is for the point quality to judge: where
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
        plays = self._plays * (len(recordings) // len(self._plays))
        reason = self._conditions.left(self._values(attempt, plays, recordings))
        good = self._last_good
        if not reason:
            self._last_good = attempt
        elif good and good.position != attempt.position and not self._conditions.left(self._probe(attempt)):
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
            back = all(watch.bands[name].is_back(value) for name, value in values.items())
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
        place = self._last_good or attempt
        probing = Attempt(place.position, attempt.number, attempt.of_session, place.moved_mm)
        try:
            recording = self._probed(probing)
        except InstrumentError as failure:
            self._session.fault(failure, probing, retried=False)
            raise
        return self._values(attempt, self._plays[:1], [recording])

    def _values(self, attempt: Attempt, plays: Sequence[Play], recordings: Sequence[Recording]) -> Mapping[str, float]:
        """Publish sensors that do not answer; measuring goes on without them."""
        return self._conditions.values(
            plays, recordings, lambda failure: self._session.fault(failure, attempt, retried=True)
        )

    def _rest(self) -> None:
        """Mute and park; an instrument that fails at that is met again, and waited for, when it is needed."""
        failures = silence(self._setup)
        try:
            with naming_role("mirror"):
                self._setup.mirror.park()
        except InstrumentError as failure:
            failures.append(failure)
        for fault in failures:
            self._session.fault(fault, None, retried=True)
