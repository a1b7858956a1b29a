"""What plays at each position and how it is estimated, whatever the schedule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from acquisition.measuring.record import Rolls
from acquisition.measuring.setup import Setup
from acquisition.schedule.plan import Plan, lead_samples
from calibration.blas import one_blas_thread
from calibration.estimator.estimate import Channels, PositionEstimator, Records
from calibration.estimator.sequential import SequentialEstimator
from calibration.estimator.staggered import StaggeredEstimator
from drivers.protocols import Float64Array, Recording


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


@dataclass(frozen=True, slots=True)
class Measuring:
    """How every position of a campaign is measured.

    plays: The records of a position, in order.
    estimator: What their recordings become.
    """

    plays: tuple[Play, ...]
    estimator: PositionEstimator


def channels_of(setup: Setup) -> Channels:
    """How the recorder's channels see drive and response."""
    return Channels(setup.reference_gain, setup.response_per_volt, setup.response_delay_s)


def measuring_of(plan: Plan, setup: Setup) -> Measuring:
    """The records that a plan asks for on a rig, and their estimator."""
    return Measuring(_plays(plan, setup), position_estimator(plan, channels_of(setup)))


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


def used_samples(plan: Plan, rolls: Rolls) -> slice | None:
    """Which samples of a record count: of staggered ones, those where all that was silent before has died away."""
    if plan.staggered is None:
        return None
    first = round(rolls.pre_roll_s * plan.excitation.sample_rate_hz) + lead_samples(plan.staggered, rolls)
    return slice(first, first + plan.staggered.used_samples)


def _plays(plan: Plan, setup: Setup) -> tuple[Play, ...]:
    channels, loopback = setup.actuator_channels, setup.loopback_channel
    if plan.staggered is None:
        signal_v = plan.excitation.signal_v()
        return tuple(
            Play(actuator, {channel: signal_v, loopback: signal_v}) for actuator, channel in enumerate(channels)
        )
    used = used_samples(plan, setup)
    return tuple(
        Play(min(sounding), {loopback: base_v} | {channels[one]: volts for one, volts in sounding.items()}, used)
        for base_v, sounding in plan.staggered.played_v(lead_samples(plan.staggered, setup))
    )
