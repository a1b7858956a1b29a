"""The sentinel position, measured again every so often: one bank holds one plate."""

from __future__ import annotations

from collections.abc import Callable

from wavefocus.acquisition.attempt import Attempt, AttemptResult, PositionRecords, Recorded
from wavefocus.acquisition.defects import REFERENCE_LEVEL
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.report import CampaignReport
from wavefocus.acquisition.engine.session import Session
from wavefocus.acquisition.limits import DriftFigures, compare_sentinel
from wavefocus.acquisition.plan import Plan, sentinel_of
from wavefocus.acquisition.wording import row_ranges
from wavefocus.config.messages.campaign import Drift
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import WavefocusError


class DriftError(WavefocusError):
    """The plate measured now is not the plate that is in the bank."""


class DriftWatch:
    """Measures the sentinel position and compares it with what the bank holds.

    evaluate: From recordings to a judged estimate.
    accept_drift: Continue although it has changed; the change is reported.
    """

    def __init__(
        self,
        plan: Plan,
        bank: BankWriter,
        session: Session,
        report: CampaignReport,
        records: PositionRecords,
        recovery: Recovery,
        evaluate: Callable[[Recorded], AttemptResult],
    ) -> None:
        self._plan, self._bank, self._session, self._report = plan, bank, session, report
        self._records, self._recovery, self._evaluate = records, recovery, evaluate
        self._since: list[int] = []
        self._recorded = 0
        self._looked_s = session.time_s()
        self.accept_drift = False

    def recorded(self) -> None:
        """Note that a position was recorded."""
        self._recorded += 1

    def committed(self, position: int) -> None:
        """Note a position that was committed: the next measurement of the sentinel vouches for it, or does not."""
        self._since.append(position)

    @property
    def due(self) -> bool:
        """Whether the sentinel should be measured before the next position."""
        limits = self._plan.drift
        late = self._session.time_s() - self._looked_s >= limits.every_s
        return self._recorded > 0 and (self._recorded >= limits.every_positions or late)

    def check(self) -> None:
        """Measure the sentinel again before a session adds anything, if there is one.

        Raises DriftError: the sentinel position is not what the bank holds, or cannot be measured; nothing was added.
        InstrumentError: an instrument failed for good.
        """
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            return
        figures = self._figures(Attempt(position, 1, 1))
        self._publish(position, figures, "resume")
        if figures.verdict(self._plan.drift) == "stop" and not self.accept_drift:
            raise DriftError(
                f"sentinel position {position} is not what the bank holds ({figures.cause(self._plan.drift)}): "
                f"{figures}; nothing was added; put it right and resume, start a new bank, or go on with --accept-drift"
            )

    def check_again(self) -> None:
        """Measure the sentinel again during a session, and once more before it is believed that it has changed.

        Raises DriftError: it has; the positions measured since it was last as it should be are named. InstrumentError:
        an instrument failed for good.
        """
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            self._begin_anew()
            return
        limits, first = self._plan.drift, Attempt(position, 1, 1)
        figures = self._figures(first)
        stops = figures.verdict(limits) == "stop"
        if stops and not self.accept_drift:
            self._publish(position, figures, "run")
            figures = self._figures(Attempt(position, 2, 1))
            stops = figures.verdict(limits) == "stop"
            suspect = tuple(self._since) if stops else ()
            self._publish(position, figures, "repeat", suspect)
        else:
            self._publish(position, figures, "run")
        if stops and not self.accept_drift:
            rows = row_ranges(self._since)
            raise DriftError(
                f"sentinel position {position} has changed during the run ({figures.cause(limits)}): {figures}; "
                f"positions {rows}, measured since it was last steady, are in the bank but suspect; put it right, "
                f"then wavefocus remeasure {self._bank.path} --positions {rows} and resume, or go on with "
                "--accept-drift"
            )
        self._begin_anew()

    def _publish(self, position: int, figures: DriftFigures, occasion: str, suspect: tuple[int, ...] = ()) -> None:
        limits, found = self._plan.drift, (figures.level_db, figures.delay_samples, figures.correlation)
        words = figures.verdict(limits), occasion, figures.cause(limits)
        self._session.publish(Drift, position, *found, *words, suspect)

    def _begin_anew(self) -> None:
        self._since.clear()
        self._recorded = 0
        self._looked_s = self._session.time_s()

    def _figures(self, attempt: Attempt) -> DriftFigures:
        result = measure_again(
            attempt, self._records, self._recovery, self._session, self._evaluate, self._plan.quality.max_attempts
        )
        self._report.sentinel_done()
        if result.estimate is None or _useless(result):
            raise DriftError(
                f"sentinel position {attempt.position} could not be measured: {result.judgement.reason}; "
                "check cables and laser, then resume"
            )
        return compare_sentinel(self._bank.green(attempt.position), result.estimate.green)


def measure_again(
    attempt: Attempt,
    records: PositionRecords,
    recovery: Recovery,
    session: Session,
    evaluate: Callable[[Recorded], AttemptResult],
    max_attempts: int,
) -> AttemptResult:
    """Measure a sentinel position, again after passing faults as any other.

    evaluate: From recordings to a judged estimate.
    max_attempts: Tries before it is given up.

    Raises InstrumentError: of the instrument that failed.
    """
    try:
        recordings = recovery.until_done(lambda: records.take(attempt, "sentinel"), attempt)
    except TransientInstrumentError as fault:
        retried = attempt.of_session < max_attempts
        session.fault(fault, attempt, retried=retried)
        if not retried:
            raise
        recovery.renew_if_repeated(fault)
        return measure_again(attempt.next(), records, recovery, session, evaluate, max_attempts)
    result = evaluate(Recorded(attempt, recordings, ""))
    if _useless(result) and attempt.of_session < max_attempts:
        return measure_again(attempt.next(), records, recovery, session, evaluate, max_attempts)
    return result


def _useless(result: AttemptResult) -> bool:
    """Whether a measurement says nothing of the plate: no estimate, or a reference that is not as it was."""
    return result.estimate is None or REFERENCE_LEVEL in result.defect_names
