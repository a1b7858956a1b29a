"""Green's functions of the records of a position, and their quality."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.estimator.defect_finder import worst_of
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import Schedule

# A bin this close to the end of the band is in it.
EDGE = 1e-6
FLOOR = 1e-30
# How a figure of several records of one actuator becomes one; the first record's counts elsewhere.
MERGED: dict[str, Callable[[NDArray[Any]], Any]] = {
    "residual_db": np.max,
    "coherence": np.min,
    "peak_v": np.max,
    "noise_v": np.max,
    "clip_count": np.sum,
    "defects": worst_of,
    "snr_db": lambda rows: 10 * np.log10(np.sum(10 ** (0.1 * rows))),
    "reference_db": lambda rows: rows[int(np.argmax(np.abs(rows)))],
}


@dataclass(frozen=True, slots=True)
class Estimate:
    """Green's functions of records or of actuators, and their quality: a row for each.

    All energies are sums over the bins from the sweep's lowest to its highest frequency, of the response weighted as
    the fit weighs it; the fit itself uses all that the sweep excites, a little more.

    green, float32 (records, taps): Causal FIRs on the playback clock, response unit per volt of drive.
    snr_db, float32 (records,): Energy that the fitted FIR explains over the noise's in the same band, after averaging;
        the noise is the unexplained energy, scaled from the freedom that the FIR leaves to all of the band.
    residual_db, float32 (records,): Energy that the fitted FIR leaves unexplained over the response's whole energy; 0
        dB for silence. Sees clipping, dropouts, hum, and a response longer than L taps.
    coherence, float32 (records,): Share of the response's energy, over all repeats, that one linear relation to the
        reference explains; NaN for a single sweep.
    peak_v, float32 (records,): Largest magnitude of the response in DAQ volts.
    noise_v, float32 (records,): Rms in DAQ volts of the white noise on one response recording (0 to half the sample
        rate) that would leave this residual.
    clip_count, int32 (records,): Samples of either channel that are clipped: at 0.999 of its range or beyond, or on a
        flat top below it, which an amplifier or the vibrometer left (see `defect_finder`).
    offset_samples, float64 (records,): DAQ sample at which the first sweep starts.
    clock_ratio, float64 (records,): DAQ rate over playback rate.
    defects, structured (records,): What stands out of the residuals beyond chance, as
        `wavefocus.calibration.estimator.defect_finder.DEFECTS` has it.
    reference_db, float32 (records,): Level in band of the recorded reference over that of the played signal at the
        calibrated `reference_gain`, in dB: 0 where the rig is as it was calibrated.
    """

    green: Float32Array
    snr_db: Float32Array
    residual_db: Float32Array
    coherence: Float32Array
    peak_v: Float32Array
    noise_v: Float32Array
    clip_count: NDArray[np.int32]
    offset_samples: Float64Array
    clock_ratio: Float64Array
    defects: NDArray[np.void]
    reference_db: Float32Array

    @classmethod
    def of_slots(
        cls, green: Float32Array, snr_db: Float32Array, *, defects: NDArray[np.void], **figures: float
    ) -> Estimate:
        """The estimate of one record, whose other figures are the same for all of its slots."""
        kinds = {"clip_count": np.int32, "offset_samples": np.float64, "clock_ratio": np.float64}
        each = {
            name: np.full(len(green), figure, dtype=kinds.get(name, np.float32)) for name, figure in figures.items()
        }
        return cls(green, snr_db, defects=defects, **each)

    @classmethod
    def joined(cls, parts: Sequence[Estimate]) -> Estimate:
        """The rows of several estimates, one after the other."""
        return cls(
            **{column.name: np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(cls)}
        )

    def by_actuator(self, actuator: NDArray[np.integer], gain: NDArray[np.floating]) -> Estimate:
        """A row per actuator, from rows of these actuators, driven with these gains.

        Of several rows of one actuator the Green's functions are averaged by what noise and gain make them worth, and
        the worst of each figure counts.
        """
        order = np.argsort(actuator, kind="stable")
        if np.array_equal(actuator[order], np.arange(order.size)):
            return Estimate(**{column.name: getattr(self, column.name)[order] for column in fields(Estimate)})
        merged: dict[str, list[object]] = {column.name: [] for column in fields(Estimate)}
        for wanted in range(int(actuator.max()) + 1):
            chosen = np.flatnonzero(actuator == wanted)
            worth = np.square(gain[chosen].astype(np.float64) / np.maximum(self.noise_v[chosen], 1e-30))
            merged["green"].append(np.average(self.green[chosen], axis=0, weights=worth))
            for name in merged.keys() - {"green"}:
                rows = getattr(self, name)[chosen]
                merged[name].append(MERGED[name](rows) if name in MERGED else rows[0])
        return Estimate(
            **{name: np.asarray(values, dtype=getattr(self, name).dtype) for name, values in merged.items()}
        )


def mean_estimate(looks: Sequence[Estimate]) -> Estimate:
    """The estimate of a position that was measured several times: see `Estimate.by_actuator`."""
    if len(looks) == 1:
        return looks[0]
    actuator = np.tile(np.arange(looks[0].snr_db.size), len(looks))
    return Estimate.joined(looks).by_actuator(actuator, np.ones(actuator.size))


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


DIRECT = Channels()


@dataclass(frozen=True, slots=True)
class Records:
    """The records of a position.

    sample_rate_hz: Rate in Hz, > 0.
    band_hz: Lowest and highest frequency of the excitation in Hz.
    taps: Length L of the Green's functions.
    schedule: What plays when.
    channels: How the channels see it.
    """

    sample_rate_hz: float
    band_hz: tuple[float, float]
    taps: int
    schedule: Schedule
    channels: Channels = DIRECT

    def require(self, reference_v: Float32Array, response_v: Float32Array) -> None:
        """Refuse recordings that are not those of the schedule."""
        if reference_v.ndim != 2 or reference_v.shape != response_v.shape or len(response_v) != self.schedule.records:
            raise InputError(
                f"reference and response have shapes {reference_v.shape} and {response_v.shape}; "
                f"allowed is ({self.schedule.records}, samples) for both"
            )

    def by_actuator(self, estimates: Sequence[Estimate], records: Sequence[int]) -> Estimate:
        """Rows of slots of records, put in the order of the actuators."""
        actuators, _, gains = zip(*(self.schedule.slots(record) for record in records), strict=True)
        actuator, gain = np.concatenate(actuators), np.concatenate(gains)
        return Estimate.joined(estimates).by_actuator(actuator, gain)


class PositionEstimator(Protocol):
    """Estimates all Green's functions of a position."""

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """Estimate a row per actuator from all records of a position.

        reference_v, response_v, float32 (records, samples): The two DAQ channels in volts, a record per row.
        range_v: Largest input magnitude in volts on (reference, response), each > 0.

        Raises InputError: arrays of different or wrong shapes, or values that are not finite. ReferenceMissingError: a
        reference in which the base signal cannot be found; the message names the record.
        """


def decibel(part: Float64Array | float, whole: Float64Array | float) -> Float32Array:
    """Energy `part` over energy `whole` in dB; 0 dB where both are zero."""
    return np.asarray(10 * np.log10((np.asarray(part) + FLOOR) / (np.asarray(whole) + FLOOR))).astype(np.float32)


def bank_figures(estimate: Estimate | None, actuators: int) -> dict[str, Any]:
    """Figures that a bank keeps of a position, NaN without an estimate; the reference's is the records' median."""
    unknown = np.full(actuators, np.nan, np.float32)
    names = ("snr_db", "residual_db", "coherence", "peak_v")
    figures: dict[str, Any] = {name: unknown if estimate is None else getattr(estimate, name) for name in names}
    return {**figures, "reference_db": float("nan") if estimate is None else float(np.median(estimate.reference_db))}
