"""Before a staggered campaign: one position measured by every schedule, and the choice among them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.acquisition.attempt import Attempt, PositionRecords
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.plan import GROUP, Plan
from wavefocus.acquisition.plays import Measuring, measuring_of
from wavefocus.acquisition.setup import Setup
from wavefocus.acquisition.wording import hours
from wavefocus.calibration import Complex128Array, Float64Array
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.estimator.noise_error import noise_error_db
from wavefocus.calibration.estimator.schedule_error import Decay, measure_decay
from wavefocus.calibration.excitation import StaggeredSignal
from wavefocus.config.messages.campaign import Subscriber
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Recording
from wavefocus.storage.errors import InputError

# Measurements differ by more than their noise when their difference has so many times its energy.
DISTINCT = 1.3
# A schedule that errs by so much less at half the drive distorts; noise that is always there would err more.
DISTORTS_DB = 3.0
# Noise that is always there doubles with half the drive, 6 dB; less than half of that is noise of the signal's own.
GROWS_DB = 3.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A schedule, tried.

    name: What it is called.
    groups: Records of a position in which several actuators sound; 0 where they sound one after the other.
    level_db: Its drive over the one that was asked for.
    campaign_s: Seconds that the whole campaign would take.
    error_db: Relative L2 error in band of the median actuator; inf where an input's range was left.
    """

    name: str
    groups: int
    level_db: float
    campaign_s: float
    error_db: float


@dataclass(frozen=True, slots=True)
class ScheduleChoice:
    """Which candidate is taken, and why."""

    chosen: Candidate
    reason: str


