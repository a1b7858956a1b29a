"""One attempt at a position: what plays, its records, what follows from its judgement, and commits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.judgement import Cure, Judgement
from wavefocus.acquisition.plan import Plan, lead_samples
from wavefocus.acquisition.setup import RecordMargins, Setup, record_samples, take_record
from wavefocus.calibration import Float32Array, Float64Array, Int64Array
from wavefocus.calibration.estimator.estimate import Channels, Estimate, PositionEstimator, Records, bank_figures
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.run import QualityLimits
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.storage.bank.ledger import PointRecord, Status
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader, sequential
from wavefocus.storage.raw.writer import RawWriter


@dataclass(frozen=True, slots=True)
class Play:
    """What one record plays, and which part of it counts.

    actuator: The actuator that sounds; the first of them where several do.
    signals_v, mapping from player channel to float64 (samples,): Output volts, all of one length, the loopback channel
        included.
    used: Samples of the record that count; it ends with them. All, if absent.
    """

    actuator: int
    signals_v: Mapping[int, Float64Array]
    used: slice | None = None

    @property
    def samples(self) -> int | None:
        """Samples of the record; None where it lasts as long as the signal asks for."""
        return None if self.used is None else self.used.stop

    def cut(self, recording: Recording) -> Recording:
        """What of a recording counts."""
        return recording if self.used is None else replace(recording, volts=recording.volts[:, self.used].copy())


def channels_of(setup: Setup) -> Channels:
    """How the recorder's channels see drive and response."""
    return Channels(setup.reference_gain, setup.response_per_volt, setup.response_delay_s)


def position_estimator(plan: Plan, channels: Channels) -> PositionEstimator:
    """The estimator for the recordings of a plan.

    plan: What was played.
    channels: How the recorder's channels see it.
    """
    with one_blas_thread():
        if plan.staggered is not None:
            sweep, schedule = plan.excitation, plan.staggered.schedule()
            records = Records(sweep.sample_rate_hz, sweep.band_hz, plan.taps, schedule, channels)
            return StaggeredEstimator(plan.staggered.base_v(), records)
        return SequentialEstimator(plan.excitation, plan.taps, channels)


def used_samples(plan: Plan, margins: RecordMargins) -> slice | None:
    """Which samples of a record count: of staggered ones, those where all that was silent before has died away."""
    if plan.staggered is None:
        return None
    first = round(margins.pre_roll_s * plan.excitation.sample_rate_hz) + lead_samples(plan.staggered, margins)
    return slice(first, first + plan.staggered.used_samples)


def plays_of(plan: Plan, setup: Setup) -> tuple[Play, ...]:
    """The records of each position that a plan asks for on a rig, in order."""
    channels, loopback = setup.actuator_channels, setup.loopback_channel
    if plan.staggered is None:
        signal_v = plan.excitation.signal_v()
        return tuple(
            Play(actuator, {channel: signal_v, loopback: signal_v}) for actuator, channel in enumerate(channels)
        )
    used = used_samples(plan, setup)
    return tuple(
        Play(
            min(sounding),
            {loopback: base_v} | {channels[actuator]: volts for actuator, volts in sounding.items()},
            used,
        )
        for base_v, sounding in plan.staggered.played_v(lead_samples(plan.staggered, setup))
    )


COUNTS = 32768
# Sensitivity and gain are read from instruments; what is the same to this share is the same.
SAME = 1e-6

MEASURED = int(Status.VALID | Status.OVER_RANGE | Status.POOR_SIGNAL)


