"""One sweep on one actuator: response and reference, and both in silence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from acquisition.manual.level import level_of, listen
from acquisition.measuring.plays import channels_of
from acquisition.measuring.record import record_samples, take_record
from acquisition.measuring.setup import Setup
from acquisition.quality.judgement import judge
from acquisition.quality.limits import QualityLimits
from calibration.blas import one_blas_thread
from calibration.clock.timing import ReferenceMissingError
from calibration.estimator.sequential import SequentialEstimator
from calibration.excitation.sweeps import Excitation
from config.messages.operate import Defect, InputLevels, SweepFigures
from drivers.protocols import Float32Array, Float64Array, Recording, Take
from storage.errors import InputError

DECAY_S, TAPS_S = 0.2, 0.1
# Beyond the sweep's band the harmonics are looked at, up to so many times its end.
SHOWN = 3.5
_MOST_BINS = 500
_FLOOR_V = 1e-12


@dataclass(frozen=True, slots=True)
class SweepOrder:
    """Which sweep.

    actuator: From 0.
    amplitude_v: Peak, > 0.
    start_hz, stop_hz: Band.
    duration_s: Length, > 0.
    """

    actuator: int
    amplitude_v: float
    start_hz: float
    stop_hz: float
    duration_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SweepResult:
    """A recorded sweep.

    reference_v, response_v, float32 (samples,): Both inputs in V.
    sample_rate_hz: Of the record.
    level: Of the record.
    frequency_hz, response_db, noise_db, float64 (bins,): Spectral densities of the response with the sweep and in
        silence, in dB re 1 V / sqrt(Hz).
    figures: None without a signal from the loopback; `trouble` then says why.
    trouble: Why there are no figures; else empty.
    """

    reference_v: Float32Array
    response_v: Float32Array
    sample_rate_hz: float
    level: InputLevels
    frequency_hz: Float64Array
    response_db: Float64Array
    noise_db: Float64Array
    figures: SweepFigures | None
    trouble: str


def excitation_of(order: SweepOrder, sample_rate_hz: float) -> Excitation:
    """The signal of an order.

    Raises InputError: an order that no signal can be made for.
    """
    return Excitation(
        sample_rate_hz=sample_rate_hz,
        start_hz=order.start_hz,
        stop_hz=order.stop_hz,
        duration_s=order.duration_s,
        decay_s=DECAY_S,
        amplitude_v=order.amplitude_v,
        averages=1,
    )


class SingleSweeps:
    """Takes sweeps; what the estimator computes of a sweep's form is kept for the next one of the same form."""

    def __init__(self, setup: Setup, sample_rate_hz: float) -> None:
        self._setup = setup
        self._rate_hz = sample_rate_hz
        self._number = 0
        self._estimator: tuple[Excitation, SequentialEstimator] | None = None

    def take(self, order: SweepOrder) -> SweepResult:
        """Listen to silence for as long, play the sweep once, and look at what came back.

        order: Which sweep.

        Raises InputError: an order that no signal can be made for. InstrumentError: of the instrument that failed.
        """
        self._number += 1
        setup, rate_hz = self._setup, self._rate_hz
        excitation = excitation_of(order, rate_hz)
        signal_v = excitation.signal_v()
        seconds = record_samples(setup, len(signal_v), rate_hz) / rate_hz
        quiet = listen(setup, seconds, rate_hz, self._number)
        signals_v = {setup.loopback_channel: signal_v, setup.actuator_channels[order.actuator]: signal_v}
        record = take_record(setup, signals_v, rate_hz, Take(0, 1, self._number, "sweep"))
        highest_hz = min(SHOWN * order.stop_hz, rate_hz / 2)
        frequency_hz, response_db = _density_db(record.volts[1], rate_hz, highest_hz)
        _, noise_db = _density_db(quiet.volts[1], rate_hz, highest_hz)
        figures, trouble = None, ""
        try:
            figures = self._figures(order.actuator, excitation, record)
        except (ReferenceMissingError, InputError) as missing:
            trouble = f"no signal from the loopback, so nothing can be measured of the response ({missing})"
        return SweepResult(
            reference_v=record.volts[0],
            response_v=record.volts[1],
            sample_rate_hz=rate_hz,
            level=level_of(record, setup.range_v),
            frequency_hz=frequency_hz,
            response_db=response_db,
            noise_db=noise_db,
            figures=figures,
            trouble=trouble,
        )

    def _figures(self, actuator: int, excitation: Excitation, record: Recording) -> SweepFigures:
        with one_blas_thread():
            estimate = self._estimator_of(excitation).estimate(
                record.volts[:1], record.volts[1:], range_v=self._setup.range_v
            )
        judgement = judge(estimate, any(record.over_range), QualityLimits())
        # The estimator counts records; here there is one, and it is this actuator's.
        named = tuple(
            Defect(one.name, one.sentence.replace("actuator 0", f"actuator {actuator}")) for one in judgement.defects
        )
        return SweepFigures(
            snr_db=float(estimate.snr_db[0]),
            residual_db=float(estimate.residual_db[0]),
            noise_v=float(estimate.noise_v[0]),
            latency_s=float(estimate.offset_samples[0]) / excitation.sample_rate_hz - self._setup.pre_roll_s,
            clock_ppm=1e6 * (float(estimate.clock_ratio[0]) - 1),
            defects=named,
        )

    def _estimator_of(self, excitation: Excitation) -> SequentialEstimator:
        if self._estimator is None or self._estimator[0] != excitation:
            taps = round(TAPS_S * excitation.sample_rate_hz)
            self._estimator = excitation, SequentialEstimator(excitation, taps, channels_of(self._setup))
        return self._estimator[1]


def _density_db(volts: Float32Array, sample_rate_hz: float, highest_hz: float) -> tuple[Float64Array, Float64Array]:
    """Spectral density, its power averaged over neighbouring bins down to what a plot shows."""
    power = np.square(np.abs(np.fft.rfft(volts.astype(np.float64) - float(volts.mean()))))
    power *= 2 / (len(volts) * sample_rate_hz)
    bins = max(1, math.floor(highest_hz * len(volts) / sample_rate_hz))
    step = max(1, -(-bins // _MOST_BINS))
    used = bins // step * step
    mean = power[1 : used + 1].reshape(-1, step).mean(axis=1)
    frequency_hz = (1 + np.arange(len(mean)) * step + (step - 1) / 2) * sample_rate_hz / len(volts)
    return frequency_hz, 10 * np.log10(np.maximum(mean, _FLOOR_V**2))
