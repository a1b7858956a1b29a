"""The records of a position: point, play, record, and take again what a passing fault voided."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from acquisition.measuring.attempt import Attempt
from acquisition.measuring.plays import Play
from acquisition.measuring.record import point_at, start_move, take_record
from acquisition.measuring.setup import Setup
from acquisition.schedule.plan import Plan
from drivers.errors import InstrumentError, TransientInstrumentError
from drivers.protocols import Recording, Take

# A record is repeated so often before the whole attempt is given up for a passing fault.
RECORD_REPEATS = 2


class ReportFault(Protocol):
    """Receives faults that passed while records were taken."""

    def __call__(self, fault: InstrumentError, attempt: Attempt | None, *, retried: bool) -> None: ...


class PositionRecords:
    """Takes the records of positions, each of which plays one of `plays`."""

    def __init__(self, plan: Plan, setup: Setup, plays: tuple[Play, ...], report_fault: ReportFault) -> None:
        self._plan, self._setup, self.plays, self._report_fault = plan, setup, plays, report_fault

    def take(
        self, attempt: Attempt, purpose: str, taken: Callable[[int], None] = lambda record: None
    ) -> tuple[Recording, ...]:
        """Point at a position and take all its records.

        attempt: Which position, and which try at it.
        purpose: ``"capture"`` or ``"sentinel"``, for the instruments' logs.
        taken: Called with the number of each record, from 1, once it is in.

        Raises InstrumentError: of the instrument that failed; a passing fault only when repeated records did not cure
        it.
        """
        point_at(self._setup, *self._place_mm(attempt))
        recordings: list[Recording] = []
        for number, play in enumerate(self.plays, 1):
            take = Take(attempt.position, attempt.number, play.actuator, purpose)
            recordings.append(self._record(play, take, attempt))
            taken(number)
        return tuple(recordings)

    def probe(self, attempt: Attempt) -> Recording:
        """Point at a position and take one record, to see how things stand; it goes nowhere.

        Raises InstrumentError: as :meth:`take` does.
        """
        point_at(self._setup, *self._place_mm(attempt))
        play = self.plays[0]
        return self._record(play, Take(attempt.position, attempt.number, play.actuator, "probe"), attempt)

    def set_out_for(self, attempt: Attempt) -> None:
        """Let the mirror set out for a position; when it fails, pointing there will meet that again."""
        try:
            start_move(self._setup, *self._place_mm(attempt))
        except InstrumentError as fault:
            self._report_fault(fault, attempt, retried=True)

    def _place_mm(self, attempt: Attempt) -> tuple[float, float]:
        """Where the beam goes for an attempt."""
        x_mm, y_mm = self._plan.position_mm[attempt.position]
        return float(x_mm) + attempt.moved_mm[0], float(y_mm) + attempt.moved_mm[1]

    def _record(self, play: Play, take: Take, attempt: Attempt) -> Recording:
        setup = self._setup
        if attempt.response_range_v is not None:
            setup = replace(setup, range_v=(setup.range_v[0], attempt.response_range_v))
        rate_hz = self._plan.excitation.sample_rate_hz
        return record_play(setup, play, rate_hz, take, lambda fault: self._report_fault(fault, attempt, retried=True))


def record_play(
    setup: Setup, play: Play, rate_hz: float, take: Take, passed: Callable[[InstrumentError], None] = lambda fault: None
) -> Recording:
    """Take one record, and take it again after a passing fault: an underflow voids a record, not a position."""
    for _ in range(RECORD_REPEATS):
        try:
            return play.cut(take_record(setup, play.signals_v, rate_hz, take, play.samples))
        except TransientInstrumentError as fault:
            passed(fault)
    return play.cut(take_record(setup, play.signals_v, rate_hz, take, play.samples))