def raw_header(plan: Plan, setup: Setup, *, rig_json: str, run_json: str, software: str) -> RawHeader:
    """What the raw file of a plan says of itself.

    setup: With what. One count is a 32768th of the range that the campaign begins with: counts of the widest range
        would bury quiet positions in their rounding.
    rig_json, run_json, software: See the bank's header.
    """
    excitation, signal, used = plan.excitation, plan.staggered, used_samples(plan, setup)
    channels = channels_of(setup)
    rate = excitation.sample_rate_hz
    whole = record_samples(setup, excitation.averages * excitation.period_samples, rate)
    return RawHeader(
        sample_rate_hz=rate,
        samples=whole if used is None else used.stop - used.start,
        taps=plan.taps,
        band_hz=excitation.band_hz,
        schedule=sequential(plan.actuators) if signal is None else signal.schedule(),
        position_mm=plan.position_mm,
        actuator_mm=plan.actuator_mm,
        response_per_volt=channels.response_per_volt,
        reference_gain=channels.reference_gain,
        inter_channel_delay_s=channels.inter_channel_delay_s,
        volts_per_count=(setup.range_v[0] / COUNTS, setup.range_v[1] / COUNTS),
        averages=excitation.averages if signal is None else None,
        sweep_law="" if excitation.waveform == "linear" else "other",
        sweep_s=excitation.duration_s if signal is None else signal.period_samples / rate,
        decay_s=excitation.decay_s if signal is None else None,
        rig_json=rig_json,
        run_json=run_json,
        plan_sha256=plan.sha256,
        software=software,
    )


def require_same(raw: RawWriter, wanted: RawHeader) -> None:
    """Refuse to add recordings to a file whose others were scaled otherwise.

    Raises InputError: sensitivity, gain, delay or range is not what the file says.
    """
    for name in ("response_per_volt", "reference_gain", "inter_channel_delay_s", "volts_per_count"):
        then, now = getattr(raw.header, name), getattr(wanted, name)
        if not np.allclose(then, now, rtol=SAME, atol=1e-12):
            raise InputError(
                f"{raw.path} was recorded with {name} {then}, the rig now has {now}; set the instrument as it was, or "
                "start a new bank"
            )


def _keep_recordings(raw: RawWriter, position: int, recordings: Sequence[Recording], leak_db: float = math.nan) -> None:
    """Commit all records of an attempt; of a check position those of the first time.

    Of an attempt that was taken in a wider range, what lies beyond the file's counts is cut to them: an estimate then
    marks the position as over-range, while the bank has it right. `leak_db` is the leak's level at the look before.

    Raises WavefocusError: the disk failed; positions committed earlier are intact.
    """
    kept = []
    for channel, step_v in enumerate(raw.header.volts_per_count):
        volts = np.stack([recording.volts[channel] for recording in recordings[: raw.header.records]])
        kept.append(np.clip(volts, -COUNTS * step_v, (COUNTS - 1) * step_v, dtype=np.float32))
    raw.commit(position, kept[0], kept[1], leak_db)


def without_recordings(status: NDArray[np.uint8], raw: RawWriter) -> list[int]:
    """Positions that a bank holds Green's functions of and the raw file no recordings, as where it was damaged.

    status, uint8 (positions,): The bank's.
    raw: The file of recordings.
    """
    return [int(row) for row in np.flatnonzero((status & MEASURED > 0) & ~raw.recorded)]


# A record is repeated so often before the whole attempt is given up for a passing fault.
RECORD_REPEATS = 2


def record_play(
    setup: Setup,
    play: Play,
    rate_hz: float,
    label: RecordLabel,
    passed: Callable[[InstrumentError], None] = lambda fault: None,
) -> Recording:
    """Take one record, and take it again after a passing fault: an underflow voids a record, not a position."""
    for _ in range(RECORD_REPEATS):
        try:
            return play.cut(take_record(setup, play.signals_v, rate_hz, label, play.samples))
        except TransientInstrumentError as fault:
            passed(fault)
    return play.cut(take_record(setup, play.signals_v, rate_hz, label, play.samples))


@dataclass(frozen=True, slots=True)
class Attempt:
    """A try at a position: `number` counts all tries ever, `of_session` those of this session.

    `moved_mm` is the distance from the position to where the mirror points, `response_range_v` the input range of the
    response; None for the configured one.
    """

    position: int
    number: int
    of_session: int
    moved_mm: tuple[float, float] = (0.0, 0.0)
    response_range_v: float | None = None

    def next(self) -> Attempt:
        """The try after this one."""
        return replace(self, number=self.number + 1, of_session=self.of_session + 1)


@dataclass(frozen=True, slots=True)
class Recorded:
    """The recordings of an attempt, one per actuator; none and a `fault` when an instrument failed."""

    attempt: Attempt
    recordings: tuple[Recording, ...]
    fault: str = ""


