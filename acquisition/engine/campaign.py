"""The engine: walks a plan through the instruments into a bank.

:meth:`Campaign.run` asks `_next_step` for one of the steps below, carries it out and asks again, until there is none
left. `_next_step` looks and changes nothing; a request of a person reaches it as a state of the session
(`acquisition.engine.states`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from enum import Enum, auto

import numpy as np

from acquisition.engine.events import EventPublisher, SessionEnded, State, Subscriber, failure_kind
from acquisition.engine.recovery import Recovery
from acquisition.engine.session import Session
from acquisition.engine.states import Lifecycle
from acquisition.engine.stop_request import StoppedWhileWaitingError, StopRequest
from acquisition.engine.suspension import Suspension
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
)
from acquisition.measuring.plays import measuring_of
from acquisition.measuring.position_records import PositionRecords
from acquisition.measuring.setup import Setup, names_of
from acquisition.quality.conditions import Conditions
from acquisition.quality.drift_watch import DriftWatch
from acquisition.quality.neighbour_watch import NeighbourWatch
from acquisition.schedule.plan import Plan
from calibration.blas import one_blas_thread
from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.protocols import Recording
from storage.bank.writer import BankWriter
from storage.point_status import Status
from storage.raw.writer import RawWriter

# As many positions in a row without one good record mean a broken instrument, not a bad spot.
FAILED_IN_A_ROW = 3


class Step(Enum):
    """What a campaign does next."""

    MEASURE = auto()
    """Record the next attempt in the queue."""
    COLLECT = auto()
    """Wait for the estimate of the attempt before: what comes next depends on it."""
    PAUSE = auto()
    COMPARE_SENTINEL = auto()
    """Before this session measures anything: is it still the plate that the bank holds?"""
    COMPARE_SENTINEL_AGAIN = auto()
    MARK = auto()
    """After the first round: what neighbours contradict, or cannot judge, is poor."""
    BEGIN_PASS = auto()
    """Give everything that is not valid another round."""
    END = auto()


class Campaign:
    """One session of a campaign, from the first position to do to the last or to a stop.

    While a position is recorded, the estimate, the judgement and the commit of the one before run in a second thread.
    An instrument that is lost is waited for, and the attempt that it interrupted is taken again from its first record.

    bank: Open for writing; its status says what is committed.
    publish: Receives every event, in order, in the thread that calls :meth:`run`. If it fails, that is reported once,
        and the campaign goes on.
    stop: Where a person asks for a stop.
    raw: Open for writing; keeps the recordings of what goes into the bank.
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
        self._plan, self._setup, self._bank, self._raw, self._stop = plan, setup, bank, raw, stop
        publish = EventPublisher({"a subscriber of the campaign's events": publish})
        self._life = Lifecycle(setup.instruments.clock, publish)
        self._session = Session(plan, setup, bank, self._life, publish)
        self._recovery = Recovery(setup, self._life, publish, stop)
        measuring = measuring_of(plan, setup)
        self._estimator = measuring.estimator
        self._records = PositionRecords(plan, setup, measuring.plays, self._session)
        self._drift = DriftWatch(plan, bank, self._life, self._session, self._records, self._recovery, self._evaluate)
        conditions = Conditions(setup.watch, setup, plan.excitation)
        self._suspension = Suspension(setup, self._life, self._session, stop, conditions, self._records, self._recovery)
        self._neighbours = NeighbourWatch(plan, bank)
        self._queue: deque[Attempt] = deque()
        self._covered = plan.order
        self._compared = self._judged = self._passing = False
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

        positions: Bank rows to measure again; by default those not measured yet.
        accept_drift: Go on although the sentinel position has changed.
        replaceable: Bank rows that are valid and may all the same be replaced by others, which two attempts agree on. A
            valid row is else replaced by one that agrees with it, and by no other.

        Returns the last event that was published.
        Raises DriftError: the sentinel position is not what the bank holds; the message says whether anything was
        added. SuspendedTooLongError: a watched condition left its band and did not come back. InstrumentError: an
        instrument failed, or was gone, for good; all that was committed is safe.
        """
        self._replaceable, self._drift.accept_drift = frozenset(replaceable), accept_drift
        status = self._bank.status
        rows = np.asarray(self._plan.to_do(status) if positions is None else positions, dtype=np.int64)
        self._queue = deque(first_attempts(rows, self._bank.attempts))
        again = bool(len(rows)) and bool(np.all(status[rows]))
        if again or np.any(status[np.setdiff1d(self._plan.order, rows)] == 0):
            self._covered = self._plan.order[np.isin(self._plan.order, rows)]
        self._judged = again or self._neighbours.is_done(self._covered)
        state, reason = State.FINISHED, "every position is committed"
        try:
            names = self._recovery.until_done(lambda: names_of(self._setup.instruments))
            self._session.start(rows, names, second_looks=not self._judged)
            with one_blas_thread(), ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate") as worker:
                self._walk(worker)
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

    # -- steps --------------------------------------------------------------------------------

    def _walk(self, worker: ThreadPoolExecutor) -> None:
        """Take step after step; an attempt whose estimate is under way is committed whatever happens."""
        steps: dict[Step, Callable[[], None]] = {
            Step.MEASURE: lambda: self._measure(worker),
            Step.COLLECT: self._collect,
            Step.PAUSE: self._pause,
            Step.COMPARE_SENTINEL: self._compare_sentinel,
            Step.COMPARE_SENTINEL_AGAIN: self._drift.check_again,
            Step.MARK: lambda: self._mark(worker),
            Step.BEGIN_PASS: self._begin_pass,
        }
        try:
            self._suspension.follow_requests()
            while (step := self._next_step()) is not Step.END:
                steps[step]()
                self._suspension.follow_requests()
        finally:
            self._collect()

    def _next_step(self) -> Step:
        """Pauses, stops and the sentinel come between two positions: a position's repeats are finished first."""
        state, queue = self._life.state, self._queue
        held = self._passing or self._drift.due or state in (State.PAUSING, State.STOPPING)
        if self._pending is not None and (held or not queue):
            return Step.COLLECT
        if queue and queue[0].of_session > 1:
            return Step.MEASURE
        if not queue and not self._judged and np.all(self._bank.status[self._covered]):
            return Step.MARK
        if state is State.STOPPING or self._pass_is_futile() or not (queue or self._due_again()):
            return Step.END
        if state is State.PAUSING:
            return Step.PAUSE
        if not self._compared:
            return Step.COMPARE_SENTINEL
        if queue:
            return Step.COMPARE_SENTINEL_AGAIN if self._drift.due else Step.MEASURE
        return Step.BEGIN_PASS

    def _pass_is_futile(self) -> bool:
        """Whether the latest positions of the pass have all stayed as they were."""
        if not (self._passing and self._queue):
            return False
        before = self._queue[0].number - 1
        return is_futile(self._covered, self._bank.status, self._bank.attempts, before)

    def _due_again(self) -> list[Attempt]:
        """The next pass, if there is one; the bank holds the number of each attempt."""
        return attempts_again(self._covered, self._bank.status, self._bank.attempts, self._setup, self._plan.quality)

    def _measure(self, worker: ThreadPoolExecutor) -> None:
        """Record an attempt while the one before is estimated, judged and committed."""
        recorded = self._record(self._queue.popleft())
        self._session.attempt_recorded()
        self._collect()
        self._pending = worker.submit(self._evaluate_and_commit, recorded)

    def _pause(self) -> None:
        self._suspension.pause()
        if self._compared:
            self._drift.check_again()

    def _compare_sentinel(self) -> None:
        self._compared = True
        self._drift.check()

    def _mark(self, worker: ThreadPoolExecutor) -> None:
        """In the worker, where no Ctrl-C lands inside a commit."""
        self._judged = True
        for position, judgement in worker.submit(lambda: list(self._neighbours.mark(self._covered))).result():
            self._session.marked(position, judgement)

    def _begin_pass(self) -> None:
        due = self._due_again()
        self._passing = True
        self._fruitless = frozenset(one.position for one in due if self._bank.status[one.position] == Status.FAILED)
        self._session.measures_again(tuple(one.position for one in due))
        self._queue = deque(due)

    # -- recording ----------------------------------------------------------------------------

    def _record(self, attempt: Attempt) -> Recorded:
        """Record all actuators at one position; a passing fault that no repeated record cures costs the attempt."""
        self._session.begin(attempt)
        try:
            recordings = self._suspension.take_under_conditions(attempt, lambda: self._take(attempt))
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
        """Collect an estimate that is done, so that a repeat follows at once."""
        if self._pending is not None and self._pending.done():
            self._collect()
        self._suspension.follow_requests()

    # -- judging and committing ---------------------------------------------------------------

    def _evaluate_and_commit(self, recorded: Recorded) -> AttemptResult:
        """In the worker: estimate, judge and, when nothing better can be hoped for, commit.

        Signals reach the main thread only, so that a Ctrl-C never lands inside a commit.
        """
        position, limits = recorded.attempt.position, self._plan.quality
        earlier = self._best.get(position)
        result = self._neighbours.confirmed(
            self._evaluate(recorded), earlier, repeat=self._judged, replaceable=position in self._replaceable
        )
        if not is_final(recorded.attempt, result.judgement, limits):
            return result
        best = result if earlier is None else min((result, earlier), key=lambda one: one.rank)
        return commit_attempt(self._bank, best, recorded.attempt.number, self._raw, count_anyway=self._passing)

    def _evaluate(self, recorded: Recorded) -> AttemptResult:
        place_mm = self._plan.position_mm[recorded.attempt.position]
        distance_mm = np.hypot(*(self._plan.actuator_mm - place_mm).T)
        before_db = self._bank.reference_before_db(recorded.attempt.position)
        return evaluate(recorded, self._estimator, self._setup.range_v, self._plan.quality, distance_mm, before_db)

    def _collect(self) -> None:
        """Wait for the estimate under way, if any, and publish or queue what follows from it."""
        if self._pending is None:
            return
        result = self._pending.result()
        self._pending = None
        attempt = result.attempt
        if result.final:
            self._best.pop(attempt.position, None)
            if result.committed:
                self._drift.committed(attempt.position)
            self._session.position_done(result, left=len(self._queue))
            self._count_failures(result)
            return
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
