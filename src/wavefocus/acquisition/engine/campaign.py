"""The engine: walks a plan through the instruments into a bank.

:meth:`Campaign.run` asks `_next_step` for one of the steps below, carries it out and asks again, until there is none
left. `_next_step` looks and changes nothing; a request of a person reaches it as a state of the session
(`wavefocus.acquisition.engine.session`).
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from wavefocus.acquisition.attempt import (
    Attempt,
    AttemptResult,
    Recorded,
    attempts_again,
    commit_attempt,
    is_final,
    is_futile,
    next_attempt,
)
from wavefocus.acquisition.drift_watch import DriftError, DriftWatch
from wavefocus.acquisition.engine.recovery import Suspension
from wavefocus.acquisition.engine.report import CampaignReport
from wavefocus.acquisition.engine.session import Session, StoppedWhileWaitingError, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.judgement import Cure, Judgement
from wavefocus.acquisition.leak import LeakWatch, judgement_of
from wavefocus.acquisition.neighbour_watch import NeighbourWatch, mark_suspects
from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.setup import Setup, names_of
from wavefocus.calibration.crosstalk import Crosstalk
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.messages.campaign import PositionStarted, RecordTaken, SessionEnded, State, Subscriber
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import Recording
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import FileLostError
from wavefocus.storage.raw.writer import RawWriter

# As many positions in a row without one good record mean a broken instrument, not a bad spot.
FAILED_IN_A_ROW = 3


class Campaign:
    """One session of a campaign, from the first position to do to the last or to a stop.

    While a position is recorded, the estimate, the judgement and the commit of the one before run in a second thread.
    An instrument that is lost is waited for, and the attempt that it interrupted is taken again from its first record.

    bank: Open for writing; its status says what is committed.
    publish: Receives every event, in order, in the thread that calls :meth:`run`. If it fails, that is reported once,
        and the campaign goes on.
    stop: Where a person asks for a stop.
    raw: Open for writing; keeps the recordings of what goes into the bank.
    unvouched: Rows that an earlier session measured after its last look at the sentinel; where the first look of this
        one finds another gain, they are suspect.
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
        unvouched: Sequence[int] = (),
    ) -> None:
        self._plan, self._setup, self._bank, self._raw, self._stop = plan, setup, bank, raw, stop
        self._session = session = Session(setup.clock, publish, stop)
        self._report = CampaignReport(plan, setup, bank, session)
        self._station = station = Station(plan, setup, session, bank.reference_before_db)
        self._drift = DriftWatch(station, bank, self._report, self._marked_suspects, unvouched)
        self._suspension = Suspension(setup, session, plan.excitation, station.plays, station.probe)
        self._neighbours = NeighbourWatch(plan, bank)
        self._leak = LeakWatch(station, bank, unvouched, raw)
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate")
        self._queue: deque[Attempt] = deque()
        self._rows_of_session = np.arange(plan.positions)
        self._recording = self._sentinel_compared = self._neighbours_judged = self._in_pass = False
        self._failed_before_pass: frozenset[int] = frozenset()
        self._pending: Future[AttemptResult] | None = None
        self._best: dict[int, AttemptResult] = {}
        self._replaceable: frozenset[int] = frozenset()
        self._failed_in_a_row = 0
        self._faults: dict[int, InstrumentError] = {}  # of positions whose latest attempt gave no record
        self._common: frozenset[str] | None = None

    def run(
        self, positions: Sequence[int] | None = None, *, accept_drift: bool = False, replaceable: Collection[int] = ()
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
        self._queue = deque(Attempt(row, int(self._bank.attempts[row]) + 1, 1) for row in rows.tolist())
        again = bool(len(rows)) and bool(np.all(status[rows]))
        if again or np.any(status[np.setdiff1d(self._rows_of_session, rows)] == 0):
            self._rows_of_session = np.unique(rows)
        self._neighbours_judged = again or self._neighbours.is_done(self._rows_of_session)
        state, reason = State.FINISHED, "every position is committed"
        try:
            names = self._station.recovery.retry_after_reconnect(lambda: names_of(self._setup))
            self._report.start(rows, tuple(names.values()), second_looks=not self._neighbours_judged)
            with one_blas_thread(), self._worker:
                self._walk()
            if self._stop.requested and (self._queue or self._due_again() or self._owes_a_look):
                state, reason = State.STOPPED, f"{self._stop.reason} after the position"
        except StoppedWhileWaitingError as stopped:
            state, reason = State.STOPPED, str(stopped)
        except KeyboardInterrupt:
            state, reason = State.STOPPED, "stopped by the user at once"
        except BaseException as failure:
            self._report.end(State.FAILED, str(failure), _failure_kind(failure))
            raise
        return self._report.end(state, reason)

    @property
    def crosstalk(self) -> Crosstalk | None:
        """The leak of the loopback, where the latest look found one that counts; else None."""
        return self._leak.found

    # -- steps --------------------------------------------------------------------------------

    def _walk(self) -> None:
        """Take step after step; an attempt whose estimate is under way is committed whatever happens."""
        try:
            self._session.follow_requests()
            while (step := self._next_step()) is not None:
                step()
                self._session.follow_requests()
        finally:
            self._collect()
            self._drift.end()

    def _next_step(self) -> Callable[[], None] | None:
        """Pauses, stops and the sentinel come between two positions: a position's repeats are finished first."""
        state, queue = self._session.state, self._queue
        held = self._in_pass or self._drift.due or state in (State.PAUSING, State.STOPPING)
        if self._pending is not None and (held or not queue):
            return self._collect
        if queue and queue[0].of_session > 1:
            return self._measure
        if (not queue or self._pass_is_futile()) and state is not State.STOPPING and self._owes_a_look:
            return self._check_last
        if not queue and not self._neighbours_judged and np.all(self._bank.status[self._rows_of_session]):
            return self._mark
        if state is State.STOPPING or self._pass_is_futile() or not (queue or self._due_again()):
            return None
        if state is State.PAUSING:
            return self._pause
        if not self._sentinel_compared:
            return self._compare_sentinel
        if queue:
            return self._check_again if self._drift.due else self._measure
        return self._begin_pass

    @property
    def _owes_a_look(self) -> bool:
        """Whether positions were committed since the leak or the sentinel was measured."""
        return self._leak.due or self._drift.owes_a_look

    def _pass_is_futile(self) -> bool:
        """Whether the latest positions of the pass have all stayed as they were, or a leak makes all of them poor."""
        if self._in_pass and self._leak.found is not None:
            return True
        if not (self._in_pass and self._queue):
            return False
        before = self._queue[0].number - 1
        return is_futile(self._rows_of_session, self._bank.status, self._bank.attempts, before)

    def _due_again(self) -> list[Attempt]:
        """The next pass, if there is one; the bank holds the number of each attempt.

        While the loopback leaks, or the sentinel is not as the bank holds it, there is none.
        """
        if self._leak.found is not None or self._drift.is_off:
            return []
        bank = self._bank
        return attempts_again(self._rows_of_session, bank.status, bank.attempts, self._setup, self._plan.quality)

    def _measure(self) -> None:
        """Record an attempt while the one before is estimated, judged and committed."""
        attempt = self._queue.popleft()
        recorded = self._record(attempt)
        self._recording = False
        self._report.done("attempt", self._plan.looks(attempt.position))
        self._collect()
        self._pending = self._worker.submit(self._evaluate_and_commit, recorded)

    def _pause(self) -> None:
        self._suspension.pause()
        if self._sentinel_compared:
            self._check_again()

    def _check_again(self) -> None:
        """Measure the leak and the sentinel: what was measured since the last look depends on both."""
        self._look_for_leak()
        self._drift.check_again()

    def _check_last(self) -> None:
        """The same when all positions are done."""
        self._look_for_leak()
        if self._drift.owes_a_look:
            self._drift.check_last()

    def _look_for_leak(self) -> None:
        """Measure how much of the loopback leaks; no Ctrl-C lands in the worker, which marks what has it."""
        for position in self._leak.look(self._worker):
            self._report.marked(position, judgement_of(self._leak.found))
        self._report.done("leak")

    def _compare_sentinel(self) -> None:
        """Before this session measures anything, see whether it is still the plate that the bank holds."""
        self._sentinel_compared = True
        self._look_for_leak()
        self._drift.check()

    def _mark(self) -> None:
        """After the first round, what neighbours contradict or cannot judge is poor; no Ctrl-C lands in the worker."""
        self._neighbours_judged = True
        self._marked(lambda: self._neighbours.mark(self._rows_of_session))

    def _marked_suspects(self, positions: Sequence[int], reason: str) -> None:
        self._marked(lambda: mark_suspects(self._bank, positions, reason))

    def _marked(self, marks: Callable[[], Iterable[tuple[int, Judgement]]]) -> None:
        for position, judgement in self._worker.submit(lambda: list(marks())).result():
            self._report.marked(position, judgement)

    def _begin_pass(self) -> None:
        """Give everything that is not valid another round."""
        due = self._due_again()
        self._in_pass = True
        self._failed_before_pass = frozenset(
            attempt.position for attempt in due if self._bank.status[attempt.position] == Status.FAILED
        )
        self._report.begin_pass(tuple(attempt.position for attempt in due))
        self._queue = deque(due)

    # -- recording ----------------------------------------------------------------------------

    def _record(self, attempt: Attempt) -> Recorded:
        """Record all actuators at one position; or none, and the passing fault that no repeated record cures."""
        x_mm, y_mm = self._plan.position_mm[attempt.position].tolist()
        self._recording = True
        self._session.publish(PositionStarted, attempt.position, attempt.number, x_mm, y_mm)
        try:
            recordings = self._suspension.take_under_conditions(attempt, lambda: self._take(attempt))
        except TransientInstrumentError as fault:
            self._faults[attempt.position] = fault
            self._session.fault(fault, attempt, retried=attempt.of_session < self._plan.quality.max_attempts)
            self._station.recovery.renew_if_repeated(fault)
            return Recorded(attempt, (), str(fault))
        except InstrumentError as fault:
            self._session.fault(fault, attempt, retried=False)
            raise
        self._faults.pop(attempt.position, None)
        if attempt.of_session == 1:
            self._drift.recorded()
        if self._queue:
            self._station.set_out_for(self._queue[0])
        return Recorded(attempt, recordings)

    def _take(self, attempt: Attempt) -> tuple[Recording, ...]:
        def taken(record: int) -> None:
            records = self._plan.records * self._plan.looks(attempt.position)
            if records > 1:
                self._session.publish(RecordTaken, attempt.position, attempt.number, record, records)
            # An estimate that is done is collected, so that a repeat follows at once.
            if self._pending is not None and self._pending.done():
                self._collect()
            self._session.follow_requests()

        return self._station.take(attempt, "capture", taken)

    # -- judging and committing ---------------------------------------------------------------

    def _evaluate_and_commit(self, recorded: Recorded) -> AttemptResult:
        """In the worker, which has the best attempts so far: estimate, judge, and commit or name the next attempt.

        Signals reach the main thread only, so that a Ctrl-C never lands inside a commit.
        """
        attempt, limits = recorded.attempt, self._plan.quality
        position = attempt.position
        earlier, replaceable = self._best.pop(position, None), position in self._replaceable
        result = self._station.evaluate(recorded)
        result = self._neighbours.confirmed(result, earlier, repeat=self._neighbours_judged, replaceable=replaceable)
        final = is_final(attempt, result.judgement, limits)
        if final:
            result = self._leak.judged(result)
        best = result if earlier is None else min((result, earlier), key=lambda candidate: candidate.rank)
        if final:
            return commit_attempt(
                self._bank, best, attempt.number, self._raw, count_anyway=self._in_pass, leak_db=self._leak.level_db
            )
        self._best[position] = best
        before = Status.NOT_MEASURED if earlier is None else earlier.judgement.status
        following = next_attempt(attempt, result.judgement, before, self._setup, self._plan)
        return replace(result, following=following)

    def _collect(self) -> None:
        """Wait for the estimate under way, if any, and publish or queue what follows from it."""
        if self._pending is None:
            return
        result = self._pending.result()
        self._pending = None
        if result.following is not None:
            self._report.repeat(result, result.following)
            self._queue.appendleft(result.following)
            return
        if result.committed:
            self._drift.committed(result.attempt.position)
            self._leak.committed(result.attempt.position)
        left = self._plan.looks(*(attempt.position for attempt in self._queue))
        self._report.position_done(result, left, recording=self._recording)
        self._require_a_sound_rig(result)
        self._count_failures(result)

    def _require_a_sound_rig(self, result: AttemptResult) -> None:
        """Stop after a first position whose every record has one and the same cause that is not the spot's.

        Where a position is one record, the next one must have it, too.
        """
        if self._in_pass or result.estimate is None or np.any(self._bank.status == Status.VALID):
            return
        common = {
            defect.name: defect.sentence
            for defect in result.judgement.defects
            if defect.cure is not Cure.MOVE and len(set(defect.actuators)) == self._plan.actuators
        }
        names = common.keys() if self._common is None else common.keys() & self._common
        again = self._common is not None or self._plan.records > 1
        self._common = frozenset(names)
        if names and again:
            sentence = common[min(names)]
            cause = f"every record of position {result.attempt.position} has one and the same defect: {sentence}"
            remedy = "put it right before more is measured; wavefocus doctor examines the rig"
            raise InstrumentError("the rig", "measuring the first position", cause, remedy)

    def _count_failures(self, result: AttemptResult) -> None:
        """Stop when position after position yields nothing: that is an instrument, not the plate."""
        if not result.judgement.status & Status.FAILED:
            self._failed_in_a_row = 0
            return
        if self._in_pass and result.attempt.position in self._failed_before_pass:
            return
        self._failed_in_a_row += 1
        if self._failed_in_a_row >= FAILED_IN_A_ROW:
            cause = f"{FAILED_IN_A_ROW} positions in a row gave no usable record ({result.judgement.reason})"
            fault = self._faults.get(result.attempt.position)
            if fault is None:
                where = "recorder", "recording the reference", cause, "put right what the reason names"
                raise InstrumentError(*where)
            raise InstrumentError(fault.instrument, fault.operation, cause, fault.remedy)


def _failure_kind(failure: BaseException) -> str:
    """The `failure` of a session that this exception ended."""
    match failure:
        case DriftError():
            return "drift"
        case InstrumentError():
            return "instrument"
        case OSError() | FileLostError():
            return "file"
    return "other"