@dataclass(frozen=True, slots=True)
class AttemptResult:
    """An attempt estimated and judged.

    `following` is the attempt that comes next, None after the last; `committed` says that the bank holds it.
    `recordings` are what the estimate is of.
    """

    attempt: Attempt
    estimate: Estimate | None
    judgement: Judgement
    following: Attempt | None = None
    committed: bool = False
    recordings: tuple[Recording, ...] = ()

    @property
    def rank(self) -> tuple[bool, bool, bool, float]:
        """Sorts attempts from best to worst: valid ones, then usable ones, then those in range, then by score."""
        over_range = bool(self.judgement.status & Status.OVER_RANGE)
        return (not self.judgement.good, self.estimate is None, over_range, self.judgement.score)

    @property
    def defect_names(self) -> tuple[str, ...]:
        """Names of all that is wrong with it."""
        return tuple(defect.name for defect in self.judgement.defects)

    @property
    def figures(self) -> tuple[float, float, float, float]:
        """For events; NaN without an estimate.

        Median signal-to-noise ratio in dB, residual of the strongest actuator in dB, median distance of the clock ratio
        from 1 in ppm, median start offset of the player within the records in samples.
        """
        if self.estimate is None:
            return (math.nan,) * 4
        strongest = int(np.argmax(self.estimate.snr_db))
        return (
            float(np.median(self.estimate.snr_db)),
            float(self.estimate.residual_db[strongest]),
            float(np.median(self.estimate.clock_ratio) - 1.0) * 1e6,
            float(np.median(self.estimate.offset_samples)),
        )


def commit_attempt(
    bank: BankWriter,
    result: AttemptResult,
    attempts: int,
    raw: RawWriter | None = None,
    *,
    count_anyway: bool = False,
    leak_db: float = math.nan,
) -> AttemptResult:
    """Commit the best attempt at a position, unless the bank already holds a better one.

    bank: Open for writing.
    result: The best attempt of this session.
    attempts: Tries at this position so far, for the bank's ``attempts``.
    raw: Where its recordings are kept, before the bank's row.
    count_anyway: Let the bank count the tries although it keeps what it has, so that the pass counts as over.
    leak_db: Level of the loopback's leak at the look before, in dB re the loopback.

    Returns `result` without its recordings, and saying whether it was committed.
    """
    position = result.attempt.position
    held = int(bank.status[position])
    if held & MEASURED and not result.judgement.good:
        if count_anyway:
            bank.amend(position, attempts=attempts)
        return replace(result, committed=False, recordings=())
    actuators, taps = len(bank.header.actuator_mm), bank.header.taps
    estimate, before = result.estimate, bank.record(position) if held else None
    record = PointRecord(
        status=int(result.judgement.status),
        attempts=attempts,
        **bank_figures(estimate, actuators),
        moved_mm=math.hypot(*result.attempt.moved_mm),
        leak_db=leak_db,
        neighbour_round=before.neighbour_round if before else 0,
        unjudgeable=before.unjudgeable if before else False,
    )
    green = np.zeros((actuators, taps), np.float32) if estimate is None else estimate.green
    if raw is not None and result.recordings:
        _keep_recordings(raw, position, result.recordings, leak_db)
    bank.commit(position, green, record)
    return replace(result, committed=True, recordings=())


# Steps aside, in units of the speckle step, towards the middle of the surface: there is no rim and no mirror limit.
STEPS = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (2, 2))
# After so many positions in a row that a pass could not make valid it is not the positions.
FUTILE_IN_A_ROW = 10


