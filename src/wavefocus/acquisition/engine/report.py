"""Events, counts and remaining time of one session of a campaign."""

import math

import numpy as np

from wavefocus.acquisition.attempt import Attempt, AttemptResult
from wavefocus.acquisition.engine.session import Session
from wavefocus.acquisition.judgement import Judgement
from wavefocus.acquisition.plan import CampaignPace, Measurement, Plan, sentinel_of
from wavefocus.acquisition.setup import Setup, identities_of
from wavefocus.calibration import Int64Array
from wavefocus.config.messages import campaign
from wavefocus.config.messages.campaign import SessionEnded, State
from wavefocus.storage.bank.ledger import status_counts
from wavefocus.storage.bank.writer import BankWriter


class CampaignReport:
    """Publishes what becomes of positions, and how long the rest will take."""

    def __init__(self, plan: Plan, setup: Setup, bank: BankWriter, session: Session) -> None:
        self._plan, self._setup, self._bank, self._session = plan, setup, bank, session
        self._pace = CampaignPace(0.0), CampaignPace(0.0)
        self._second_looks = 0

    def start(self, rows: Int64Array, instruments: tuple[str, ...], *, second_looks: bool) -> None:
        """The session begins, with these rows to do, and perhaps with second looks to come after them."""
        self._second_looks = self._plan.second_looks(rows) if second_looks else 0
        size = self._plan.positions, self._plan.actuators, self._done(), len(rows)
        planned_s = self._plan.campaign_s(rows, self._setup)
        devices = identities_of(self._setup)
        self._session.publish(campaign.SessionStarted, str(self._bank.path), *size, planned_s, instruments, devices)
        self._session.enter(State.RUNNING, f"{len(rows)} positions to do")
        rig_s, wall_s = self._session.working_s()
        self._pace = CampaignPace(rig_s), CampaignPace(wall_s)

    def begin_pass(self, positions: tuple[int, ...]) -> None:
        """A pass over all that is not valid begins."""
        self._second_looks = 0  # from here on they are among those that are left
        self._session.publish(campaign.PassStarted, positions)

    def done(self, what: Measurement, looks: int = 1) -> None:
        """An attempt has all its records, or was given up; or the sentinel or the leak was measured."""
        for pace, working_s in zip(self._pace, self._session.working_s(), strict=True):
            pace.done(what, working_s, looks)

    def repeat(self, result: AttemptResult, following: Attempt) -> None:
        """An attempt was not good enough; the next one follows."""
        why = result.attempt.position, result.attempt.number, result.judgement.reason, result.defect_names
        self._session.publish(campaign.PositionRepeated, *why, following.response_range_v, following.moved_mm)

    def position_done(self, result: AttemptResult, left: int, *, recording: bool) -> None:
        """A position is done with for this session; `left` are not begun yet, and one may be recorded just now."""
        attempt = result.attempt
        if result.committed:
            self._committed(attempt, result.judgement, result.figures)
        else:
            reason = result.judgement.reason
            self._session.publish(campaign.PositionKept, attempt.position, attempt.number, reason, result.defect_names)
        for pace in self._pace:
            pace.position_settled(attempt.of_session)
        self._progress(left, recording=recording)

    def marked(self, position: int, judgement: Judgement) -> None:
        """A position's row in the bank is poor now: its neighbours contradict it, or cannot judge it."""
        self._committed(Attempt(position, 0, 0), judgement, (math.nan,) * 4)

    def end(self, state: State, reason: str, failure: str = "") -> SessionEnded:
        """The session is over."""
        self._session.enter(state, reason)
        counts = status_counts(self._bank.status)
        return self._session.publish(SessionEnded, state, self._done(), self._plan.positions, counts, failure)

    def _committed(self, attempt: Attempt, judgement: Judgement, figures: tuple[float, float, float, float]) -> None:
        names = tuple(defect.name for defect in judgement.defects)
        counts = attempt.position, int(judgement.status), int(self._bank.attempts[attempt.position])
        tried = attempt.response_range_v, attempt.moved_mm
        self._session.publish(campaign.PositionCommitted, *counts, *figures, judgement.reason, names, *tried)

    def _progress(self, left: int, *, recording: bool) -> None:
        left += self._second_looks
        passes, session = 0, self._session
        if sentinel_of(self._bank.status) is not None:
            passes = max(1, self._plan.drift.passes(left + 1, self._pace[0].position_s))  # it is measured last, too
        remaining_s = [
            pace.remaining_s(left, passes, working_s if recording else None)
            for pace, working_s in zip(self._pace, session.working_s(), strict=True)
        ]
        per_hour = [3600.0 / pace.position_s if pace.position_s > 0 else 0.0 for pace in self._pace]
        done = self._done(), self._plan.positions, session.time_s()
        session.publish(campaign.Progress, *done, *remaining_s, *per_hour)

    def _done(self) -> int:
        return int(np.count_nonzero(self._bank.status))
