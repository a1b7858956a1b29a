"""What plays at each position and how it is estimated, whatever the schedule."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.plan import Plan, lead_samples
from wavefocus.acquisition.setup import RecordMargins, Setup, record_samples
from wavefocus.calibration import Float64Array
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.estimator.estimate import Channels, PositionEstimator, Records
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.drivers.protocols import Recording
from wavefocus.storage.errors import InputError
from wavefocus.storage.point_status import Status
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


def keep_recordings(raw: RawWriter, position: int, recordings: Sequence[Recording], leak_db: float = math.nan) -> None:
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
