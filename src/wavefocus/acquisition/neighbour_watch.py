"""Positions against their neighbours, or, on coarse grids, all others: what a position's own records cannot show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.acquisition.attempt import MEASURED, AttemptResult
from wavefocus.acquisition.judgement import (
    Cure,
    Judgement,
    PositionRow,
    RecordDefect,
    difference,
    differing,
    in_band,
    poor,
)
from wavefocus.acquisition.plan import Plan
from wavefocus.calibration import BoolArray, Float32Array, Int64Array
from wavefocus.calibration.coarse_grid.left_out_rows import waves_of_rows
from wavefocus.calibration.evidence import CERTAIN_SHARE
from wavefocus.calibration.neighbour_judge import NeighbourDifference, RowsAtFrequencies, judge_rows
from wavefocus.storage.bank.layout import rows_off_grid
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.bank.writer import BankWriter

if TYPE_CHECKING:
    from wavefocus.calibration.coarse_grid.rim_waves import WavesFound

NEIGHBOURHOOD = 250
"""So many nearest positions are enough to judge one."""


_SENTENCE = "the other positions cannot judge it: a second measurement must agree with it"
UNCONFIRMED = poor("neighbours", _SENTENCE, Cure.AGAIN)


class NeighbourWatch:
    """Judges what the bank holds, and a repeat before it is committed: by neighbours, on coarse grids by waves.

    Verdicts depend only on the bank, so that a campaign that is killed anywhere goes on as one that is not: until a
    pass replaces it, a row that is marked counts as it did before.

    plan: Where positions and actuators are.
    bank: Open for writing.
    """

    def __init__(self, plan: Plan, bank: BankWriter) -> None:
        self._plan = plan
        self._bank = bank
        self._marked: dict[int, bool] = {}
        self._waves: tuple[bytes, WavesFound | None] = b"", None

    def is_done(self, covered: Int64Array) -> bool:
        """Whether `mark` came to its end for these positions: the last of them says so."""
        if not len(covered):
            return True
        last = int(covered[-1])
        return bool(self._bank.status[last]) and self._bank.record(last).neighbour_round == len(covered)

    def mark(self, covered: Int64Array) -> Iterator[tuple[int, Judgement]]:
        """Mark as poor what neighbours contradict, and, where the plan wants second looks, what they cannot judge.

        Rows that had a repeat in a pass are not judged once more. Whatever of it an interrupted session marked, the
        marks come out the same.

        covered: Positions to judge, in the order of measurement, all of them measured.

        Yields each position as it is marked.
        """
        self._marked.clear()
        status, attempts = self._bank.status, self._bank.attempts
        rows = status == Status.VALID
        for position in np.flatnonzero(status == Status.POOR_SIGNAL).tolist():
            record = self._bank.record(position)
            rows[position] = record.neighbour_round == len(covered) and not record.suspect
        differences, judged = self._differences(np.flatnonzero(rows), {})
        judgement: Judgement | None
        for position in covered[(status[covered] == Status.VALID)].tolist():
            if attempts[position] > self._plan.quality.max_attempts:
                continue
            judgement = _judgement(differences[position]) if position in differences else None
            if judgement is None and self._plan.quality.confirms and position not in judged:
                judgement = UNCONFIRMED
            if judgement is not None:
                alone, status_now = judgement is UNCONFIRMED, int(judgement.status)
                self._bank.amend(position, status=status_now, neighbour_round=len(covered), unjudgeable=alone)
                yield position, judgement
        # Sessions for some scenes only leave no note: the rest of the campaign is judged with theirs.
        if len(covered) == self._plan.positions and not self.is_done(covered):
            self._bank.amend(int(covered[-1]), neighbour_round=len(covered), unjudgeable=False)

    def confirmed(
        self, result: AttemptResult, earlier: AttemptResult | None, *, repeat: bool, replaceable: bool
    ) -> AttemptResult:
        """Judge a good attempt by what the bank holds of the position, and a repeat by its neighbours.

        A valid row is replaced only by one that agrees with it; where it may be replaced by another one, two attempts
        must agree with each other. So must two where neighbours cannot judge a repeat.

        result: Judged by its own records.
        earlier: The best attempt before it in this session.
        repeat: Whether the position is measured after all others, even where the bank holds nothing of it.
        replaceable: Whether a valid row may be replaced by another one.
        """
        position, judgement, row = result.attempt.position, result.judgement, self._row_of(result)
        if row is None or result.estimate is None or not judgement.good:
            return result
        status = Status(int(self._bank.status[position]))
        must_agree, twice = status == Status.VALID, replaceable
        if (repeat or status) and (replaceable or not must_agree):
            judged = False
            if not self._alone()[position]:
                judgement, judged = self.judge(position, result.estimate.green, judgement)
            if not judged and self._plan.quality.confirms:
                must_agree = twice = True
        if not (must_agree and judgement.good):
            return replace(result, judgement=judgement)
        apart: tuple[tuple[int, ...], str] = (), ""
        if status & MEASURED:
            record, sweep = self._bank.record(position), self._plan.excitation
            held = in_band(self._bank.green(position), sweep.sample_rate_hz, sweep.band_hz)
            apart = difference(PositionRow(held, record.snr_db, record.moved_mm), row)
            if not apart[0]:
                return result
        before = None if earlier is None else self._row_of(earlier)
        if twice and before is not None and not difference(before, row)[0]:
            return result
        if apart[0]:
            return replace(result, judgement=differing(*apart, judgement.score, replaceable=replaceable))
        return replace(result, judgement=replace(UNCONFIRMED, score=judgement.score))

    def _row_of(self, result: AttemptResult) -> PositionRow | None:
        """What an attempt would put into the bank, to be compared; None where it has no estimate."""
        if result.estimate is None:
            return None
        sweep = self._plan.excitation
        spectrum = in_band(result.estimate.green, sweep.sample_rate_hz, sweep.band_hz)
        return PositionRow(spectrum, result.estimate.snr_db, math.hypot(*result.attempt.moved_mm))

    def judge(self, position: int, green: Float32Array, before: Judgement) -> tuple[Judgement, bool]:
        """Judge a repeat that is good by its own records.

        Where it differs from its neighbours without a cause in level, time, wiring or place, and what the bank holds
        differs in the same way, it is the plate that differs there: the repeat is good.

        position: Bank row.
        green, float32 (actuators, taps): The repeat.
        before: By its own records.

        Returns the judgement by its own records and its neighbours, and whether neighbours could judge it.
        """
        usable = (self._bank.status == Status.VALID) | self._alone()
        usable[position] = True
        rows = np.flatnonzero(usable)
        apart_mm = np.hypot(*(self._plan.position_mm[rows] - self._plan.position_mm[position]).T)
        rows = np.sort(rows[np.argsort(apart_mm, kind="stable")[:NEIGHBOURHOOD]])
        found, judged = self._differences(rows, {position: green}, self._waves_of_the_first_round)
        differences = found.get(position, ())
        if not differences:
            return before, position in judged
        held = self._bank.green(position)
        if all(difference.kind == "other" and _same(held, green, difference) for difference in differences):
            return before, True
        return _judgement(differences), True

    def _alone(self) -> BoolArray:
        """Positions that neighbours could not judge, and that had no second look yet."""
        poor = np.asarray(self._bank.status == Status.POOR_SIGNAL)
        poor &= self._bank.attempts <= self._plan.quality.max_attempts
        for position in np.flatnonzero(poor).tolist():
            if position not in self._marked:
                self._marked[position] = self._bank.record(position).unjudgeable
            poor[position] = self._marked[position]
        return poor

    def _differences(
        self,
        rows: Int64Array,
        instead: dict[int, Float32Array],
        waves: Callable[[], WavesFound | None] | None = None,
    ) -> tuple[dict[int, tuple[NeighbourDifference, ...]], frozenset[int]]:
        """What differs, and the positions most of whose rows could be judged."""
        if not len(rows):
            return {}, frozenset()
        header, all_rows = self._bank.header, np.ones(len(rows), dtype=bool)
        on_grid = ~rows_off_grid(header.positions, header.check_rows, header.run_json)[rows]
        places = self._plan.position_mm[rows], self._plan.actuator_mm
        verdict = judge_rows(*places, self._spectra(rows, instead), on_grid, all_rows, waves)
        found: dict[int, tuple[NeighbourDifference, ...]] = {}
        for contradiction in verdict.differences:
            row = int(rows[contradiction.position])
            found[row] = (*found.get(row, ()), contradiction)
        # Rows near their own actuator, or of noise, are not judged singly; the others of a position stand for them.
        judged = 2 * verdict.judged.sum(axis=1) > self._plan.actuators
        return found, frozenset(rows[judged].tolist())

    def _spectra(self, rows: Int64Array, instead: dict[int, Float32Array]) -> RowsAtFrequencies:
        plan, header = self._plan, self._bank.header
        spectra = RowsAtFrequencies(len(rows), plan.actuators, plan.taps, header.sample_rate_hz, header.band_hz)
        for number, row in enumerate(rows.tolist()):
            spectra.set(number, instead[row] if row in instead else self._bank.green(row))
        return spectra

    def _waves_of_the_first_round(self) -> WavesFound | None:
        """Waves of the rows that no pass has replaced; None where these are too few.

        They are found once in a pass, and are the same wherever it was interrupted.
        """
        status, attempts = self._bank.status, self._bank.attempts
        rows = np.flatnonzero((status == Status.VALID) & (attempts <= self._plan.quality.max_attempts))
        key = rows.tobytes() + attempts[rows].tobytes()
        if key != self._waves[0]:
            places = self._plan.position_mm[rows], self._plan.actuator_mm
            spectra, every = self._spectra(rows, {}), np.ones(len(rows), dtype=bool)
            self._waves = key, waves_of_rows(*places, spectra.values, spectra.frequency_hz, every)
        return self._waves[1]


def mark_suspects(bank: BankWriter, positions: Sequence[int], reason: str) -> Iterator[tuple[int, Judgement]]:
    """Mark as poor, and as suspect, what was measured while the rig had another scale than the bank.

    Yields each position as it is marked; those that are not valid stay as they are.
    """
    judgement = poor("suspect", reason, Cure.NOTHING)
    for position in positions:
        if bank.status[position] == Status.VALID:
            bank.amend(position, status=int(judgement.status), suspect=True, unjudgeable=False)
            yield position, judgement


def _judgement(differences: tuple[NeighbourDifference, ...]) -> Judgement:
    """Poor, naming what differs."""
    defects = tuple(
        RecordDefect("neighbours", difference.actuators, difference.sentence, Cure.REPEAT) for difference in differences
    )
    score = max(difference.relative for difference in differences)
    return Judgement(Status.POOR_SIGNAL, "; ".join(defect.sentence for defect in defects), score, defects)


def _same(held: Float32Array, green: Float32Array, difference: NeighbourDifference) -> bool:
    """Whether two measurements agree in the rows that differ from the neighbours."""
    rows = list(difference.actuators)
    apart = float(np.linalg.norm(held[rows].astype(np.float64) - green[rows]))
    # The one explains what the other differs by.
    allowed = np.sqrt(1 - CERTAIN_SHARE) * difference.relative
    return apart <= float(allowed * np.linalg.norm(held[rows].astype(np.float64)))