class BandTransform:
    """Relative energies of Green's functions in a band.

    band_hz: Lowest and highest frequency in Hz.
    taps: Length L of the FIRs.
    """

    def __init__(self, band_hz: tuple[float, float], sample_rate_hz: float, taps: int) -> None:
        self.length = scipy.fft.next_fast_len(2 * taps, real=True)
        hertz = np.arange(self.length // 2 + 1) * sample_rate_hz / self.length
        self._inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
        self._band_hz, self._response_s = band_hz, taps / sample_rate_hz

    def spectra(self, green: NDArray[np.floating]) -> Complex128Array:
        """Spectra (actuators, bins) of FIRs (actuators, taps)."""
        return np.asarray(scipy.fft.rfft(green.astype(np.float64), self.length)[:, self._inside])

    def own_noise(self, estimate: Estimate, window_s: float) -> Float64Array:
        """Share of energy (actuators,) that noise has in the FIRs, by their residuals.

        estimate: Of sequential records.
        window_s: A sweep and its silence in seconds, on which the noise is seen.
        """
        error_db = noise_error_db(
            estimate.snr_db, band_hz=self._band_hz, response_s=self._response_s, period_s=window_s
        )
        return np.asarray(10 ** (0.1 * error_db))


def relative(first: Complex128Array, other: Complex128Array, whole: Complex128Array) -> Float64Array:
    """Energy (actuators,) of a difference over that of the whole."""
    energy = np.square(np.abs(whole)).sum(axis=1)
    return np.asarray(np.square(np.abs(first - other)).sum(axis=1) / np.maximum(energy, 1e-300))


def sequential_errors(
    full: Complex128Array, half: Complex128Array, noise_full: Float64Array, noise_half: Float64Array
) -> tuple[tuple[float, float], Complex128Array, Float64Array]:
    """Errors of sequential capture at full and half drive, and the best guess at the linear plate.

    A cubic term changes a response by the square of its level, so that what differs at half the drive is three
    quarters of what is wrong at full drive.

    full, half, complex128 (actuators, bins): Spectra measured at the two levels.
    noise_full, noise_half, float64 (actuators,): Share of energy that their own noise has.

    Returns median errors in dB at (full, half) drive; the reference spectra; the share of energy that noise has in
    them.
    """
    apart = relative(full, half, full)
    noise = noise_full + noise_half
    distinct = float(np.median(apart)) > DISTINCT * float(np.median(noise))
    wrong = (4 / 3) ** 2 * np.maximum(apart - noise, 0) if distinct else np.zeros_like(noise)
    errors = decibel_of_median(noise_full + wrong), decibel_of_median(noise_half + wrong / 16)
    if not distinct:
        return errors, full, noise_full
    return errors, (4 * half - full) / 3, (16 * noise_half + noise_full) / 9


def repeated_error(takes: list[Complex128Array], reference: Complex128Array, noise: Float64Array) -> float:
    """Error of one take of a schedule, from several of them and a correct reference.

    Noise is what the two takes that agree best do not have in common: a moment of speckle in another one does
    not count. To it comes what both have in common and the reference has not.

    takes, list of complex128 (actuators, bins): Spectra of two takes or more.
    reference, complex128 (actuators, bins): Spectra measured otherwise.
    noise, float64 (actuators,): Share of energy that noise has in the reference.

    Returns median over the actuators, in dB.
    """
    pairs = itertools.combinations(takes, 2)
    first, other = min(pairs, key=lambda pair: float(np.median(relative(pair[0], pair[1], reference))))
    own = relative(first, other, reference) / 2
    expected = noise + own / 2
    apart = relative((first + other) / 2, reference, reference)
    if np.median(apart) > DISTINCT * np.median(expected):
        own = own + np.maximum(apart - expected, 0)
    return decibel_of_median(own)


def decibel_of_median(share: Float64Array) -> float:
    """Median of shares of energy in dB."""
    return 10 * math.log10(max(float(np.median(share)), 1e-30))


def choose(candidates: list[Candidate], allowed_loss_db: float) -> ScheduleChoice:
    """Take the quickest schedule that errs little more than sequential capture.

    candidates: The one that was asked for first, those with groups 0 among them.
    allowed_loss_db: How much more it may err than sequential capture at the better of its levels, in dB.
    """
    asked = candidates[0]
    sequential = min(
        (candidate for candidate in candidates if not candidate.groups),
        key=lambda candidate: (candidate.error_db, candidate.campaign_s),
    )
    good = [candidate for candidate in candidates if candidate.error_db <= sequential.error_db + allowed_loss_db]
    chosen = min(good or [sequential], key=lambda candidate: (candidate.campaign_s, candidate.error_db))
    against = f"{chosen.error_db:.1f} dB in {hours(chosen.campaign_s)}"
    if chosen is not sequential:
        against += f", where {sequential.name} leaves {sequential.error_db:.1f} dB in {hours(sequential.campaign_s)}"
    if chosen is asked:
        return ScheduleChoice(chosen, f"{chosen.name} pays: it leaves {against}")
    return ScheduleChoice(
        chosen, f"{asked.name} does not pay: {_why(asked, candidates)}; {chosen.name} leaves {against}"
    )


def _why(asked: Candidate, candidates: list[Candidate]) -> str:
    if not math.isfinite(asked.error_db):
        return "it leaves the range of an input"
    leaves = f"it leaves {asked.error_db:.1f} dB"
    same = (
        candidate
        for candidate in candidates[1:]
        if candidate.groups == asked.groups and candidate.level_db < asked.level_db
    )
    lower = next((candidate for candidate in same if math.isfinite(candidate.error_db)), None)
    if lower is None:
        return leaves
    gain_db = asked.error_db - lower.error_db
    if gain_db > DISTORTS_DB:
        return f"{leaves} and {lower.error_db:.1f} dB at {lower.level_db - asked.level_db:g} dB, the plate distorts"
    if gain_db > -GROWS_DB:
        return f"{leaves} at either level, its noise grows with the signal"
    return f"{leaves}, noise is too loud for it"


LOWER_DB = -6.0
# A staggered record is taken so often, and the two that agree best count: a moment of speckle spoils all of one.
TAKES = 3


@dataclass(frozen=True, slots=True)
class ScheduleTest:
    """What was tried, and what follows.

    candidates: The schedule that was asked for first.
    verdict: Which is taken, and why.
    decay: How the responses fall; None where noise hides it.
    took_s: Seconds on the rig's clock.
    """

    position: int
    candidates: tuple[Candidate, ...]
    verdict: ScheduleChoice
    decay: Decay | None
    took_s: float


def check_position(plan: Plan) -> int:
    """The position nearest to the middle of the grid."""
    middle = (plan.position_mm.min(axis=0) + plan.position_mm.max(axis=0)) / 2
    return int(np.argmin(np.hypot(*(plan.position_mm - middle).T)))


def run_trial(
    plan: Plan, setup: Setup, allowed_loss_db: float, publish: Subscriber = lambda event: None
) -> ScheduleTest:
    """Measure one position by every schedule that comes into question, and choose.

    plan: The staggered plan that was asked for.
    allowed_loss_db: See `choose`.
    publish: Receives every passing fault, and what is done about it, as in a campaign.

    Raises InputError: the responses ring longer than the plan's taps, or no attempt has a usable reference.
    InstrumentError: an instrument failed for good; passing faults are repeated and lost instruments waited for, as in a
    campaign.
    """
    if plan.staggered is None:
        raise InputError("the plan is sequential; only a staggered one needs a trial")
    clock = setup.instruments.clock
    began_s = clock.now_s()
    position = check_position(plan)
    bench = _Bench(plan, setup, position, Session(clock, publish, StopRequest()))
    excitation = plan.excitation
    window_s = excitation.period_samples / excitation.sample_rate_hz
    band = BandTransform(excitation.band_hz, excitation.sample_rate_hz, plan.taps)
    tried = [bench.tried(0, level_db) for level_db in (0.0, LOWER_DB)]
    full, half = (schedule.estimates[0] for schedule in tried)
    errors, reference, own = sequential_errors(
        band.spectra(full.green),
        band.spectra(half.green),
        band.own_noise(full, window_s),
        band.own_noise(half, window_s),
    )
    decay = _decay(plan, half if errors[1] < errors[0] else full)
    sequential = [bench.candidate(schedule, error_db) for schedule, error_db in zip(tried, errors, strict=True)]
    staggered = [
        bench.candidate(
            schedule, repeated_error([band.spectra(take.green) for take in schedule.estimates], reference, own)
        )
        for groups in dict.fromkeys((plan.staggered.groups, max(plan.staggered.groups, -(-plan.actuators // GROUP))))
        for schedule in (bench.tried(groups, level_db) for level_db in (0.0, LOWER_DB))
    ]
    candidates = (*staggered, *sequential)
    verdict = choose(list(candidates), allowed_loss_db)
    return ScheduleTest(position, candidates, verdict, decay, clock.now_s() - began_s)


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

    def __init__(self, plan: Plan, setup: Setup, position: int, session: Session) -> None:
        self._plan, self._setup, self._position = plan, setup, position
        self._session, self._recovery = session, Recovery(setup, session)
        self._number = 0

    def tried(self, groups: int, level_db: float) -> _Tried:
        """Measure by one schedule, staggered ones several times."""
        plan = scheduled(self._plan, groups, level_db)
        measuring = measuring_of(plan, self._setup)
        takes = [self._measured(plan, measuring) for _ in range(TAKES if groups else 1)]
        return _Tried(plan, groups, level_db, tuple(estimate for estimate, _ in takes), any(left for _, left in takes))

    def candidate(self, tried: _Tried, error_db: float) -> Candidate:
        """A schedule for the verdict."""
        campaign_s = tried.plan.positions * tried.plan.position_s(self._setup)
        error_db = float("inf") if tried.over_range else error_db
        return Candidate(_name(tried), tried.groups, tried.level_db, campaign_s, error_db)

    def _measured(self, plan: Plan, measuring: Measuring) -> tuple[Estimate, bool]:
        """One take, and whether it left the range of an input; repeated while something passing spoils it."""
        records = PositionRecords(plan, self._setup, measuring.plays, self._session.fault)
        for tries in range(1, plan.quality.max_attempts + 1):
            self._number += 1
            attempt, last = Attempt(self._position, self._number, tries), tries == plan.quality.max_attempts
            try:
                recordings = self._recovery.retry_after_reconnect(lambda: records.take(attempt, "trial"), attempt)  # noqa: B023
            except TransientInstrumentError as fault:
                self._session.fault(fault, attempt, retried=not last)
                if last:
                    raise
                self._recovery.renew_if_repeated(fault)
                continue
            try:
                estimate, left = self._estimated(measuring, recordings)
            except ReferenceMissingError as missing:
                if last:
                    raise InputError(f"the trial before the campaign failed: {missing}") from missing
                continue
            if not left or last:
                return estimate, left
        raise AssertionError("the last try returns or raises")

    def _estimated(self, measuring: Measuring, recordings: tuple[Recording, ...]) -> tuple[Estimate, bool]:
        reference_v, response_v = (np.stack([recording.volts[row] for recording in recordings]) for row in range(2))
        estimate = measuring.estimator.estimate(reference_v, response_v, range_v=self._setup.range_v)
        return estimate, any(any(recording.over_range) for recording in recordings) or bool(np.any(estimate.clip_count))


def _name(tried: _Tried) -> str:
    level = f" at {tried.level_db:g} dB" if tried.level_db else ""
    if not tried.groups:
        return f"sequential capture{level}"
    if tried.groups == 1:
        return f"staggered capture{level}"
    slots = tried.plan.staggered.slots if isinstance(tried.plan.staggered, StaggeredSignal) else 1
    return f"staggered capture in {tried.groups} groups of {slots}{level}"


def _decay(plan: Plan, estimate: Estimate) -> Decay | None:
    """How the responses fall, where it can be measured; refused when they ring longer than the taps."""
    try:
        decay = measure_decay(estimate.green, plan.excitation.sample_rate_hz)
    except InputError:
        return None
    decay.require(plan.taps)
    return decay
