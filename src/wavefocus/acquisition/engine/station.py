"""Measures positions of a plan: points, plays, records and estimates; and one position by both schedules."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from wavefocus.acquisition.attempt import (
    Attempt,
    AttemptResult,
    Play,
    Recorded,
    channels_of,
    plays_of,
    position_estimator,
    record_play,
)
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.judgement import Judgement, in_band, judge
from wavefocus.acquisition.plan import Plan, row_error_db, schedule_name
from wavefocus.acquisition.setup import Setup, point_at, start_move
from wavefocus.acquisition.wording import hours
from wavefocus.calibration.estimator.estimate import Estimate, mean_estimate
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.config.messages.campaign import ScheduleSettled, Subscriber
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.errors import InputError


class Station:
    """A rig with what is played on it; one session's.

    reference_before_db: Level of the reference before a position, see `wavefocus.acquisition.judgement.judge`.
    """

    def __init__(
        self,
        plan: Plan,
        setup: Setup,
        session: Session,
        reference_before_db: Callable[[int], float | None] = lambda position: None,
    ) -> None:
        self.plan, self.setup, self.session = plan, setup, session
        self.plays, self._estimator = plays_of(plan, setup), position_estimator(plan, channels_of(setup))
        self.recovery = Recovery(setup, session)
        self._reference_before_db = reference_before_db

    def take(
        self, attempt: Attempt, purpose: str, taken: Callable[[int], None] = lambda record: None
    ) -> tuple[Recording, ...]:
        """Point at a position and take all its records, of a check position several times.

        From the first again after a lost instrument.

        attempt: Which position, and which try at it.
        purpose: ``"capture"`` or ``"sentinel"``, for the instruments' logs.
        taken: Called with the number of each record, from 1, once it is in.

        Raises InstrumentError: of the instrument that failed; a passing fault only when repeated records did not cure
        it.
        """

        def measure() -> tuple[Recording, ...]:
            point_at(self.setup, *self._place_mm(attempt))
            recordings: list[Recording] = []
            for look in range(self.plan.looks(attempt.position)):
                for play in self.plays:
                    recordings.append(self._record(play, attempt, purpose, look))
                    taken(len(recordings))
            return tuple(recordings)

        return self.recovery.retry_after_reconnect(measure, attempt)

    def probe(self, attempt: Attempt) -> Recording:
        """Point at a position and take one record, to see how things stand; it goes nowhere. Raises as `take`."""

        def measure() -> Recording:
            point_at(self.setup, *self._place_mm(attempt))
            return self._record(self.plays[0], attempt, "probe")

        return self.recovery.retry_after_reconnect(measure, attempt)

    def set_out_for(self, attempt: Attempt) -> None:
        """Let the mirror set out for a position; when it fails, pointing there will meet that again."""
        try:
            start_move(self.setup, *self._place_mm(attempt))
        except InstrumentError as fault:
            self.session.fault(fault, attempt, retried=True)

    def _place_mm(self, attempt: Attempt) -> tuple[float, float]:
        """Where the beam goes for an attempt."""
        x_mm, y_mm = self.plan.position_mm[attempt.position]
        return float(x_mm) + attempt.moved_mm[0], float(y_mm) + attempt.moved_mm[1]

    def _record(self, play: Play, attempt: Attempt, purpose: str, look: int = 0) -> Recording:
        record = play.actuator + look * self.plan.actuators
        label = RecordLabel(attempt.position, attempt.number, record, purpose)
        setup, rate_hz = replace(self.setup, range_v=self._range_v(attempt)), self.plan.excitation.sample_rate_hz
        return record_play(setup, play, rate_hz, label, lambda fault: self.session.fault(fault, attempt, retried=True))

    def _range_v(self, attempt: Attempt) -> tuple[float, float]:
        """Input ranges in volts of (reference, response); an attempt may have a larger one."""
        reference_v, response_v = self.setup.range_v
        return reference_v, response_v if attempt.response_range_v is None else attempt.response_range_v

    def evaluate(self, recorded: Recorded) -> AttemptResult:
        """Estimate the Green's functions of an attempt and judge them.

        An attempt without recordings because of a fault, or whose reference cannot be found, is judged
        ``Status.FAILED``: nothing of it can be used.
        """
        attempt, recordings = recorded.attempt, recorded.recordings
        if not recordings:
            return AttemptResult(attempt, None, Judgement(Status.FAILED, recorded.fault, np.inf))
        reference_v, response_v = np.stack([one.volts for one in recordings], axis=1)
        count, range_v = self.plan.records, self._range_v(attempt)
        looks = [slice(low, low + count) for low in range(0, len(recordings), count)]
        try:
            estimate = mean_estimate(
                [self._estimator.estimate(reference_v[one], response_v[one], range_v=range_v) for one in looks]
            )
        except ReferenceMissingError as missing:
            judgement = Judgement(Status.FAILED, str(missing), np.inf)
            return AttemptResult(attempt, None, judgement, recordings=recordings)
        over_range = any(any(recording.over_range) for recording in recordings)
        distance_mm = np.hypot(*(self.plan.actuator_mm - self.plan.position_mm[attempt.position]).T)
        before_db = self._reference_before_db(attempt.position)
        judgement = judge(estimate, over_range, self.plan.quality, distance_mm, before_db)
        return AttemptResult(attempt, estimate, judgement, recordings=recordings)

    def measure(self, attempt: Attempt, purpose: str, is_useless: Callable[[AttemptResult], bool]) -> AttemptResult:
        """Measure a position, again after passing faults and useless results, until its tries are used up.

        Raises InstrumentError: of the instrument that failed.
        """
        while True:
            last = attempt.of_session >= self.plan.quality.max_attempts
            try:
                recordings = self.take(attempt, purpose)
            except TransientInstrumentError as fault:
                self.session.fault(fault, attempt, retried=not last)
                if last:
                    raise
                self.recovery.renew_if_repeated(fault)
            else:
                result = self.evaluate(Recorded(attempt, recordings))
                if last or not is_useless(result):
                    return result
            attempt = attempt.next()


def compare_schedules(plan: Plan, setup: Setup, publish: Subscriber = lambda event: None) -> ScheduleSettled:
    """Measure one position by a staggered plan and one actuator after the other.

    Errors are medians over the actuators: relative L2 difference in band of the rows, and what the noise of sequential
    capture explains of it.

    publish: Receives every passing fault, and what is done about it, as in a campaign.

    Raises InputError: sequential sweeps show responses longer than the taps, or no attempt has a usable reference.
    InstrumentError: an instrument failed for good.
    """
    clock, sweep = setup.clock, plan.excitation
    # The position nearest to the middle of the grid.
    middle = (plan.position_mm.min(axis=0) + plan.position_mm.max(axis=0)) / 2
    position = int(np.argmin(np.hypot(*(plan.position_mm - middle).T)))
    began_s, session = clock.now_s(), Session(clock, publish, StopRequest())
    plans = plan, replace(plan, staggered=None)
    asked, plain = (
        _measured(Station(one, setup, session), Attempt(position, number, 1)) for number, one in enumerate(plans, 1)
    )
    rows, others = (in_band(one.green, sweep.sample_rate_hz, sweep.band_hz) for one in (plain, asked))
    apart = np.linalg.norm(others - rows, axis=1) / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    noise_db = float(np.median(row_error_db(plans[1], plain.snr_db)))
    error_db = 20 * math.log10(max(float(np.median(apart)), 1e-15)), noise_db
    looks = plan.looks(*range(plan.positions))
    names, seconds = zip(*((schedule_name(one), looks * one.position_s(setup)) for one in plans), strict=True)
    sentence = (
        f"{names[0]} differs from {names[1]} by {error_db[0]:.1f} dB at position {position}, where noise explains "
        f"{error_db[1]:.1f} dB; the campaign takes {hours(seconds[0])} instead of {hours(seconds[1])}"
    )
    candidates = tuple(
        {"name": name, "error_db": error, "campaign_s": campaign_s}
        for name, error, campaign_s in zip(names, error_db, seconds, strict=True)
    )
    return ScheduleSettled(clock.now_s() - began_s, position, names[0], sentence, seconds[0] / 3600, candidates)


def _measured(station: Station, attempt: Attempt) -> Estimate:
    def is_spoilt(found: AttemptResult) -> bool:
        return found.estimate is None or any(any(recording.over_range) for recording in found.recordings)

    result = station.measure(attempt, "trial", is_spoilt)
    if result.estimate is None:
        raise InputError(f"the position that is measured by both schedules failed: {result.judgement.reason}")
    for defect in result.judgement.defects:
        if defect.name == "tail":
            raise InputError(defect.sentence)
    return result.estimate
