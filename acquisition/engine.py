"""The engine: walks a plan through the instruments into a bank."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from acquisition.attempt import Attempt, AttemptResult, Recorded, commit_attempt, evaluate
from acquisition.errors import DriftError
from acquisition.events import SessionEnded, State, Subscriber
from acquisition.plan import Plan, sentinel_of
from acquisition.pointing import point_at, start_move
from acquisition.quality import Status
from acquisition.record import take_record
from acquisition.recovery import Recovery
from acquisition.roles import names_of
from acquisition.sentinel import compare_sentinel
from acquisition.session import Session
from acquisition.setup import Setup
from acquisition.states import Lifecycle
from acquisition.stopping import StoppedWhileWaitingError, StopRequest
from calibration.bank_writer import BankWriter
from calibration.blas import one_blas_thread
from calibration.estimator import Estimator
from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.protocols import Float64Array, Recording, Take

# As many positions in a row without one good record mean a broken instrument, not a bad spot.
FAILED_IN_A_ROW = 3
# A record is repeated so often before the whole attempt is given up for a passing fault.
RECORD_REPEATS = 2


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
        Receives every event, in order, in the thread that calls :meth:`run`.
    stop : StopRequest
        Where a person asks for a stop.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, publish: Subscriber, stop: StopRequest) -> None:
        self._plan = plan
        self._setup = setup
        self._bank = bank
        self._life = Lifecycle(setup.instruments.clock, publish)
        self._session = Session(plan, setup, bank, self._life, publish)
        self._recovery = Recovery(setup, self._life, publish, stop)
        self._stop = stop
        self._signal_v = plan.excitation.signal_v()
        with one_blas_thread():
            self._estimator = Estimator(
                plan.excitation,
                plan.taps,
                reference_gain=setup.reference_gain,
                response_per_volt=setup.response_per_volt,
                inter_channel_delay_s=setup.response_delay_s,
            )
        self._queue: deque[Attempt] = deque()
        self._pending: Future[AttemptResult] | None = None
        self._best: dict[int, AttemptResult] = {}
        self._failed_in_a_row = 0
        self._last_fault: InstrumentError | None = None

    def run(self, positions: Sequence[int] | None = None, *, accept_drift: bool = False) -> SessionEnded:
        """Measure what is to do, or the given positions once more.

        Parameters
        ----------
        positions : sequence of int, optional
            Bank rows to measure again; by default those not measured yet.
        accept_drift : bool
            Go on although the sentinel position has changed.

        Returns
        -------
        SessionEnded
            Also published, as the last event.

        Raises
        ------
        DriftError
            The sentinel position is not what the bank holds; nothing was added.
        InstrumentError
            An instrument failed, or was gone, for good; all that was committed is safe.
        """
        rows = self._plan.to_do(self._bank.status) if positions is None else positions
        self._queue = deque(Attempt(int(row), int(self._bank.attempts[row]) + 1, 1) for row in rows)
        state, reason = State.FINISHED, "every position is committed"
        try:
            names = self._recovery.until_done(lambda: names_of(self._setup.instruments))
            self._session.start(len(rows), names)
            with one_blas_thread():
                if self._queue and not self._stop.requested:
                    self._check_sentinel(accept_drift)
                    self._measure_queue()
            if self._stop.requested and self._queue:
                state, reason = State.STOPPED, "stopped by the user after the position"
        except StoppedWhileWaitingError as stopped:
            state, reason = State.STOPPED, str(stopped)
        except KeyboardInterrupt:
            state, reason = State.STOPPED, "stopped by the user at once"
        except BaseException as failure:
            self._session.end(State.FAILED, str(failure))
            raise
        return self._session.end(state, reason)

    # -- measuring ---------------------------------------------------------------------------

    def _measure_queue(self) -> None:
        """Record every queued attempt while the one before is estimated, judged and committed."""
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="estimate") as worker:
            try:
                while self._goes_on():
                    recorded = self._record_attempt(self._queue.popleft())
                    self._collect()
                    self._pending = worker.submit(self._evaluate_and_commit, recorded)
            finally:
                self._collect()

    def _goes_on(self) -> bool:
        """Whether there is an attempt to record; a stop still lets a position's repeats finish."""
        if self._stop.requested or not self._queue:
            self._collect()
        return bool(self._queue) and (not self._stop.requested or self._queue[0].of_session > 1)

    def _record_attempt(self, attempt: Attempt) -> Recorded:
        """Record all actuators at one position; a passing fault that no repeated record cures costs the attempt."""
        self._session.begin(attempt)
        try:
            recordings = self._recovery.until_done(
                lambda: self._record_position(attempt, "capture"), attempt.position, attempt.number
            )
        except TransientInstrumentError as fault:
            self._last_fault = fault
            self._session.fault(fault, attempt, retried=attempt.of_session < self._plan.quality.max_attempts)
            self._recovery.renew_if_repeated(fault)
            return Recorded(attempt, (), str(fault))
        except InstrumentError as fault:
            self._session.fault(fault, attempt, retried=False)
            raise
        if self._queue:
            self._set_out_for(self._queue[0])
        return Recorded(attempt, recordings, "")

    def _record_position(self, attempt: Attempt, purpose: str) -> tuple[Recording, ...]:
        """Point at a position and take one record per actuator."""
        point_at(self._setup, *self._plan.position_mm[attempt.position])
        recordings: list[Recording] = []
        for actuator, channel in enumerate(self._setup.actuator_channels):
            signals_v: dict[int, Float64Array] = {
                channel: self._signal_v,
                self._setup.loopback_channel: self._signal_v,
            }
            take = Take(attempt.position, attempt.number, actuator, purpose)
            recordings.append(self._take_record(signals_v, take, attempt))
            if self._pending is not None and self._pending.done():
                self._collect()
        return tuple(recordings)

    def _take_record(self, signals_v: dict[int, Float64Array], take: Take, attempt: Attempt) -> Recording:
        """Take one record, and take it again after a passing fault: an underflow voids a record, not a position."""
        for _ in range(RECORD_REPEATS):
            try:
                return take_record(self._setup, signals_v, self._plan.excitation.sample_rate_hz, take)
            except TransientInstrumentError as fault:
                self._session.fault(fault, attempt, retried=True)
        return take_record(self._setup, signals_v, self._plan.excitation.sample_rate_hz, take)

    def _set_out_for(self, attempt: Attempt) -> None:
        """Let the mirror set out for the next position; when it fails, pointing there will meet that again."""
        try:
            start_move(self._setup, *self._plan.position_mm[attempt.position])
        except InstrumentError as fault:
            self._session.fault(fault, attempt, retried=True)

    # -- judging and committing ----------------------------------------------------------------

    def _evaluate_and_commit(self, recorded: Recorded) -> AttemptResult:
        """In the worker: estimate, judge and, when nothing better can be hoped for, commit.

        Signals reach the main thread only, so that a Ctrl-C never lands inside a commit.
        """
        result = evaluate(recorded, self._estimator, self._setup.range_v, self._plan.quality)
        final = result.judgement.good or recorded.attempt.of_session >= self._plan.quality.max_attempts
        if not final:
            return result
        best = min((result, self._best.get(recorded.attempt.position, result)), key=lambda one: one.rank)
        return commit_attempt(self._bank, best, recorded.attempt.number)

    def _collect(self) -> None:
        """Wait for the evaluation under way, if any, and publish or queue what follows from it."""
        if self._pending is None:
            return
        result = self._pending.result()
        self._pending = None
        attempt = result.attempt
        if not result.final:
            kept = self._best.get(attempt.position, result)
            self._best[attempt.position] = min((result, kept), key=lambda one: one.rank)
            self._session.repeat(result)
            self._queue.appendleft(attempt.next())
            return
        self._best.pop(attempt.position, None)
        self._session.settle(result, left=len(self._queue))
        self._count_failures(result)

    def _count_failures(self, result: AttemptResult) -> None:
        """Stop when position after position yields nothing: that is an instrument, not the plate."""
        if not result.judgement.status & Status.FAILED:
            self._failed_in_a_row = 0
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

    # -- drift ---------------------------------------------------------------------------------

    def _check_sentinel(self, accept_drift: bool) -> None:
        """On a resume, measure the sentinel again and refuse to mix two plates in one bank."""
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            return
        result = self._measure_sentinel(Attempt(position, 1, 1))
        if result.estimate is None:
            raise DriftError(
                f"sentinel position {position} could not be measured: {result.judgement.reason}; "
                "check cables and laser, then resume"
            )
        figures = compare_sentinel(self._bank.green(position), result.estimate.green)
        self._session.drift(position, figures)
        if figures.verdict == "stop" and not accept_drift:
            raise DriftError(
                f"sentinel position {position} is not what the bank holds: level {figures.level_db:+.2f} dB, "
                f"delay {figures.delay_samples:+.2f} samples, correlation {figures.correlation:.3f}; the plate, "
                "the mirror or a level has changed, and nothing was added; put it right and resume, start a new "
                "bank, or go on with --accept-drift"
            )

    def _measure_sentinel(self, attempt: Attempt) -> AttemptResult:
        """Measure the sentinel position, again after passing faults as any other."""
        try:
            recordings = self._recovery.until_done(
                lambda: self._record_position(attempt, "sentinel"), attempt.position, attempt.number
            )
        except TransientInstrumentError as fault:
            retried = attempt.of_session < self._plan.quality.max_attempts
            self._session.fault(fault, attempt, retried=retried)
            if not retried:
                raise
            self._recovery.renew_if_repeated(fault)
            return self._measure_sentinel(attempt.next())
        recorded = Recorded(attempt, recordings, "")
        result = evaluate(recorded, self._estimator, self._setup.range_v, self._plan.quality)
        if result.estimate is None and attempt.of_session < self._plan.quality.max_attempts:
            return self._measure_sentinel(attempt.next())
        return result
