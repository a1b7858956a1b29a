"""From all records of a position to the Green's functions of all actuators, whatever the schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.defects.figures import worst_of
from calibration.estimator.sequential import Estimate, Estimator
from calibration.estimator.staggered import StaggeredEstimator
from calibration.excitation.sweeps import Sweeps
from storage.errors import InputError
from storage.raw.schedule import Schedule

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Channels:
    """How the two DAQ channels see drive and response.

    reference_gain: DAQ volts on the reference channel per volt of the base signal, > 0.
    response_per_volt: Response unit per DAQ volt of the response channel, not 0.
    inter_channel_delay_s: How much later the response channel is sampled than the reference channel, in seconds.
    """

    reference_gain: float = 1.0
    response_per_volt: float = 1.0
    inter_channel_delay_s: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.reference_gain) and self.reference_gain > 0):
            raise InputError(f"reference_gain is {self.reference_gain:g}; allowed is a finite number above 0")
        if not (np.isfinite(self.response_per_volt) and self.response_per_volt != 0):
            raise InputError(f"response_per_volt is {self.response_per_volt:g}; allowed is a finite number, not 0")
        if not (np.isfinite(self.inter_channel_delay_s) and abs(self.inter_channel_delay_s) < 1):
            raise InputError(f"inter_channel_delay_s is {self.inter_channel_delay_s:g}; allowed is less than 1 s")


class PositionEstimator(Protocol):
    """Estimates all Green's functions of a position."""

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """Estimate from all records of a position.

        reference_v, response_v, float32 (records, samples): The two DAQ channels in volts, a record per row.
        range_v: Largest input magnitude in volts on (reference, response), each > 0.

        Returns Estimate: a row per actuator. Raises InputError: arrays of different or wrong shapes, or values that are
        not finite. ReferenceMissingError: a reference in which the base signal cannot be found; the message names the
        record.
        """


class SequentialEstimator:
    """A record per actuator, sweeps with silence after each.

    sweeps: What each record plays.
    schedule: Which actuator in which record, sequential.
    taps: Length L of the FIRs, 1 to the silence after each sweep.
    channels: How the channels see it.
    comparable: Whether the figures that compare repeats mean something; else they are NaN.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self, sweeps: Sweeps, schedule: Schedule, taps: int, channels: Channels, *, comparable: bool = True
    ) -> None:
        self._schedule, self._comparable = schedule, comparable
        self._estimator = Estimator(
            sweeps,
            taps,
            reference_gain=channels.reference_gain,
            response_per_volt=channels.response_per_volt,
            inter_channel_delay_s=channels.inter_channel_delay_s,
        )

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `PositionEstimator`."""
        require_records(reference_v, response_v, self._schedule.records)
        found = self._estimator.estimate(reference_v, response_v, range_v=range_v)
        if not self._comparable:
            unknown = np.full_like(found.coherence, np.nan)
            found = replace(found, coherence=unknown, repeat_db=unknown.copy())
        slots = [self._schedule.slots(record) for record in range(self._schedule.records)]
        gain = np.array([one[2][0] for one in slots], dtype=np.float32)
        found = replace(found, green=found.green / gain[:, None])
        return by_actuator([found], [np.concatenate([one[0] for one in slots])], [gain])


