"""What a session tells of itself: clock, counts and the events that carry them."""

from __future__ import annotations

import numpy as np

from acquisition.attempt import Attempt, AttemptResult
from acquisition.events import (
    Drift,
    Fault,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    SessionEnded,
    SessionStarted,
    State,
    Subscriber,
)
from acquisition.plan import Plan
from acquisition.quality import status_counts
from acquisition.sentinel import DriftFigures
from acquisition.setup import Setup
from acquisition.states import Lifecycle
from calibration.bank_writer import BankWriter
from drivers.errors import InstrumentError


class Session:
    """Publishes the events of one session, timed by its lifecycle.

    Parameters
    ----------
    plan : Plan
        What is measured.
    setup : Setup
        With what.
    bank : BankWriter
        Where it goes; its status is what counts as done.
    life : Lifecycle
        The session's state and time.
    publish : callable
        Receives every event.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, life: Lifecycle, publish: Subscriber) -> None:
        self._plan = plan
        self._setup = setup
        self._bank = bank
        self._life = life
        self._publish = publish
        self._settled = 0

    def start(self, to_do: int, instruments: tuple[str, ...]) -> None:
        """Tell that the session begins, with which instruments and how much to do."""
        self._publish(
            SessionStarted(
                self._life.time_s(),
                str(self._bank.path),
                self._plan.positions,
                self._plan.actuators,
                self._done(),
                to_do,
                to_do * self._plan.position_s(self._setup),
                instruments,
            )
        )
        self._life.enter(State.RUNNING, f"{to_do} positions to do")

    def begin(self, attempt: Attempt) -> None:
        """Tell that an attempt's first record begins."""
        x_mm, y_mm = (float(value) for value in self._plan.position_mm[attempt.position])
        self._publish(PositionStarted(self._life.time_s(), attempt.position, attempt.number, x_mm, y_mm))

    def repeat(self, result: AttemptResult) -> None:
        """Tell that an attempt was not good enough."""
        attempt = result.attempt
        self._publish(PositionRepeated(self._life.time_s(), attempt.position, attempt.number, result.judgement.reason))

    def settle(self, result: AttemptResult, left: int) -> None:
        """Tell that a position is done with for this session, and how far the session is."""
        position = result.attempt.position
        if result.committed:
            self._publish(
                PositionCommitted(
                    self._life.time_s(),
                    position,
                    int(result.judgement.status),
                    int(self._bank.attempts[position]),
                    result.median_snr_db,
                    result.best_heard_residual_db,
                    result.clock_ppm,
                    result.start_offset_samples,
                )
            )
        else:
            self._publish(PositionKept(self._life.time_s(), position, result.attempt.number, result.judgement.reason))
        self._settled += 1
        self._progress(left)

    def fault(self, fault: InstrumentError, attempt: Attempt, *, retried: bool) -> None:
        """Tell that an instrument failed."""
        self._publish(
            Fault(
                self._life.time_s(),
                fault.instrument,
                fault.operation,
                fault.cause,
                fault.remedy,
                attempt.position,
                attempt.number,
                retried,
            )
        )

    def drift(self, position: int, figures: DriftFigures) -> None:
        """Tell how the sentinel position compares with what the bank holds of it."""
        self._publish(
            Drift(
                self._life.time_s(),
                position,
                figures.level_db,
                figures.delay_samples,
                figures.correlation,
                figures.verdict,
            )
        )

    def end(self, state: State, reason: str) -> SessionEnded:
        """Tell that the session is over, and how."""
        self._life.enter(state, reason)
        ended = SessionEnded(
            self._life.time_s(), state, self._done(), self._plan.positions, status_counts(self._bank.status)
        )
        self._publish(ended)
        return ended

    def _progress(self, left: int) -> None:
        # An outage says nothing of how long the other positions will take.
        working_s, working_wall_s = self._life.working_s()
        per_position_s = working_s / self._settled
        self._publish(
            Progress(
                self._life.time_s(),
                self._done(),
                self._plan.positions,
                self._life.time_s(),
                left * per_position_s,
                left * working_wall_s / self._settled,
                3600.0 / per_position_s if per_position_s > 0 else 0.0,
            )
        )

    def _done(self) -> int:
        return int(np.count_nonzero(self._bank.status))
