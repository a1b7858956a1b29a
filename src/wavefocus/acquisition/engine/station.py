"""Measures positions of a plan: points, plays, records and estimates, and waits for instruments that are lost."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wavefocus.acquisition.attempt import Attempt, AttemptResult, PositionRecords, Recorded, evaluate
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.session import Session
from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.plays import measuring_of
from wavefocus.acquisition.setup import Setup
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Recording


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
        measuring = measuring_of(plan, setup)
        self.plan, self.setup, self.session = plan, setup, session
        self.recovery = Recovery(setup, session)
        self.records = PositionRecords(plan, setup, measuring.plays, session.fault)
        self._estimator, self._reference_before_db = measuring.estimator, reference_before_db

    def take(
        self, attempt: Attempt, purpose: str, taken: Callable[[int], None] = lambda record: None
    ) -> tuple[Recording, ...]:
        """All records of an attempt, see `PositionRecords.take`; from the first again after a lost instrument."""
        return self.recovery.retry_after_reconnect(lambda: self.records.take(attempt, purpose, taken), attempt)

    def evaluate(self, recorded: Recorded) -> AttemptResult:
        """Estimate an attempt and judge it."""
        position = recorded.attempt.position
        distance_mm = np.hypot(*(self.plan.actuator_mm - self.plan.position_mm[position]).T)
        before_db = self._reference_before_db(position)
        return evaluate(recorded, self._estimator, self.setup.range_v, self.plan.quality, distance_mm, before_db)

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
                result = self.evaluate(Recorded(attempt, recordings, ""))
                if last or not is_useless(result):
                    return result
            attempt = attempt.next()
