"""Crosstalk in the rows of a campaign: looked for at every check of the sentinel and when the round is over."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavefocus.acquisition.attempt import AttemptResult
from wavefocus.acquisition.defects import Cure, RecordDefect
from wavefocus.acquisition.judgement import Judgement
from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration import Int64Array
from wavefocus.calibration.crosstalk import REMEDY, Crosstalk, crosstalk_of_rows, spread_positions, taps_needed
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.point_status import Status, usable

# So many positions show a leak of -80 dB on every virtual plate; the sentinel is due after as many, by default.
TOGETHER = 50
MORE_TOGETHER = 4 * TOGETHER
DEFECT = "crosstalk"


class CrosstalkWatch:
    """Looks for a leak of the loopback in what the bank holds, and judges what is measured while there is one.

    plan: Where positions and actuators are.
    setup: Has the unit of the rows per volt.
    bank: Open for writing.

    found: The leak that the latest positions show; None where they show none.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter) -> None:
        self._plan, self._setup, self._bank = plan, setup, bank
        self._rows: list[int] = []
        self._rows_before: list[int] = []
        """Positions of earlier sessions: marked with the others, but no part of what is measured now."""
        self._unseen = 0
        self._earlier: Int64Array | None = np.flatnonzero(bank.status == Status.VALID)
        self._clear: set[int] = set()
        """Positions among which a leak that must be named would have shown, and did not."""
        self.found: Crosstalk | None = None

    def committed(self, position: int) -> None:
        """Note a position that was committed."""
        self._rows.append(position)
        self._unseen += 1

    @property
    def due(self) -> bool:
        """Whether something was committed that was not looked at."""
        return self._unseen > 0

    def look(self) -> tuple[Crosstalk | None, tuple[int, ...]]:
        """Measure the leak in the latest positions, and mark as poor those that have it.

        Where they show one, so are marked all others that no quiet enough measurement has cleared of it.

        Positions of earlier sessions, which a kill may have kept from being looked at, are looked at first.

        Returns what the latest positions show, or else those of earlier sessions that have a leak, None where they are
        too few; and the positions that were marked.
        """
        marked, earlier = [], None
        if self._earlier is not None:
            for first in range(0, len(self._earlier), TOGETHER):
                some = self._earlier[first : first + TOGETHER]
                found = self._measure(some)
                self._rows_before += some.tolist()
                marked += list(self._mark(some, found))
                earlier = found if found is not None and found.is_named else earlier
            self._earlier = None
        latest = np.array(self._rows[-max(TOGETHER, self._unseen) :], dtype=np.int64)
        seen = self._measure(latest)
        if seen is not None and not (seen.is_named or seen.is_resolved):
            # On glass without an edge it takes some hundred positions to be sure.
            latest = np.array(self._rows[-max(MORE_TOGETHER, self._unseen) :], dtype=np.int64)
            seen = self._measure(latest)
        self._unseen = 0
        if seen is not None:
            self.found = seen if seen.is_named else None
            marked += list(self._mark(latest, seen))
        return earlier if seen is None else seen, tuple(marked)

    def judged(self, result: AttemptResult) -> AttemptResult:
        """A good attempt is poor while there is a leak."""
        if self.found is None or not result.judgement.good:
            return result
        return replace(result, judgement=judgement_of(self.found, result.judgement.score))

    def _measure(self, positions: Int64Array) -> Crosstalk | None:
        excitation = self._plan.excitation
        rate_hz, band_hz = excitation.sample_rate_hz, excitation.band_hz
        rows = spread_positions(positions[usable(self._bank.status[positions])])
        if not len(rows):
            return None
        taps = taps_needed(rate_hz, band_hz)
        green = np.stack([self._bank.green(row)[:, :taps] for row in rows.tolist()])
        place_mm, actuator_mm = self._plan.position_mm[rows], self._plan.actuator_mm
        return crosstalk_of_rows(green, place_mm, actuator_mm, rate_hz, band_hz, self._setup.response_per_volt)

    def _mark(self, positions: Int64Array, found: Crosstalk | None) -> Iterator[int]:
        if found is None or not found.is_named:
            if found is not None and found.is_resolved:
                self._clear.update(positions.tolist())
            return
        others = [row for row in (*self._rows_before, *self._rows) if row not in self._clear]
        for position in dict.fromkeys([*positions.tolist(), *others]):
            if self._bank.status[position] == Status.VALID:
                self._bank.amend(position, status=int(Status.POOR_SIGNAL))
                yield position


def judgement_of(found: Crosstalk, score: float = 0.0) -> Judgement:
    """Poor, because of a leak."""
    sentence = f"crosstalk: the loopback leaks into {found.rows}: {found}: {REMEDY}"
    return Judgement(
        Status.POOR_SIGNAL, sentence, score, (RecordDefect(DEFECT, found.actuators, sentence, Cure.NOTHING),)
    )
