"""The sentinel position, measured again every so often: one bank holds one plate."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from wavefocus.acquisition.attempt import Attempt, AttemptResult, as_measured
from wavefocus.acquisition.engine.report import CampaignReport
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.judgement import REFERENCE_LEVEL
from wavefocus.acquisition.limits import DriftFigures, Look, compare_looks
from wavefocus.acquisition.plan import sentinel_of
from wavefocus.config.messages.campaign import Drift, Fault
from wavefocus.storage.bank.ledger import row_ranges
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
    """Measures the sentinel position and compares it with the latest good look, and with what the bank holds.

    mark: Marks positions as suspect in the bank, for a reason.
    unvouched: Rows that an earlier session measured after its last look at the sentinel.
    accept_drift: Continue although it has changed; the change is reported, and nothing is marked.
    """

    def __init__(
        self,
        station: Station,
        bank: BankWriter,
        report: CampaignReport,
        mark: Callable[[Sequence[int], str], None],
        unvouched: Sequence[int] = (),
    ) -> None:
        self._station, self._bank, self._report, self._mark = station, bank, report, mark
        self._session, self._limits = station.session, station.plan.drift
        self._since = list(unvouched)
        self._good: dict[int, Look] = {}
        self._off: DriftFigures | None = None
        self._recorded = 0
        self._looked_s = self._session.time_s()
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
        late = self._session.time_s() - self._looked_s >= self._limits.every_s
        return self._recorded > 0 and (self._recorded >= self._limits.every_positions or late)

    @property
    def is_off(self) -> bool:
        """Whether what is measured now has another scale than the bank, so that to repeat anything is of no use."""
        return self._off is not None and not self.accept_drift

    @property
    def owes_a_look(self) -> bool:
        """Whether positions were committed that no measurement of the sentinel vouches for yet."""
        return bool(self._suspects(self._sentinel))

    def end(self) -> None:
        """Where the sentinel was off when it was last measured, mark what was committed since."""
        if self._off is not None and not self.accept_drift:
            position = self._sentinel
            self._mark(self._suspects(position), _suspicion(position, self._off))

    def check(self) -> None:
        """Measure the sentinel again before a session adds anything, if there is one.

        Where it has changed, what an earlier session measured after its last look at it is suspect: it lies between
        the two.

        Raises DriftError: it is not what the bank holds, or cannot be measured; nothing was added. InstrumentError: an
        instrument failed for good.
        """
        if (position := self._sentinel) is not None:
            self._since = [row for row in self._since if self._bank.status[row]]
            found = "is not what the bank holds", "; nothing was added; ", ", or start a new bank"
            self._look(position, "resume", *found)
            self._since.clear()

    def check_again(self) -> None:
        """Measure the sentinel again during a session; where it has changed, what came since it was steady is suspect.

        Raises DriftError: it has changed too much to go on. InstrumentError: an instrument failed for good.
        """
        if (position := self._sentinel) is not None:
            self._look(position, "run", "has changed during the run")
        self._begin_anew()

    def check_last(self) -> None:
        """Measure the sentinel once more when all positions are done; where that cannot be, say so and let it be.

        Raises DriftError, InstrumentError: as `check_again`.
        """
        try:
            self.check_again()
        except SentinelUnusableError as unusable:
            remedy = "the positions measured since it was last steady are unconfirmed"
            doing = "measuring the sentinel position"
            self._session.publish(Fault, "recorder", doing, str(unusable), remedy, self._sentinel, 1, retried=False)
            self._begin_anew()

    @property
    def _sentinel(self) -> int | None:
        return sentinel_of(self._bank.status)

    def _suspects(self, sentinel: int | None) -> tuple[int, ...]:
        """What was committed since the sentinel was last steady; the sentinel is what the others are compared with."""
        return tuple(dict.fromkeys(position for position in self._since if position != sentinel))

    def _look(self, position: int, occasion: str, found: str, then: str = "; ", otherwise: str = "") -> None:
        """Measure the sentinel, and once more before a change is believed that makes rows suspect, or ends a run."""
        # A row that was measured aside of a dark spot, or with a larger range, is compared with what is measured so.
        held, setup, plan = self._bank.record(position), self._station.setup, self._station.plan
        attempt = as_measured(position, held.attempts, held.moved_mm, held.peak_v, setup, plan)
        (figures, rows), suspects = self._measured(attempt), self._suspects(position)
        if self._changed(figures) and (suspects or occasion == "run"):
            self._publish(position, figures, occasion)
            (figures, rows), occasion = self._measured(replace(attempt, number=2)), "repeat"
        suspects = suspects if self._changed(figures) else ()
        self._publish(position, figures, occasion, suspects)
        self._off = figures if figures.speaks_against(self._limits) else None
        if self._off is None:
            self._good = {position: rows}
        if suspects:
            self._mark(suspects, _suspicion(position, figures))
        if figures.verdict(self._limits) == "stop" and not self.accept_drift:
            raise DriftError(
                f"sentinel position {position} {found}: {figures}{then}{_put_right(suspects)}{otherwise}",
                suspects,
            )

    def _changed(self, figures: DriftFigures) -> bool:
        return figures.speaks_against(self._limits) and not self.accept_drift

    def _publish(self, position: int, figures: DriftFigures, occasion: str, suspect: tuple[int, ...] = ()) -> None:
        found = figures.level_db, figures.delay_samples, figures.correlation
        self._session.publish(
            Drift, position, *found, figures.verdict(self._limits), occasion, "", suspect, figures.change
        )

    def _begin_anew(self) -> None:
        self._since.clear()
        self._recorded = 0
        self._looked_s = self._session.time_s()

    def _measured(self, attempt: Attempt) -> tuple[DriftFigures, Look]:
        result = self._station.measure(attempt, "sentinel", says_nothing)
        self._report.done("sentinel")
        if result.estimate is None or says_nothing(result):
            raise SentinelUnusableError(
                f"sentinel position {attempt.position} could not be measured: {result.judgement.reason}; "
                "check cables and laser, then resume"
            )
        now = Look(result.estimate.green, result.estimate.snr_db)
        first = Look(self._bank.green(attempt.position), self._bank.record(attempt.position).snr_db)
        good = self._good.get(attempt.position)
        return compare_looks(self._station.plan, attempt.position, first, now, good), now


def _put_right(suspects: tuple[int, ...]) -> str:
    if not suspects:
        return "put it right and resume"
    marked = f"positions {row_ranges(suspects)}, measured since it was last steady, are marked as suspect"
    return f"{marked}; put it right and measure them again"


def says_nothing(result: AttemptResult) -> bool:
    """Whether a measurement says nothing of the plate: no estimate, or a reference that is not as it was."""
    return result.estimate is None or REFERENCE_LEVEL in result.defect_names


def _suspicion(sentinel: int | None, figures: DriftFigures) -> str:
    return (
        f"sentinel position {sentinel} had changed at once by more than drift does ({figures}) when it was measured "
        "next: the vibrometer's range, a gain, a delay, the mirror or the plate changed at some time before; put it "
        "right, then wavefocus remeasure"
    )