class JointEstimator:
    """Records in which several actuators play at once: all of them, or a group.

    base_v, float64 (period,): The base signal, as of `calibration.estimator.staggered.StaggeredEstimator`.
    sample_rate_hz: Rate in Hz, > 0.
    band_hz: Its band in Hz.
    schedule: What plays when.
    taps: Length L of the FIRs, at most the distance of two delays.
    channels: How the channels see it.
    expected_ratio: DAQ rate over playback rate that is tried first.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self,
        base_v: Float64Array,
        sample_rate_hz: float,
        band_hz: tuple[float, float],
        schedule: Schedule,
        taps: int,
        channels: Channels,
        *,
        expected_ratio: float = 1.0,
    ) -> None:
        self._schedule = schedule
        alike: dict[bytes, StaggeredEstimator] = {}
        self._records: list[StaggeredEstimator] = []
        for record in range(schedule.records):
            _, delay_s, gain = schedule.slots(record)
            key = delay_s.tobytes() + gain.tobytes()
            if key not in alike:
                alike[key] = StaggeredEstimator(
                    base_v,
                    sample_rate_hz,
                    band_hz,
                    taps,
                    delay_s * sample_rate_hz,
                    gain,
                    reference_gain=channels.reference_gain,
                    response_per_volt=channels.response_per_volt,
                    inter_channel_delay_s=channels.inter_channel_delay_s,
                    expected_ratio=expected_ratio,
                    runs_on=schedule.period_s > 0,
                )
            self._records.append(alike[key])

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `PositionEstimator`."""
        require_records(reference_v, response_v, self._schedule.records)
        slots = [self._schedule.slots(record) for record in range(self._schedule.records)]
        found = [
            one.estimate(reference_v[record], response_v[record], range_v=range_v, name=f"record {record}")
            for record, one in enumerate(self._records)
        ]
        return by_actuator(found, [one[0] for one in slots], [one[2] for one in slots])


def by_actuator(
    estimates: Sequence[Estimate], actuators: Sequence[NDArray[np.integer]], gains: Sequence[NDArray[np.floating]]
) -> Estimate:
    """Put estimates of records in the order of the actuators; one that played more than once is averaged.

    estimates: Rows of slots.
    actuators, gains, sequence of (slots,): Actuator and gain of each row.

    Returns Estimate: a row per actuator. Of several rows the Green's functions are averaged by what noise and gain make
    them worth, and the worst of each figure counts.
    """
    rows = Estimate(
        **{one.name: np.concatenate([getattr(part, one.name) for part in estimates]) for one in fields(Estimate)}
    )
    actuator, gain = np.concatenate(actuators), np.concatenate(gains).astype(np.float64)
    order = np.argsort(actuator, kind="stable")
    if np.array_equal(actuator[order], np.arange(order.size)):
        return Estimate(**{one.name: getattr(rows, one.name)[order] for one in fields(Estimate)})
    worst = {"residual_db": np.max, "coherence": np.min, "peak_v": np.max, "repeat_db": np.max, "noise_v": np.max}
    merged: dict[str, list[object]] = {one.name: [] for one in fields(Estimate)}
    for wanted in range(int(actuator.max()) + 1):
        chosen = np.flatnonzero(actuator == wanted)
        worth = np.square(gain[chosen] / np.maximum(rows.noise_v[chosen], 1e-30))
        merged["green"].append(np.average(rows.green[chosen], axis=0, weights=worth).astype(np.float32))
        merged["snr_db"].append(10 * np.log10(np.sum(10 ** (0.1 * rows.snr_db[chosen]))))
        merged["clip_count"].append(np.sum(rows.clip_count[chosen]))
        merged["defects"].append(worst_of(rows.defects[chosen]))
        for name, choose in worst.items():
            merged[name].append(choose(getattr(rows, name)[chosen]))
        levels_db = rows.reference_db[chosen]
        merged["reference_db"].append(levels_db[int(np.argmax(np.abs(levels_db)))])
        for name in ("offset_samples", "clock_ratio"):
            merged[name].append(getattr(rows, name)[chosen[0]])
    kinds = {one.name: getattr(rows, one.name).dtype for one in fields(Estimate)}
    return Estimate(**{name: np.asarray(values, dtype=kinds[name]) for name, values in merged.items()})


def require_records(reference_v: Float32Array, response_v: Float32Array, records: int) -> None:
    """Refuse recordings that are not those of the schedule."""
    if reference_v.ndim != 2 or reference_v.shape != response_v.shape or reference_v.shape[0] != records:
        raise InputError(
            f"reference and response have shapes {reference_v.shape} and {response_v.shape}; "
            f"allowed is ({records}, samples) for both"
        )
