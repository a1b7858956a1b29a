"""The engine: walks a plan through the instruments into a bank."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from acquisition.engine.events import EventPublisher, SessionEnded, State, Subscriber, failure_kind
from acquisition.engine.measuring import PositionRecords
from acquisition.engine.recovery import Recovery
from acquisition.engine.session import Session
from acquisition.engine.states import Lifecycle
from acquisition.engine.stop_signals import StoppedWhileWaitingError, StopRequest
from acquisition.engine.suspension import StandBy
from acquisition.measuring.attempt import (
    Attempt,
    AttemptResult,
    Recorded,
    attempts_again,
    commit_attempt,
    evaluate,
    first_attempts,
    is_final,
    is_futile,
    next_attempt,
    row_of,
)
from acquisition.measuring.plays import measuring_of
from acquisition.measuring.raw_keeping import MEASURED
from acquisition.measuring.setup import Setup, names_of
from acquisition.quality.agreement import Row, difference, in_band
from acquisition.quality.conditions import Conditions
from acquisition.quality.drift_watch import DriftWatch
from acquisition.quality.judgement import differing
from acquisition.quality.neighbour_watch import UNCONFIRMED, NeighbourWatch
from acquisition.schedule.plan import Plan
from calibration.blas import one_blas_thread
from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.protocols import Recording
from storage.bank.writer import BankWriter
from storage.point_status import Status
from storage.raw.writer import RawWriter

# As many positions in a row without one good record mean a broken instrument, not a bad spot.
FAILED_IN_A_ROW = 3


class Campaign:
    """One session of a campaign, from the first position to do to the last or to a stop.

    While a position is recorded, the estimate, the judgement and the commit of the
    one before run in a second thread; the mirror moves on as soon as the last sample of
    a position is in. An instrument that is lost is waited for, and the attempt that it interrupted
    is taken again from its first record, as if nothing had been.

    Parameters
    ----------
    plan : Plan
        What to measure.
    setup : Setup
        With what.
    bank : BankWriter
        Open for writing; its status says what is committed.
    publish : callable
        Receives every event, in order, in the thread that calls :meth:`run`. If it fails, that is reported once,
        and the campaign goes on.
    stop : StopRequest
        Where a person asks for a stop.
    raw : RawWriter, optional
        Open for writing; keeps the recordings of what goes into the bank.
    """

    def __init__(
        self,
        plan: Plan,
        setup: Setup,
        bank: BankWriter,
        publish: Subscriber,
        stop: StopRequest,
        *,
        raw: RawWriter | None = None,
    ) -> None:
        self._plan = plan
        self._setup = setup
        self._bank = bank
        self._raw = raw
        publish = EventPublisher({"a subscriber of the campaign's events": publish})
        self._life = Lifecycle(setup.instruments.clock, publish)
        self._session = Session(plan, setup, bank, self._life, publish)
        self._recovery = Recovery(setup, self._life, publish, stop)
        self._stop = stop
        measuring = measuring_of(plan, setup)
        self._estimator = measuring.estimator
        self._records = PositionRecords(plan, setup, measuring.plays, self._session)
        self._drift = DriftWatch(plan, bank, self._life, self._session, self._records, self._recovery, self._evaluate)
        conditions = Conditions(setup.watch, setup, plan.excitation)
        self._stand_by = StandBy(setup, self._life, self._session, stop, conditions, self._records, self._recovery)
        self._neighbours = NeighbourWatch(plan, bank)
        self._queue: deque[Attempt] = deque()
        self._covered = plan.order
        self._passing = self._judged = False
        self._fruitless: frozenset[int] = frozenset()
        self._pending: Future[AttemptResult] | None = None
        self._best: dict[int, AttemptResult] = {}
        self._replaceable: frozenset[int] = frozenset()
        self._failed_in_a_row = 0
        self._last_fault: InstrumentError | None = None

    def run(
        self,
        positions: Sequence[int] | None = None,
        *,
        accept_drift: bool = False,
        replaceable: Collection[int] = (),
    ) -> SessionEnded:
        """Measure what is to do, or the given positions once more; then, in a pass, what did not become valid.

        Parameters
        ----------
        positions : sequence of int, optional
            Bank rows to measure again; by default those not measured yet.
        accept_drift : bool
            Go on although the sentinel position has changed.
        replaceable : collection of int
            Bank rows that are valid and may all the same be replaced by others, which two attempts agree on. A valid
            row is else replaced by one that agrees with it, and by no other.

        Returns
        -------
        SessionEnded
            Also published, as the last event.

        Raises
        ------
        DriftError
            The sentinel position is not what the bank holds; the message says whether anything was added.
        SuspendedTooLongError
            A watched condition left its band and did not come back.
        InstrumentError
            An instrument failed, or was gone, for good; all that was committed is safe.
        """
        self._replaceable = frozenset(replaceable)
        status = self._bank.status
        rows = self._plan.to_do(status) if positions is None else positions
        self._queue = deque(first_attempts(rows, self._bank.attempts))
        again = bool(len(rows)) and bool(np.all(status[rows]))
        if again or np.any(status[np.setdiff1d(self._plan.order, rows)] == 0):
            self._covered = self._plan.order[np.isin(self._plan.order, rows)]
        self._judged = again or self._neighbours.is_done(self._covered)
        state, reason = State.FINISHED, "every position is committed"
        try:
            names = self._recovery.until_done(lambda: names_of(self._setup.instruments))
            self._session.start(np.asarray(rows, dtype=np.int64), names, second_looks=not self._judged)
            with one_blas_thread():
                self._mark_by_neighbours()
                if (self._queue or self._due_again()) and not self._stop.requested:
                    self._drift.accept_drift = accept_drift
                    self._drift.check()
                    self._measure_queue()
                    self._mark_by_neighbours()
                    self._measure_again()
            if self._stop.requested and (self._queue or self._due_again()):
                state, reason = State.STOPPED, f"{self._stop.reason} after the position"
        except StoppedWhileWaitingError as stopped:
            state, reason = State.STOPPED, str(stopped)
        except KeyboardInterrupt:
            state, reason = State.STOPPED, "stopped by the user at once"
        except BaseException as failure:
            self._session.end(State.FAILED, str(failure), failure_kind(failure))
            raise
        return self._session.end(state, reason)

    # -- measuring ---------------------------------------------------------------------------

    def _measure_queue(self) -> None:
        """Record every queued attempt while the one before is estimated, judged and committed."""
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate") as worker:
            try:
                while self._goes_on():
                    recorded = self._record_attempt(self._queue.popleft())
                    self._session.attempt_recorded()
                    self._collect()
                    self._pending = worker.submit(self._evaluate_and_commit, recorded)
            finally:
                self._collect()

    def _mark_by_neighbours(self) -> None:
        """Once all is measured: what neighbours contradict, or cannot judge, is poor, and due for another round."""
        if self._judged or self._queue or not np.all(self._bank.status[self._covered]):
            return
        for position, judgement in self._neighbours.mark(self._covered):
            self._session.differs(position, judgement)
        self._judged = True

    def _measure_again(self) -> None:
        """Give everything that is not valid another round, as often as the plan says; the bank knows what had its."""
        while not self._stop.requested and (due := self._due_again()):
            self._passing = True
            self._fruitless = frozenset(one.position for one in due if self._bank.status[one.position] == Status.FAILED)
            self._session.measures_again(tuple(one.position for one in due))
            self._queue = deque(due)
            self._measure_queue()

    def _due_again(self) -> list[Attempt]:
        return attempts_again(self._covered, self._bank.status, self._bank.attempts, self._setup, self._plan.quality)

    def _goes_on(self) -> bool:
        """Whether there is an attempt to record; pauses and the sentinel come between two positions.

        A stop or a pause still lets a position's repeats finish.
        """
        self._stand_by.follow_requests()
        if not self._queue or self._passing or self._drift.due or self._life.state in (State.PAUSING, State.STOPPING):
            self._collect()
        if self._passing and self._queue and self._queue[0].of_session == 1:
            before = self._queue[0].number - 1
            if is_futile(self._covered, self._bank.status, self._bank.attempts, before):
                self._queue.clear()
        if not self._queue or self._queue[0].of_session > 1:
            return bool(self._queue)
        if self._life.state is State.PAUSING:
            self._stand_by.pause()
            self._drift.check_again()
        elif self._drift.due and self._life.state is not State.STOPPING:
            self._drift.check_again()
        self._stand_by.follow_requests()
        return self._life.state is not State.STOPPING

    def _record_attempt(self, attempt: Attempt) -> Recorded:
        """Record all actuators at one position; a passing fault that no repeated record cures costs the attempt."""
        self._session.begin(attempt)
        try:
            recordings = self._take(attempt)
            while self._stand_by.must_repeat(attempt, recordings):
                recordings = self._take(attempt)
        except TransientInstrumentError as fault:
            self._last_fault = fault
            self._session.fault(fault, attempt, retried=attempt.of_session < self._plan.quality.max_attempts)
            self._recovery.renew_if_repeated(fault)
            return Recorded(attempt, (), str(fault))
        except InstrumentError as fault:
            self._session.fault(fault, attempt, retried=False)
            raise
        if attempt.of_session == 1:
            self._drift.recorded()
        if self._queue:
            self._records.set_out_for(self._queue[0])
        return Recorded(attempt, recordings, "")

    def _take(self, attempt: Attempt) -> tuple[Recording, ...]:
        return self._recovery.until_done(
            lambda: self._records.take(attempt, "capture", self._between_records), attempt.position, attempt.number
        )

    def _between_records(self) -> None:
        self._collect_if_done()
        self._stand_by.follow_requests()

    # -- judging and committing ----------------------------------------------------------------

    def _evaluate_and_commit(self, recorded: Recorded) -> AttemptResult:
        """In the worker: estimate, judge and, when nothing better can be hoped for, commit.

        Signals reach the main thread only, so that a Ctrl-C never lands inside a commit.
        """
        result = self._evaluate(recorded)
        row = row_of(result, self._plan)
        if result.judgement.good and row is not None:
            result = self._confirmed(result, row)
        if not is_final(recorded.attempt, result.judgement, self._plan.quality):
            return result
        best = min((result, self._best.get(recorded.attempt.position, result)), key=lambda one: one.rank)
        return commit_attempt(self._bank, best, recorded.attempt.number, self._raw, count_anyway=self._passing)

    def _confirmed(self, result: AttemptResult, row: Row) -> AttemptResult:
        """Judge a good attempt by what the bank holds of the position, and a repeat by its neighbours.

        A valid row is replaced only by one that agrees with it; where it may be replaced by another one, two attempts
        must agree with each other. So must two where neighbours cannot judge a repeat.
        """
        position, judgement = result.attempt.position, result.judgement
        status, twice = Status(int(self._bank.status[position])), position in self._replaceable
        must_agree = status == Status.VALID
        repeat = self._judged or bool(status)
        if repeat and result.estimate is not None and (twice or not must_agree):
            judgement, judged = self._neighbours.judge(position, result.estimate.green, judgement)
            if not judged and self._plan.quality.confirms:
                must_agree = twice = True
        if not (must_agree and judgement.good):
            return replace(result, judgement=judgement)
        apart = None
        if status & MEASURED:
            record, sweep = self._bank.record(position), self._plan.excitation
            held = in_band(self._bank.green(position), sweep.sample_rate_hz, sweep.band_hz)
            apart = difference(Row(held, record.snr_db, record.moved_mm), row)
            if not apart:
                return result
        earlier = self._best.get(position)
        before = None if earlier is None else row_of(earlier, self._plan)
        if twice and before is not None and not difference(before, row):
            return result
        judgement = differing(apart, judgement.score) if apart else replace(UNCONFIRMED, score=judgement.score)
        return replace(result, judgement=judgement)

    def _evaluate(self, recorded: Recorded) -> AttemptResult:
        place_mm = self._plan.position_mm[recorded.attempt.position]
        distance_mm = np.hypot(*(self._plan.actuator_mm - place_mm).T)
        before_db = self._bank.reference_before_db(recorded.attempt.position)
        return evaluate(recorded, self._estimator, self._setup.range_v, self._plan.quality, distance_mm, before_db)

    def _collect_if_done(self) -> None:
        """Take up the evaluation under way as soon as it is done, so that a repeat follows at once."""
        if self._pending is not None and self._pending.done():
            self._collect()

    def _collect(self) -> None:
        """Wait for the evaluation under way, if any, and publish or queue what follows from it."""
        if self._pending is None:
            return
        result = self._pending.result()
        self._pending = None
        attempt = result.attempt
        if not result.final:
            kept = self._best.get(attempt.position)
            self._best[attempt.position] = result if kept is None else min((result, kept), key=lambda one: one.rank)
            following = next_attempt(
                attempt,
                result.judgement,
                Status.NOT_MEASURED if kept is None else kept.judgement.status,
                self._setup,
                self._plan.quality,
                self._plan.position_mm[attempt.position],
                joint=self._plan.staggered is not None,
            )
            self._session.repeat(result, following)
            self._queue.appendleft(following)
            return
        self._best.pop(attempt.position, None)
        if result.committed:
            self._drift.committed(attempt.position)
        self._session.settle(result, left=len(self._queue))
        self._count_failures(result)

    def _count_failures(self, result: AttemptResult) -> None:
        """Stop when position after position yields nothing: that is an instrument, not the plate."""
        if not result.judgement.status & Status.FAILED:
            self._failed_in_a_row = 0
            return
        if self._passing and result.attempt.position in self._fruitless:
            return
        self._failed_in_a_row += 1
        if self._failed_in_a_row >= FAILED_IN_A_ROW:
            cause = f"{FAILED_IN_A_ROW} positions in a row gave no usable record ({result.judgement.reason})"
            fault = self._last_fault
            raise InstrumentError(
                fault.instrument if fault else "recorder",
                fault.operation if fault else "recording the reference",
                cause,
                fault.remedy if fault else "check the loopback cable from the player to the reference input",
            )
