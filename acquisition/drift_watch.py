"""The sentinel position, measured again: one bank holds one plate."""

from __future__ import annotations

from collections.abc import Callable

from acquisition.attempt import Attempt, AttemptResult, Recorded
from acquisition.errors import DriftError
from acquisition.plan import Plan, sentinel_of
from acquisition.position_records import PositionRecords
from acquisition.recovery import Recovery
from acquisition.sentinel import compare_sentinel
from acquisition.session import Session
from calibration.bank_writer import BankWriter
from drivers.errors import TransientInstrumentError


class DriftWatch:
    """Measures the sentinel position and compares it with what the bank holds.

    Parameters
    ----------
    plan : Plan
        Which positions, in which order.
    bank : BankWriter
        What was measured first.
    session : Session
        Told what was found.
    records : PositionRecords
        Takes the records.
    recovery : Recovery
        Brings lost instruments back.
    evaluate : callable
        From recordings to a judged estimate.
    """

    def __init__(
        self,
        plan: Plan,
        bank: BankWriter,
        session: Session,
        records: PositionRecords,
        recovery: Recovery,
        evaluate: Callable[[Recorded], AttemptResult],
    ) -> None:
        self._plan = plan
        self._bank = bank
        self._session = session
        self._records = records
        self._recovery = recovery
        self._evaluate = evaluate

    def check(self, *, accept_drift: bool) -> None:
        """Measure the sentinel again, if there is one, and refuse to mix two plates in one bank.

        Parameters
        ----------
        accept_drift : bool
            Go on although it has changed.

        Raises
        ------
        DriftError
            The sentinel position is not what the bank holds, or cannot be measured; nothing was added.
        InstrumentError
            An instrument failed for good.
        """
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            return
        result = self._measure(Attempt(position, 1, 1))
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

    def _measure(self, attempt: Attempt) -> AttemptResult:
        """Measure the sentinel position, again after passing faults as any other."""
        try:
            recordings = self._recovery.until_done(
                lambda: self._records.take(attempt, "sentinel", lambda: None), attempt.position, attempt.number
            )
        except TransientInstrumentError as fault:
            retried = attempt.of_session < self._plan.quality.max_attempts
            self._session.fault(fault, attempt, retried=retried)
            if not retried:
                raise
            self._recovery.renew_if_repeated(fault)
            return self._measure(attempt.next())
        result = self._evaluate(Recorded(attempt, recordings, ""))
        if result.estimate is None and attempt.of_session < self._plan.quality.max_attempts:
            return self._measure(attempt.next())
        return result
