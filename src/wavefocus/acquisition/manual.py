"""Measuring by hand: live levels while a person points the laser, and single sweeps."""

import math

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.attempt import channels_of
from wavefocus.acquisition.judgement import judge
from wavefocus.acquisition.leak import BAND_HZ
from wavefocus.acquisition.setup import Setup, record_samples, record_silence, take_record
from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.messages.operate import ChannelLevel, Defect, InputLevels, SweepFigures, SweepTaken, TakeSweep
from wavefocus.config.run import QualityLimits
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.storage.errors import InputError

LISTENS_S = 0.1
_FADE_S = 0.005
DECAY_S, TAPS_S = 0.2, 0.1
# Beyond the sweep's band the harmonics are shown, up to so many times its end.
SHOWN = 3.5
_MAX_BINS = 500
_FLOOR_V = 1e-12


def excitation_of(order: TakeSweep, sample_rate_hz: float) -> PlayedExcitation:
    """The signal of an order whose level is given; raises InputError where no signal can be made for it."""
    band_hz = order.start_hz, order.stop_hz
    return PlayedExcitation(sample_rate_hz, *band_hz, order.duration_s, DECAY_S, order.level_v or 0.0, averages=1)


class ManualMeasurements:
    """Levels of both inputs, and sweeps on one actuator, as often as they are asked for; InstrumentError from any.

    What the estimator computes of a sweep's form is kept for the next sweep of the same form.
    """

    def __init__(self, setup: Setup, sample_rate_hz: float) -> None:
        self._setup, self._rate_hz = setup, sample_rate_hz
        self._number = 0
        self._sound: tuple[int, Float64Array] | None = None
        self._estimator: tuple[PlayedExcitation, SequentialEstimator] | None = None

    def sound(self, actuator: int | None, amplitude_v: float = 0.0) -> None:
        """Choose what plays while levels are measured: an actuator at a peak of so many volts, or nothing."""
        self._sound = None
        if actuator is not None:
            sweep = PlayedExcitation(self._rate_hz, *BAND_HZ, LISTENS_S, 0.0, amplitude_v, averages=1, fade_s=_FADE_S)
            self._sound = actuator, sweep.signal_v()

    def level(self) -> InputLevels:
        """Levels now."""
        self._number += 1
        sound = self._sound
        recording = self._silence(LISTENS_S) if sound is None else self._record(*sound, "listening")
        return _levels(recording, self._setup.range_v)

    def sweep(self, order: TakeSweep) -> SweepTaken:
        """Record silence for as long as a sweep lasts, then the sweep.

        Raises InputError: an order that no signal can be made for. InstrumentError: of the instrument that failed.
        """
        self._number += 1
        rate_hz, excitation = self._rate_hz, excitation_of(order, self._rate_hz)
        signal_v = excitation.signal_v()
        quiet = self._silence(record_samples(self._setup, len(signal_v), rate_hz) / rate_hz)
        record = self._record(order.actuator, signal_v, "sweep")
        highest_hz = min(SHOWN * order.stop_hz, rate_hz / 2)
        frequency_hz, response_db = _density_db(record.volts[1], rate_hz, highest_hz)
        _, noise_db = _density_db(quiet.volts[1], rate_hz, highest_hz)
        figures, trouble = None, ""
        try:
            figures = self._figures(order.actuator, excitation, record)
        except (ReferenceMissingError, InputError) as missing:
            trouble = f"no signal from the loopback, so nothing can be measured of the response ({missing})"
        return SweepTaken(
            actuator=order.actuator,
            level_v=excitation.amplitude_v,
            start_hz=order.start_hz,
            stop_hz=order.stop_hz,
            sample_rate_hz=rate_hz,
            level=_levels(record, self._setup.range_v),
            figures=figures,
            trouble=trouble,
            reference_v=_rounded(record.volts[0], 7),
            response_v=_rounded(record.volts[1], 7),
            frequency_hz=_rounded(frequency_hz, 3),
            response_db=_rounded(response_db, 2),
            noise_db=_rounded(noise_db, 2),
        )

    def _silence(self, seconds: float) -> Recording:
        setup, label = self._setup, RecordLabel(0, 1, self._number, "listening")
        return record_silence(setup.recorder, seconds, self._rate_hz, setup.range_v, label)

    def _record(self, actuator: int, signal_v: Float64Array, purpose: str) -> Recording:
        label = RecordLabel(0, 1, self._number, purpose)
        return take_record(self._setup, self._setup.signals_v(signal_v, actuator), self._rate_hz, label)

    def _figures(self, actuator: int, excitation: PlayedExcitation, record: Recording) -> SweepFigures:
        setup = self._setup
        with one_blas_thread():
            if self._estimator is None or self._estimator[0] != excitation:
                taps = round(TAPS_S * excitation.sample_rate_hz)
                self._estimator = excitation, SequentialEstimator(excitation, taps, channels_of(setup))
            estimate = self._estimator[1].estimate(record.volts[:1], record.volts[1:], range_v=setup.range_v)
        judgement = judge(estimate, any(record.over_range), QualityLimits())
        # The estimator counts records; here there is one, and it is this actuator's.
        named = tuple(
            Defect(defect.name, defect.sentence.replace("actuator 0", f"actuator {actuator}"))
            for defect in judgement.defects
        )
        return SweepFigures(
            snr_db=float(estimate.snr_db[0]),
            residual_db=float(estimate.residual_db[0]),
            noise_v=float(estimate.noise_v[0]),
            latency_s=float(estimate.offset_samples[0]) / excitation.sample_rate_hz - setup.pre_roll_s,
            clock_ppm=1e6 * (float(estimate.clock_ratio[0]) - 1),
            defects=named,
        )


def _levels(recording: Recording, range_v: tuple[float, float]) -> InputLevels:
    def level(channel: int) -> ChannelLevel:
        volts = recording.volts[channel].astype(np.float64)
        figures = float(volts.std()), float(np.abs(volts).max(initial=0.0)), float(volts.mean())
        return ChannelLevel(*figures, range_v[channel], bool(recording.over_range[channel]))

    return InputLevels(level(0), level(1))


def _rounded(values: NDArray[np.floating], digits: int) -> tuple[float, ...]:
    """Numbers to the digits that mean something."""
    return tuple(np.round(values.astype(np.float64), digits).tolist())


def _density_db(volts: Float32Array, sample_rate_hz: float, highest_hz: float) -> tuple[Float64Array, Float64Array]:
    """Spectral density in dB re 1 V / sqrt(Hz), its power averaged over neighbouring bins down to what a plot shows."""
    power = np.square(np.abs(np.fft.rfft(volts.astype(np.float64) - float(volts.mean()))))
    power *= 2 / (len(volts) * sample_rate_hz)
    bins = max(1, math.floor(highest_hz * len(volts) / sample_rate_hz))
    step = max(1, -(-bins // _MAX_BINS))
    used = bins // step * step
    mean = power[1 : used + 1].reshape(-1, step).mean(axis=1)
    frequency_hz = (1 + np.arange(len(mean)) * step + (step - 1) / 2) * sample_rate_hz / len(volts)
    return frequency_hz, 10 * np.log10(np.maximum(mean, _FLOOR_V**2))
