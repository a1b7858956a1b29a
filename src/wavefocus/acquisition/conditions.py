"""Watched conditions of a campaign: their bands, left on one threshold and re-entered on another, and their values."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from wavefocus.acquisition.plays import Play
from wavefocus.acquisition.setup import Setup
from wavefocus.acquisition.watch import Watch
from wavefocus.calibration.excitation import Excitation
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Recording

REFERENCE, NOISE = "reference", "noise"
"""What every record shows by itself; other conditions have sensors."""

# What a vibrometer without light puts out is broad; above this many times the sweep's end nothing else is.
ABOVE_BAND = 1.5
NOISE_SAMPLES = 8192


class Conditions:
    """Finds the values of all watched conditions.

    setup: Whose records they are.
    excitation: Rate and band of what is played.
    """

    def __init__(self, watch: Watch, setup: Setup, excitation: Excitation) -> None:
        self.watch = watch
        self._setup = setup
        self._rate_hz = excitation.sample_rate_hz
        self._above_hz = ABOVE_BAND * excitation.stop_hz
        self.silent_sensors: dict[str, InstrumentError] = {}
        """Sensors that did not answer at the last look, and what they said."""

    def values(self, plays: Sequence[Play], recordings: Sequence[Recording]) -> dict[str, float]:
        """Values after these records; a sensor that fails is listed in `silent_sensors`.

        plays, recordings: What was played, and what was recorded of it.
        """
        values: dict[str, float] = {}
        if REFERENCE in self.watch.bands:
            levels = [self._reference_db(play, recording) for play, recording in zip(plays, recordings, strict=True)]
            values[REFERENCE] = self._worst(REFERENCE, levels)
        if NOISE in self.watch.bands and self._above_hz < self._rate_hz / 2:
            # Speckle hides the surface for milliseconds of one record; what lasts is in most of them.
            values[NOISE] = float(np.median([self._noise_v(recording) for recording in recordings]))
        self.silent_sensors.clear()
        for name, sensor in self.watch.sensors.items():
            try:
                values[name] = sensor()
            except InstrumentError as failure:
                self.silent_sensors[name] = failure
        return values

    def left(self, values: Mapping[str, float]) -> str:
        """Which conditions have left their bands, in words; empty where none has."""
        reasons = (self.watch.bands[name].left(value) for name, value in values.items())
        return "; ".join(reason for reason in reasons if reason)

    def are_back(self, values: Mapping[str, float]) -> bool:
        """Whether all measured conditions are back."""
        return all(self.watch.bands[name].is_back(value) for name, value in values.items())

    @property
    def settle_s(self) -> float:
        """The longest settling time of all bands."""
        return max((band.settle_s for band in self.watch.bands.values()), default=0.0)

    def _worst(self, name: str, levels: Sequence[float]) -> float:
        """The value that is farthest outside of its band; the median where all are inside."""
        middle = float(np.median(levels))
        outside = [level for level in levels if self.watch.bands[name].left(level)]
        return max(outside, key=lambda level: abs(level - middle), default=middle)

    def _reference_db(self, play: Play, recording: Recording) -> float:
        """Energy of the reference over that of the loopback's signal, in what counts of the record."""
        signal_v = play.signals_v[self._setup.loopback_channel]
        expected = float(np.sum(np.square(signal_v)))
        if play.used is not None:
            expected *= recording.volts.shape[1] / len(signal_v)
        energy = float(np.sum(np.square(recording.volts[0], dtype=np.float64)))
        # A silent reference still has a level, so that it can be reported.
        return 10.0 * math.log10(max(energy, 1e-12) / max(expected * self._setup.reference_gain**2, 1e-12))

    def _noise_v(self, recording: Recording) -> float:
        """Rms of white noise as strong as what the response holds above the sweep's band."""
        response_v = recording.volts[1, :NOISE_SAMPLES].astype(np.float64)
        window = np.hanning(len(response_v))
        power = np.abs(np.fft.rfft(window * response_v)) ** 2
        above = power[int(np.ceil(self._above_hz * len(response_v) / self._rate_hz)) :]
        return float(np.sqrt(np.mean(above) / np.sum(window**2))) if len(above) else 0.0