def next_attempt(attempt: Attempt, judgement: Judgement, earlier: Status, setup: Setup, plan: Plan) -> Attempt:
    """The try after one that was not good enough.

    Over-range takes the next larger range. A signal that was lost in several records, or twice at one place, is
    looked for a fraction of a millimetre aside, towards the middle of the surface, for speckle is that fine; all else
    is tried again in place. Where several actuators sound in a record, one loss shows in all of them.

    attempt: The try that was not good enough.
    judgement: Why.
    earlier: Bits of the tries at this position before it, in this session.
    setup: Has the recorder's ranges.
    """
    following = attempt.next()
    if any(defect.cure is Cure.RANGE for defect in judgement.defects):
        used_v = attempt.response_range_v or setup.range_v[1]
        larger_v = [range_v for range_v in setup.response_ranges_v if range_v > used_v * (1 + 1e-9)]
        following = replace(following, response_range_v=min(larger_v, default=used_v))
    dark = plan.staggered is None and any(defect.cure is Cure.MOVE for defect in judgement.defects)
    again = judgement.status & earlier & Status.POOR_SIGNAL and any(
        defect.cure in (Cure.MOVE, Cure.REPEAT) for defect in judgement.defects
    )
    if dark or again:
        following = replace(following, moved_mm=_aside_mm(following, plan))
    return following


def as_measured(
    position: int, attempts: int, moved_mm: float, peak_v: Float32Array, setup: Setup, plan: Plan
) -> Attempt:
    """A try where a bank's row was measured, and with an input range that holds it.

    The bank knows how far aside that was: the way is that of the latest such try. peak_v, (N,): Of the row.
    """
    largest_v = np.nanmax(peak_v, initial=0.0)
    larger_v = [range_v for range_v in setup.response_ranges_v if range_v > largest_v >= setup.range_v[1]]
    attempt = Attempt(position, 1, 1, response_range_v=min(larger_v, default=None))
    for number in range(attempts, 1, -1):
        aside_mm = _aside_mm(replace(attempt, number=number), plan)
        if math.isclose(math.hypot(*aside_mm), moved_mm, abs_tol=1e-3):  # held in whole micrometres
            return replace(attempt, moved_mm=aside_mm)
    return attempt


def _aside_mm(attempt: Attempt, plan: Plan) -> tuple[float, float]:
    """The step aside of a try."""
    x_mm, y_mm = plan.position_mm[attempt.position]
    x, y = (plan.quality.speckle_step_mm * steps for steps in STEPS[(attempt.number - 2) % len(STEPS)])
    return -math.copysign(x, x_mm), -math.copysign(y, y_mm)


def is_final(attempt: Attempt, judgement: Judgement, limits: QualityLimits) -> bool:
    """Whether no further try follows in this round: it is good, the tries are used up, or none can help."""
    hopeless = judgement.cure is Cure.NOTHING and not judgement.status & Status.OVER_RANGE
    return judgement.good or hopeless or attempt.of_session >= limits.max_attempts


def attempts_again(
    order: Int64Array, status: NDArray[np.uint8], attempts: Int64Array, setup: Setup, limits: QualityLimits
) -> list[Attempt]:
    """The tries of the next pass over all that is not valid, if there is one.

    Which positions have had a pass shows only in the numbers of their tries: pass `n` counts from
    ``n * max_attempts + 1``, however few tries came before. So a campaign that is killed in a pass goes on where
    it was. What was over-range starts with the largest range.

    order, int64 (positions,): Bank rows that the session covers, in the order of measurement.
    status, attempts, arrays, shape (positions,): As the bank has them.
    setup: Has the recorder's ranges.
    limits: How many tries a round has, and how many passes there are.
    """
    usable = (status[order] != 0) & (status[order] & (Status.VALID | Status.DISABLED) == 0)
    for number in range(1, limits.remeasure_pass + 1):
        before = number * limits.max_attempts
        due = order[usable & (attempts[order] <= before)]
        if due.size:
            if is_futile(order, status, attempts, before):
                return []
            widest_v = max((setup.range_v[1], *setup.response_ranges_v))
            return [
                Attempt(int(row), before + 1, 1, response_range_v=widest_v if status[row] & Status.OVER_RANGE else None)
                for row in due
            ]
    return []


def is_futile(order: Int64Array, status: NDArray[np.uint8], attempts: Int64Array, before: int) -> bool:
    """Whether the latest positions that a pass measured again have all stayed as they were.

    order, status, attempts: See `attempts_again`.
    before: Tries that a position can have had before the pass.
    """
    latest = order[attempts[order] > before][-FUTILE_IN_A_ROW:]
    return latest.size == FUTILE_IN_A_ROW and not np.any(status[latest] & Status.VALID)
