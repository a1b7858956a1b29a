"""The sentinel position, measured again every so often: one bank holds one plate."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from wavefocus.acquisition.attempt import Attempt, AttemptResult, PositionRecords, Recorded
from wavefocus.acquisition.defects import REFERENCE_LEVEL
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.report import CampaignReport
from wavefocus.acquisition.engine.session import Session
from wavefocus.acquisition.limits import DriftFigures, compare_sentinel
from wavefocus.acquisition.plan import Plan, sentinel_of
from wavefocus.acquisition.wording import row_ranges
from wavefocus.config.messages.campaign import Drift, Fault
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import WavefocusError


class DriftError(WavefocusError):
    """The plate measured now is not the plate that is in the bank.

    suspects: Positions measured since the sentinel was last steady, to be measured again.
    """

    def __init__(self, sentence: str, suspects: Sequence[int] = ()) -> None:
        super().__init__(sentence)
        self.suspects = tuple(suspects)


class SentinelUnusableError(DriftError):
    """The sentinel position cannot be measured."""


class DriftWatch:
    """Measures the sentinel position and compares it with what the bank holds.

    evaluate: From recordings to a judged estimate.
    mark: Marks positions as suspect in the bank, for a reason.
    unvouched: Rows that an earlier session measured after its last look at the sentinel.
    accept_drift: Continue although it has changed; the change is reported, and nothing is marked.
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
        mark: Callable[[Sequence[int], str], None],
        unvouched: Sequence[int] = (),
    ) -> None:
        self._mark = mark
        self._plan, self._bank, self._session, self._report = plan, bank, session, report
        self._records, self._recovery, self._evaluate = records, recovery, evaluate
        self._since = list(unvouched)
        self._off: DriftFigures | None = None
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

    @property
    def is_off(self) -> bool:
        """Whether what is measured now has another scale than the bank, so that to repeat anything is of no use."""
        return self._off is not None and not self.accept_drift

    @property
    def owes_a_look(self) -> bool:
        """Whether positions were committed that no measurement of the sentinel vouches for yet."""
        return bool(self._recorded and self._suspects(sentinel_of(self._plan, self._bank.status)))

    def end(self) -> None:
        """Where the sentinel was off when it was last measured, mark what was committed since."""
        if self._off is not None and not self.accept_drift:
            position = sentinel_of(self._plan, self._bank.status)
            self._mark(self._suspects(position), _suspicion(position, self._off))

    def _suspects(self, sentinel: int | None) -> tuple[int, ...]:
        """What was committed since the sentinel was last steady; the sentinel is what the others are compared with."""
        return tuple(dict.fromkeys(position for position in self._since if position != sentinel))

    def check(self) -> None:
        """Measure the sentinel again before a session adds anything, if there is one.

        Where it has changed, what an earlier session measured after its last look at it is suspect: it lies between
        the two. Then the sentinel is measured once more before that is believed.

        Raises DriftError: the sentinel position is not what the bank holds, or cannot be measured; nothing was added.
        InstrumentError: an instrument failed for good.
        """
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            return
        self._since = [row for row in self._since if self._bank.status[row]]
        limits = self._plan.drift
        figures, occasion = self._figures(Attempt(position, 1, 1)), "resume"
        suspects = self._suspects(position) if figures.speaks_against(limits) and not self.accept_drift else ()
        if suspects:
            self._publish(position, figures, occasion)
            figures, occasion = self._figures(Attempt(position, 2, 1)), "repeat"
            suspects = suspects if figures.speaks_against(limits) else ()
        self._publish(position, figures, occasion, suspects)
        self._off = figures if figures.speaks_against(limits) else None
        if suspects:
            self._mark(suspects, _suspicion(position, figures))
        self._since.clear()
        if figures.verdict(limits) == "stop" and not self.accept_drift:
            raise DriftError(
                f"sentinel position {position} is not what the bank holds ({figures.cause(limits)}): {figures}; "
                f"nothing was added; {_put_right(suspects)}, or start a new bank",
                suspects,
            )

    def check_again(self) -> None:
        """Measure the sentinel again during a session, and once more before it is believed that it has changed.

        Where it has, by more than the limit of a warning for the level, the positions measured since it was last as it
        should be are marked as suspect: their scale may be another one.

        Raises DriftError: it has changed too much to go on. InstrumentError: an instrument failed for good.
        """
        position = sentinel_of(self._plan, self._bank.status)
        if position is None:
            self._begin_anew()
            return
        limits = self._plan.drift
        figures = self._figures(Attempt(position, 1, 1))
        suspects: tuple[int, ...] = ()
        occasion = "run"
        if figures.speaks_against(limits) and not self.accept_drift:
            self._publish(position, figures, occasion)
            figures, occasion = self._figures(Attempt(position, 2, 1)), "repeat"
            if figures.speaks_against(limits):
                suspects = self._suspects(position)
        self._publish(position, figures, occasion, suspects)
        self._off = figures if figures.speaks_against(limits) else None
        if suspects:
            self._mark(suspects, _suspicion(position, figures))
        if figures.verdict(limits) == "stop" and not self.accept_drift:
            raise DriftError(
                f"sentinel position {position} has changed during the run ({figures.cause(limits)}): {figures}; "
                + _put_right(suspects),
                suspects,
            )
        self._begin_anew()

    def check_last(self) -> None:
        """Measure the sentinel once more when all positions are done; where that cannot be, say so and let it be.

        Raises DriftError, InstrumentError: as `check_again`.
        """
        try:
            self.check_again()
        except SentinelUnusableError as unusable:
            position = sentinel_of(self._plan, self._bank.status)
            remedy = "the positions measured since it was last steady are unconfirmed"
            doing = "measuring the sentinel position"
            self._session.publish(Fault, "recorder", doing, str(unusable), remedy, position, 1, retried=False)
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
            raise SentinelUnusableError(
                f"sentinel position {attempt.position} could not be measured: {result.judgement.reason}; "
                "check cables and laser, then resume"
            )
        then, excitation = self._bank.record(attempt.position), self._plan.excitation
        return compare_sentinel(
            self._bank.green(attempt.position), result.estimate.green, then.snr_db, result.estimate.snr_db,
            band_hz=excitation.band_hz, sample_rate_hz=excitation.sample_rate_hz,
        )  # fmt: skip


def _suspicion(sentinel: int | None, figures: DriftFigures) -> str:
    return (
        f"sentinel position {sentinel} had changed by {figures.level_db:+.2f} dB when it was measured next: the "
        "vibrometer's range, a gain or the plate changed at some time before; put it right, then wavefocus remeasure"
    )


def _put_right(suspects: tuple[int, ...]) -> str:
    if not suspects:
        return "put it right and resume"
    rows = row_ranges(suspects)
    marked = f"positions {rows}, measured since it was last steady, are marked as suspect"
    return f"{marked}; put it right and measure them again"


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
        recordings = recovery.retry_after_reconnect(lambda: records.take(attempt, "sentinel"), attempt)
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
