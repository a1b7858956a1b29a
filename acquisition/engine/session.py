"""Events, counts and remaining time of one session."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from statistics import median

import numpy as np
from numpy.typing import NDArray

from acquisition.engine.events import (
    ConditionsSeen,
    Drift,
    Fault,
    PassStarted,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    RecordTaken,
    SessionEnded,
    SessionStarted,
    State,
    Subscriber,
)
from acquisition.engine.states import Lifecycle
from acquisition.measuring.attempt import Attempt, AttemptResult
from acquisition.measuring.setup import Setup
from acquisition.quality.judgement import Judgement
from acquisition.quality.limits import DriftFigures
from acquisition.schedule.plan import Plan, sentinel_of
from drivers.errors import InstrumentError
from storage.bank.writer import BankWriter
from storage.point_status import status_counts

# Recent enough to follow a rig that slows down, long enough that a few slow positions do not move the finish.
LATEST = 30


class Pace:
    """Learns from every attempt; one clock per instance.

    The median of the latest attempts says how long one takes, so that single long ones (an audio server that stumbled)
    do not move it. How many attempts a position takes is their mean over as many positions: repeats are rare and
    cost time all the same. Outages are not counted, for `working_s` stands still meanwhile.

    Parameters
    ----------
    working_s : float
        What the clock says at the beginning.
    """

    def __init__(self, working_s: float) -> None:
        self._last_s = working_s
        self._attempt_s: deque[float] = deque(maxlen=LATEST)
        self._attempts_of: deque[int] = deque(maxlen=LATEST)
        self._sentinel_s: deque[float] = deque(maxlen=LATEST)

    def attempt_done(self, working_s: float) -> None:
        """An attempt had all its records at `working_s`."""
        self._attempt_s.append(working_s - self._last_s)
        self._last_s = working_s

    def sentinel_done(self, working_s: float) -> None:
        """A measurement of the sentinel position came to its end."""
        self._sentinel_s.append(working_s - self._last_s)
        self._last_s = working_s

    def position_settled(self, attempts: int) -> None:
        """A position is done with, after so many attempts in this session."""
        self._attempts_of.append(attempts)

    @property
    def position_s(self) -> float:
        """Seconds that a position takes, its expected repeats included; 0 before the first."""
        if not self._attempt_s:
            return 0.0
        attempts = sum(self._attempts_of) / len(self._attempts_of) if self._attempts_of else 1.0
        return median(self._attempt_s) * max(1.0, attempts)

    def remaining_s(self, positions: int, sentinel_passes: int, working_s: float | None = None) -> float:
        """Seconds for so many positions and measurements of the sentinel.

        Parameters
        ----------
        positions : int
            Positions not begun yet.
        sentinel_passes : int
            Measurements of the sentinel to come.
        working_s : float, optional
            What the clock says, where one more position is being recorded: what that still takes counts, too.
        """
        under_way_s = 0.0 if working_s is None else max(0.0, self.position_s - (working_s - self._last_s))
        # Before the first, a sentinel is taken for a position like any other.
        sentinel_s = median(self._sentinel_s) if self._sentinel_s else self.position_s
        return under_way_s + positions * self.position_s + sentinel_passes * sentinel_s


class Session:
    """Publishes the events of one session, timed by its lifecycle.

    Parameters
    ----------
    plan : Plan
        What is measured.
    setup : Setup
        With what.
    bank : BankWriter
        Where it goes; its status is what counts as done.
    life : Lifecycle
        The session's state and time.
    publish : callable
        Receives every event.
    """

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, life: Lifecycle, publish: Subscriber) -> None:
        self._plan = plan
        self._setup = setup
        self._bank = bank
        self._life = life
        self._publish = publish
        self._pace = Pace(0.0), Pace(0.0)
        self._recording = False
        self._second_looks = 0

    def start(self, rows: NDArray[np.int64], instruments: tuple[str, ...], *, second_looks: bool) -> None:
        """Tell that the session begins, with which instruments and how much to do."""
        self._second_looks = self._plan.second_looks(rows) if second_looks else 0
        to_do = len(rows)
        self._publish(
            SessionStarted(
                self._life.time_s(),
                str(self._bank.path),
                self._plan.positions,
                self._plan.actuators,
                self._done(),
                to_do,
                self._plan.campaign_s(rows, self._setup),
                instruments,
            )
        )
        self._life.enter(State.RUNNING, f"{to_do} positions to do")
        self._pace = tuple(map(Pace, self._life.working_s()))  # type: ignore[assignment]

    def begin(self, attempt: Attempt) -> None:
        """Tell that an attempt's first record begins."""
        x_mm, y_mm = (float(value) for value in self._plan.position_mm[attempt.position])
        self._recording = True
        self._publish(PositionStarted(self._life.time_s(), attempt.position, attempt.number, x_mm, y_mm))

    def record_taken(self, attempt: Attempt, record: int, records: int) -> None:
        """Tell that a record of an attempt is in, `record` counted from 1."""
        if records > 1:
            self._publish(RecordTaken(self._life.time_s(), attempt.position, attempt.number, record, records))

    def measures_again(self, positions: tuple[int, ...]) -> None:
        """Tell that a pass over all that is not valid begins."""
        self._second_looks = 0  # from here on they are among those that are left
        self._publish(PassStarted(self._life.time_s(), positions))

    def attempt_recorded(self) -> None:
        """Note that the attempt that was begun has all its records, or was given up."""
        self._recording = False
        for pace, working_s in zip(self._pace, self._life.working_s(), strict=True):
            pace.attempt_done(working_s)

    def repeat(self, result: AttemptResult, following: Attempt) -> None:
        """Tell that an attempt was not good enough, and what the next one tries."""
        attempt = result.attempt
        self._publish(
            PositionRepeated(
                self._life.time_s(),
                attempt.position,
                attempt.number,
                result.judgement.reason,
                result.defect_names,
                following.response_range_v,
                following.moved_mm,
            )
        )

    def settle(self, result: AttemptResult, left: int) -> None:
        """Tell that a position is done with for this session, and how far the session is, with `left` not begun yet."""
        position = result.attempt.position
        if result.committed:
            self._publish(
                PositionCommitted(
                    self._life.time_s(),
                    position,
                    int(result.judgement.status),
                    int(self._bank.attempts[position]),
                    result.median_snr_db,
                    result.best_heard_residual_db,
                    result.clock_ppm,
                    result.start_offset_samples,
                    result.judgement.reason,
                    result.defect_names,
                    result.attempt.response_range_v,
                    result.attempt.moved_mm,
                )
            )
        else:
            kept = result.attempt.number, result.judgement.reason, result.defect_names
            self._publish(PositionKept(self._life.time_s(), position, *kept))
        for pace in self._pace:
            pace.position_settled(result.attempt.of_session)
        self._progress(left)

    def differs(self, position: int, judgement: Judgement) -> None:
        """Report that a position's row in the bank is poor, for its neighbours contradict it."""
        names = tuple(defect.name for defect in judgement.defects)
        unknown = (math.nan,) * 4
        self._publish(
            PositionCommitted(
                self._life.time_s(),
                position,
                int(judgement.status),
                int(self._bank.attempts[position]),
                *unknown,
                judgement.reason,
                names,
            )
        )

    def fault(self, fault: InstrumentError, attempt: Attempt | None, *, retried: bool) -> None:
        """Tell that an instrument failed."""
        self._publish(
            Fault(
                self._life.time_s(),
                fault.instrument,
                fault.operation,
                fault.cause,
                fault.remedy,
                None if attempt is None else attempt.position,
                None if attempt is None else attempt.number,
                retried,
            )
        )

    def drift(self, position: int, figures: DriftFigures, occasion: str, *, suspect: tuple[int, ...] = ()) -> None:
        """Tell how the sentinel position compares with what the bank holds of it."""
        limits = self._plan.drift
        self._publish(
            Drift(
                self._life.time_s(),
                position,
                figures.level_db,
                figures.delay_samples,
                figures.correlation,
                figures.verdict(limits),
                occasion,
                figures.cause(limits),
                suspect,
            )
        )

    def sentinel_done(self) -> None:
        """Note how long the sentinel's measurement took; it is no position."""
        for pace, working_s in zip(self._pace, self._life.working_s(), strict=True):
            pace.sentinel_done(working_s)

    def conditions(self, values: Mapping[str, float], reason: str, *, back: bool) -> None:
        """Tell what is known of the watched conditions."""
        self._publish(ConditionsSeen(self._life.time_s(), dict(values), back, reason))

    def end(self, state: State, reason: str, failure: str = "") -> SessionEnded:
        """Tell that the session is over, and how."""
        self._life.enter(state, reason)
        ended = SessionEnded(
            self._life.time_s(), state, self._done(), self._plan.positions, status_counts(self._bank.status), failure
        )
        self._publish(ended)
        return ended

    def _progress(self, left: int) -> None:
        left += self._second_looks
        (rig, wall), (rig_s, wall_s) = self._pace, self._life.working_s()
        passes = 0
        if sentinel_of(self._plan, self._bank.status) is not None:
            passes = self._plan.drift.passes(left, rig.position_s)
        self._publish(
            Progress(
                self._life.time_s(),
                self._done(),
                self._plan.positions,
                self._life.time_s(),
                rig.remaining_s(left, passes, rig_s if self._recording else None),
                wall.remaining_s(left, passes, wall_s if self._recording else None),
                3600.0 / rig.position_s if rig.position_s > 0 else 0.0,
                3600.0 / wall.position_s if wall.position_s > 0 else 0.0,
            )
        )

    def _done(self) -> int:
        return int(np.count_nonzero(self._bank.status))
