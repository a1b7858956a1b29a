"""What a session tells of itself: clock, counts and the events that carry them."""

from __future__ import annotations

import time

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
    StateChanged,
    Subscriber,
)
from acquisition.plan import Plan
from acquisition.quality import status_counts
from acquisition.sentinel import DriftFigures
from acquisition.setup import Setup
from calibration.bank_writer import BankWriter
from drivers.errors import InstrumentError


class Session:
    """Publishes the events of one session, timed from its start by the rig's clock.

    Parameters
    ----------
    plan : Plan
        What is measured.
    setup : Setup
        With what.
    bank : BankWriter
        Where it goes; its status is what counts as done.
    publish : callable
        Receives every event.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, publish: Subscriber) -> None:
        self._plan = plan
        self._setup = setup
        self._bank = bank
        self._publish = publish
        self._clock = setup.instruments.clock
        self._started_s = self._clock.now_s()
        self._started_wall_s = time.monotonic()
        self._settled = 0

    def start(self, to_do: int) -> None:
        """Tell that the session begins, with which instruments and how much to do."""
        self._started_s, self._started_wall_s = self._clock.now_s(), time.monotonic()
        roles = self._setup.instruments
        self._publish(
            SessionStarted(
                self._time_s(),
                str(self._bank.path),
                self._plan.positions,
                self._plan.actuators,
                self._done(),
                to_do,
                to_do * self._plan.position_s(self._setup),
                (roles.mirror.identify(), roles.recorder.identify(), roles.player.identify()),
            )
        )
        self._publish(StateChanged(self._time_s(), State.RUNNING, f"{to_do} positions to do"))

    def begin(self, attempt: Attempt) -> None:
        """Tell that an attempt's first record begins."""
        x_mm, y_mm = (float(value) for value in self._plan.position_mm[attempt.position])
        self._publish(PositionStarted(self._time_s(), attempt.position, attempt.number, x_mm, y_mm))

    def repeat(self, result: AttemptResult) -> None:
        """Tell that an attempt was not good enough."""
        attempt = result.attempt
        self._publish(PositionRepeated(self._time_s(), attempt.position, attempt.number, result.judgement.reason))

    def settle(self, result: AttemptResult, left: int) -> None:
        """Tell that a position is done with for this session, and how far the session is."""
        position = result.attempt.position
        if result.committed:
            self._publish(
                PositionCommitted(
                    self._time_s(),
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
            self._publish(PositionKept(self._time_s(), position, result.attempt.number, result.judgement.reason))
        self._settled += 1
        self._progress(left)

    def fault(self, fault: InstrumentError, attempt: Attempt, *, retried: bool) -> None:
        """Tell that an instrument failed."""
        self._publish(
            Fault(
                self._time_s(),
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
                self._time_s(),
                position,
                figures.level_db,
                figures.delay_samples,
                figures.correlation,
                figures.verdict,
            )
        )

    def end(self, state: State, reason: str) -> SessionEnded:
        """Tell that the session is over, and how."""
        self._publish(StateChanged(self._time_s(), state, reason))
        ended = SessionEnded(
            self._time_s(), state, self._done(), self._plan.positions, status_counts(self._bank.status)
        )
        self._publish(ended)
        return ended

    def _progress(self, left: int) -> None:
        elapsed_s = self._time_s()
        per_position_s = elapsed_s / self._settled
        wall_s = (time.monotonic() - self._started_wall_s) / self._settled
        self._publish(
            Progress(
                elapsed_s,
                self._done(),
                self._plan.positions,
                elapsed_s,
                left * per_position_s,
                left * wall_s,
                3600.0 / per_position_s if per_position_s > 0 else 0.0,
            )
        )

    def _time_s(self) -> float:
        return self._clock.now_s() - self._started_s

    def _done(self) -> int:
        return int(np.count_nonzero(self._bank.status))
