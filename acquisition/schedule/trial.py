"""Before a staggered campaign: one position measured both ways and at two levels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acquisition.engine.measuring import Measuring, measuring_of
from acquisition.engine.pointing import point_at
from acquisition.engine.position_records import RECORD_REPEATS
from acquisition.engine.record import take_record
from acquisition.engine.setup import Setup
from acquisition.schedule.plan import GROUP, Plan
from acquisition.schedule.trial_verdict import Band, Candidate, Verdict, choose, repeated_error, sequential_errors
from calibration.clock.timing import ReferenceMissingError
from calibration.estimator.decay import Decay, measure_decay
from calibration.estimator.sequential import Estimate
from calibration.excitation.staggered_signal import StaggeredSignal
from drivers.errors import TransientInstrumentError
from drivers.protocols import Recording, Take
from storage.errors import InputError

LOWER_DB = -6.0
# A staggered record is taken so often, and the two that agree best count: a moment of speckle spoils all of one.
TAKES = 3


@dataclass(frozen=True, slots=True)
class Trial:
    """What was tried, and what follows.

    Parameters
    ----------
    position : int
        Where.
    candidates : tuple of Candidate
        The schedule that was asked for first.
    verdict : Verdict
        Which is taken, and why.
    decay : Decay or None
        How the responses fall; None where noise hides it.
    took_s : float
        Seconds on the rig's clock.
    """

    position: int
    candidates: tuple[Candidate, ...]
    verdict: Verdict
    decay: Decay | None
    took_s: float


def check_position(plan: Plan) -> int:
    """The position nearest to the middle of the grid."""
    middle = (plan.position_mm.min(axis=0) + plan.position_mm.max(axis=0)) / 2
    return int(np.argmin(np.hypot(*(plan.position_mm - middle).T)))


def run_trial(plan: Plan, setup: Setup, allowed_loss_db: float) -> Trial:
    """Measure one position by every schedule that comes into question, and choose.

    Parameters
    ----------
    plan : Plan
        The staggered plan that was asked for.
    setup : Setup
        With what.
    allowed_loss_db : float
        As of `acquisition.schedule.trial_verdict.choose`.

    Raises
    ------
    InputError
        The responses ring longer than the plan's taps.
    InstrumentError
        An instrument failed.
    """
    if plan.staggered is None:
        raise InputError("the plan is sequential; only a staggered one needs a trial")
    clock = setup.instruments.clock
    began_s = clock.now_s()
    position = check_position(plan)
    point_at(setup, *plan.position_mm[position])
    bench = _Bench(plan, setup, position)
    excitation = plan.excitation
    window_s = excitation.period_samples / excitation.sample_rate_hz
    band = Band(excitation.band_hz, excitation.sample_rate_hz, plan.taps)
    tried = [bench.tried(0, level_db) for level_db in (0.0, LOWER_DB)]
    full, half = (one.estimates[0] for one in tried)
    errors, reference, own = sequential_errors(
        band.spectra(full.green),
        band.spectra(half.green),
        band.own_noise(full, window_s),
        band.own_noise(half, window_s),
    )
    decay = _decay(plan, half if errors[1] < errors[0] else full)
    sequential = [bench.candidate(one, error_db) for one, error_db in zip(tried, errors, strict=True)]
    staggered = [
        bench.candidate(one, repeated_error([band.spectra(take.green) for take in one.estimates], reference, own))
        for groups in dict.fromkeys((plan.staggered.groups, max(plan.staggered.groups, -(-plan.actuators // GROUP))))
        for one in (bench.tried(groups, level_db) for level_db in (0.0, LOWER_DB))
    ]
    candidates = (*staggered, *sequential)
    verdict = choose(list(candidates), allowed_loss_db)
    return Trial(position, candidates, verdict, decay, clock.now_s() - began_s)


def scheduled(plan: Plan, groups: int, level_db: float) -> Plan:
    """A plan with another schedule, at another level."""
    factor = 10 ** (level_db / 20)
    excitation = replace(plan.excitation, amplitude_v=plan.excitation.amplitude_v * factor)
    if not groups:
        return replace(plan, excitation=excitation, staggered=None)
    signal = plan.staggered
    if signal is None:
        raise InputError("the plan is sequential; it has no stagger to keep")
    return replace(plan, excitation=excitation, staggered=replace(signal, sweep=excitation, groups=groups))


@dataclass(frozen=True, slots=True)
class _Tried:
    """A schedule's plan and what its takes measured."""

    plan: Plan
    groups: int
    level_db: float
    estimates: tuple[Estimate, ...]
    over_range: bool


class _Bench:
    """Measures the check position by one schedule after the other."""

    def __init__(self, plan: Plan, setup: Setup, position: int) -> None:
        self._plan, self._setup, self._position = plan, setup, position
        self._attempt = 0

    def tried(self, groups: int, level_db: float) -> _Tried:
        """Measure by one schedule, staggered ones several times."""
        plan = scheduled(self._plan, groups, level_db)
        measuring = measuring_of(plan, self._setup)
        takes = [self._measured(plan, measuring) for _ in range(TAKES if groups else 1)]
        return _Tried(plan, groups, level_db, tuple(one for one, _ in takes), any(left for _, left in takes))

    def candidate(self, one: _Tried, error_db: float) -> Candidate:
        """A schedule for the verdict."""
        campaign_s = one.plan.positions * one.plan.position_s(self._setup)
        error_db = float("inf") if one.over_range else error_db
        return Candidate(_name(one), one.groups, one.level_db, campaign_s, error_db)

    def _measured(self, plan: Plan, measuring: Measuring) -> tuple[Estimate, bool]:
        self._attempt += 1
        rate_hz = plan.excitation.sample_rate_hz
        recordings: list[Recording] = []
        for play in measuring.plays:
            take = Take(self._position, self._attempt, play.actuator, "trial")
            for again in reversed(range(RECORD_REPEATS + 1)):
                try:
                    recordings.append(play.cut(take_record(self._setup, play.signals_v, rate_hz, take, play.samples)))
                    break
                except TransientInstrumentError:
                    if not again:
                        raise
        reference_v, response_v = (np.stack([one.volts[row] for one in recordings]) for row in range(2))
        try:
            estimate = measuring.estimator.estimate(reference_v, response_v, range_v=self._setup.range_v)
        except ReferenceMissingError as missing:
            raise InputError(f"the trial before the campaign failed: {missing}") from missing
        left = any(any(one.over_range) for one in recordings) or bool(np.any(estimate.clip_count))
        return estimate, left


def _name(one: _Tried) -> str:
    level = f" at {one.level_db:g} dB" if one.level_db else ""
    if not one.groups:
        return f"sequential capture{level}"
    if one.groups == 1:
        return f"staggered capture{level}"
    slots = one.plan.staggered.slots if isinstance(one.plan.staggered, StaggeredSignal) else 1
    return f"staggered capture in {one.groups} groups of {slots}{level}"


def _decay(plan: Plan, estimate: Estimate) -> Decay | None:
    """How the responses fall, where that can be told; refused when they ring longer than the taps."""
    try:
        decay = measure_decay(estimate.green, plan.excitation.sample_rate_hz)
    except InputError:
        return None
    decay.require(plan.taps)
    return decay
