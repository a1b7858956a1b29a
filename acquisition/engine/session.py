"""Events, counts and remaining time of one session."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from acquisition.engine.events import (
    ConditionsSeen,
    Drift,
    Fault,
    PassStarted,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    RecordTaken,
    SessionEnded,
    SessionStarted,
    State,
    Subscriber,
)
from acquisition.engine.states import Lifecycle
from acquisition.measuring.attempt import Attempt, AttemptResult
from acquisition.measuring.setup import Setup
from acquisition.quality.judgement import Judgement
from acquisition.quality.limits import DriftFigures
from acquisition.schedule.pace import Pace
from acquisition.schedule.plan import Plan, sentinel_of
from drivers.errors import InstrumentError
from storage.bank.writer import BankWriter
from storage.point_status import status_counts


class Session:
    """Publishes the events of one session, timed by its lifecycle.

    bank: Its status is what counts as done.
    life: The session's state and time.
    publish: Receives every event.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, life: Lifecycle, publish: Subscriber) -> None:
        self._plan, self._setup, self._bank, self._life, self._publish = plan, setup, bank, life, publish
        self._pace = Pace(0.0), Pace(0.0)
        self._recording = False
        self._second_looks = 0

    def start(self, rows: NDArray[np.int64], instruments: tuple[str, ...], *, second_looks: bool) -> None:
        """The session begins, with these rows to do, and perhaps with second looks to come after them."""
        self._second_looks = self._plan.second_looks(rows) if second_looks else 0
        size = self._plan.positions, self._plan.actuators, self._done(), len(rows)
        planned_s = self._plan.campaign_s(rows, self._setup)
        self._publish(SessionStarted(self._life.time_s(), str(self._bank.path), *size, planned_s, instruments))
        self._life.enter(State.RUNNING, f"{len(rows)} positions to do")
        rig_s, wall_s = self._life.working_s()
        self._pace = Pace(rig_s), Pace(wall_s)

    def begin(self, attempt: Attempt) -> None:
        """An attempt's first record begins."""
        x_mm, y_mm = (float(value) for value in self._plan.position_mm[attempt.position])
        self._recording = True
        self._publish(PositionStarted(self._life.time_s(), attempt.position, attempt.number, x_mm, y_mm))

    def record_taken(self, attempt: Attempt, record: int, records: int) -> None:
        """A record of an attempt is in, `record` counted from 1."""
        if records > 1:
            self._publish(RecordTaken(self._life.time_s(), attempt.position, attempt.number, record, records))

    def measures_again(self, positions: tuple[int, ...]) -> None:
        """A pass over all that is not valid begins."""
        self._second_looks = 0  # from here on they are among those that are left
        self._publish(PassStarted(self._life.time_s(), positions))

    def attempt_recorded(self) -> None:
        """The attempt that was begun has all its records, or was given up."""
        self._recording = False
        for pace, working_s in zip(self._pace, self._life.working_s(), strict=True):
            pace.attempt_done(working_s)

    def repeat(self, result: AttemptResult, following: Attempt) -> None:
        """An attempt was not good enough; the next one follows."""
        why = result.attempt.position, result.attempt.number, result.judgement.reason, result.defect_names
        self._publish(PositionRepeated(self._life.time_s(), *why, following.response_range_v, following.moved_mm))

    def position_done(self, result: AttemptResult, left: int) -> None:
        """A position is done with for this session; `left` are not begun yet."""
        attempt, reason, names = result.attempt, result.judgement.reason, result.defect_names
        if result.committed:
            figures = result.median_snr_db, result.best_heard_residual_db, result.clock_ppm, result.start_offset_samples
            tried = attempt.response_range_v, attempt.moved_mm
            self._committed(attempt.position, result.judgement, figures, names, *tried)
        else:
            self._publish(PositionKept(self._life.time_s(), attempt.position, attempt.number, reason, names))
        for pace in self._pace:
            pace.position_settled(attempt.of_session)
        self._progress(left)

    def marked(self, position: int, judgement: Judgement) -> None:
        """A position's row in the bank is poor now: its neighbours contradict it, or cannot judge it."""
        self._committed(position, judgement, (math.nan,) * 4, tuple(one.name for one in judgement.defects))

    def fault(self, fault: InstrumentError, attempt: Attempt | None, *, retried: bool) -> None:
        """An instrument failed."""
        says = fault.instrument, fault.operation, fault.cause, fault.remedy
        position, number = (None, None) if attempt is None else (attempt.position, attempt.number)
        self._publish(Fault(self._life.time_s(), *says, position, number, retried))

    def drift(self, position: int, figures: DriftFigures, occasion: str, *, suspect: tuple[int, ...] = ()) -> None:
        """The sentinel position was compared with what the bank holds of it."""
        limits, found = self._plan.drift, (figures.level_db, figures.delay_samples, figures.correlation)
        words = figures.verdict(limits), occasion, figures.cause(limits)
        self._publish(Drift(self._life.time_s(), position, *found, *words, suspect))

    def sentinel_done(self) -> None:
        """The sentinel's measurement came to its end; it is no position."""
        for pace, working_s in zip(self._pace, self._life.working_s(), strict=True):
            pace.sentinel_done(working_s)

    def conditions(self, values: Mapping[str, float], reason: str, *, back: bool) -> None:
        """The watched conditions were looked at."""
        self._publish(ConditionsSeen(self._life.time_s(), dict(values), back, reason))

    def end(self, state: State, reason: str, failure: str = "") -> SessionEnded:
        """The session is over."""
        self._life.enter(state, reason)
        counts = status_counts(self._bank.status)
        ended = SessionEnded(self._life.time_s(), state, self._done(), self._plan.positions, counts, failure)
        self._publish(ended)
        return ended

    def _committed(
        self,
        position: int,
        judgement: Judgement,
        figures: tuple[float, float, float, float],
        names: tuple[str, ...],
        response_range_v: float | None = None,
        moved_mm: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        counts = position, int(judgement.status), int(self._bank.attempts[position])
        tried = response_range_v, moved_mm
        self._publish(PositionCommitted(self._life.time_s(), *counts, *figures, judgement.reason, names, *tried))

    def _progress(self, left: int) -> None:
        left += self._second_looks
        (rig, wall), (rig_s, wall_s) = self._pace, self._life.working_s()
        passes = 0
        if sentinel_of(self._plan, self._bank.status) is not None:
            passes = self._plan.drift.passes(left, rig.position_s)
        remaining_s = rig.remaining_s(left, passes, rig_s if self._recording else None)
        wall_remaining_s = wall.remaining_s(left, passes, wall_s if self._recording else None)
        per_hour = [3600.0 / one.position_s if one.position_s > 0 else 0.0 for one in (rig, wall)]
        now_s, done = self._life.time_s(), (self._done(), self._plan.positions)
        self._publish(Progress(now_s, *done, now_s, remaining_s, wall_remaining_s, *per_hour))

    def _done(self) -> int:
        return int(np.count_nonzero(self._bank.status))
