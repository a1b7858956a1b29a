"""What a record plays: a base signal several times with silence after each, or a periodic one, actuators staggered.

`WAVEFORMS` holds base signals by the values of `sweep.waveform`, of any scale, without fades and silence.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.calibration import Float64Array
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import EMPTY, Schedule, staggered

CLIPPED_AT = 0.8
ROUNDS = 60
"""More hardly lower the peak: it is 1.7 to 2.0 times the rms by then, and 4 with random phases."""


def _linear(time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
    """A linear sweep: its energy is even over the band, and each moment has one frequency."""
    slope = (band_hz[1] - band_hz[0]) / (2 * duration_s)
    return np.asarray(np.sin(2 * np.pi * (band_hz[0] + slope * time_s) * time_s))


def _multisine(time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
    """All frequencies of the band throughout, so that a disturbance costs each of them a little.

    Its phases are random, the same in every run, and then turned until the peak is about twice the rms, by clipping in
    time and keeping the phases only (Van der Ouderaa, Schoukens and Renneboog, IEEE Trans. Instrum. Meas. 37, 1988).
    """
    import scipy.fft  # slow to load, and sweeps do without

    samples = time_s.size
    bins = np.arange(int(np.ceil(band_hz[0] * duration_s)), int(band_hz[1] * duration_s) + 1)
    phase = 2 * np.pi * np.random.default_rng(0).random(bins.size)
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    signal = np.zeros(samples)
    for _ in range(ROUNDS):
        spectrum[bins] = np.exp(1j * phase)
        signal = scipy.fft.irfft(spectrum, samples)
        peak = CLIPPED_AT * np.abs(signal).max()
        phase = np.angle(scipy.fft.rfft(np.clip(signal, -peak, peak))[bins])
    return np.asarray(signal)


WAVEFORMS = {"linear": _linear, "multisine": _multisine}


@dataclass(frozen=True, slots=True)
class PlayedExcitation:
    """A waveform with fades, followed by silence, played `averages` times without a gap.

    A linear sweep spreads its energy evenly over the band, which for white noise gives Green's functions
    3 dB better than a logarithmic one.

    sample_rate_hz: Rate of the bank in Hz, > 0.
    start_hz, stop_hz: Band of the sweep in Hz, 0 < start < stop < half the sample rate.
    duration_s: Length of one sweep in seconds, > 0.
    decay_s: Silence after each sweep in seconds, >= 0; at least as long as the response.
    amplitude_v: Peak of the sweep in volts, > 0.
    averages: Number of sweeps in a record, >= 1.
    fade_s: Length of each half-cosine fade in seconds, 0 to half of `duration_s`.
    waveform: One of `WAVEFORMS`.

    Raises InputError: a value outside the range above.
    """

    sample_rate_hz: float
    start_hz: float
    stop_hz: float
    duration_s: float
    decay_s: float
    amplitude_v: float
    averages: int
    fade_s: float = 0.01
    waveform: str = "linear"

    def __post_init__(self) -> None:
        low, high, half_rate = self.start_hz, self.stop_hz, self.sample_rate_hz / 2
        for name in ("sample_rate_hz", "start_hz", "stop_hz", "duration_s", "amplitude_v"):
            _require(0 < getattr(self, name) < math.inf, self, name, "a finite number above 0")
        _require(0 <= self.decay_s < math.inf, self, "decay_s", "0 or more")
        _require(low < high, self, "start_hz", f"less than stop_hz, {high:g}")
        _require(high < half_rate, self, "stop_hz", f"less than half the sample rate, {half_rate:g}")
        if isinstance(self.averages, bool) or int(self.averages) != self.averages or self.averages < 1:
            raise InputError(f"capture averages is {self.averages!r}; allowed is a whole number of 1 or more")
        longest_s = self.duration_s / 2
        _require(0 <= self.fade_s <= longest_s, self, "fade_s", f"0 to half of duration_s, {longest_s:g}")
        least = f"at least {4 / (high - low):g} for a band of {high - low:g} Hz"
        _require((high - low) * self.duration_s >= 4, self, "duration_s", least)
        if self.waveform not in WAVEFORMS:
            raise InputError(f"sweep waveform is {self.waveform!r}; allowed is one of {', '.join(WAVEFORMS)}")

    @property
    def sweep_samples(self) -> int:
        """Samples of one sweep."""
        return round(self.duration_s * self.sample_rate_hz)

    @property
    def decay_samples(self) -> int:
        """Samples of silence after each sweep."""
        return round(self.decay_s * self.sample_rate_hz)

    @property
    def period_samples(self) -> int:
        """Samples of one sweep and its silence."""
        return self.sweep_samples + self.decay_samples

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency of the sweep in Hz."""
        return (self.start_hz, self.stop_hz)

    def base_v(self) -> Float64Array:
        """One sweep and its silence in volts, shape (period_samples,); peak `amplitude_v`, mean exactly 0."""
        samples = self.sweep_samples
        time_s = np.arange(samples) / self.sample_rate_hz
        envelope = np.ones(samples)
        fade = round(self.fade_s * self.sample_rate_hz)
        if fade:
            ramp = np.sin(np.pi / 2 * (np.arange(fade) + 0.5) / fade) ** 2
            envelope[:fade] = ramp
            envelope[samples - fade :] *= ramp[::-1]
        sweep = envelope * WAVEFORMS[self.waveform](time_s, self.band_hz, self.duration_s)
        # A coil must not hold a direct voltage; the sweep's tiny mean goes where the envelope hides it.
        sweep -= envelope * (sweep.sum() / envelope.sum())
        base = np.zeros(self.period_samples)
        base[:samples] = sweep * (self.amplitude_v / np.abs(sweep).max())
        return base

    def signal_v(self) -> Float64Array:
        """The whole record's drive in volts, shape (averages * period_samples,)."""
        return np.tile(self.base_v(), self.averages)


def _require(fine: bool, sweep: PlayedExcitation, name: str, allowed: str) -> None:
    if not fine:
        raise InputError(f"sweep {name} is {getattr(sweep, name):g}; allowed is {allowed}")


@dataclass(frozen=True, slots=True, eq=False)
class RecordedExcitation:
    """The sweeps of another program's sequential record as its reference channel carried them.

    base, float64 (period,): One sweep and its silence in DAQ volts, on the playback clock.
    sample_rate_hz: Rate in Hz.
    start_hz, stop_hz: Lowest and highest frequency in Hz.
    decay_samples: Samples of silence after each sweep.
    averages: Number of sweeps in a record.
    """

    base: Float64Array
    sample_rate_hz: float
    start_hz: float
    stop_hz: float
    decay_samples: int
    averages: int

    def base_v(self) -> Float64Array:
        """One sweep and its silence in volts, shape (period,)."""
        return self.base


Excitation = PlayedExcitation | RecordedExcitation
"""A base signal and the silence after it, which a record holds several times."""

# A record is longer than its periods by this share, twice what the fastest clock allowed takes.
MARGIN_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class StaggeredSignal:
    """The records of a position in which all actuators, or a group of them, sound at once.

    The base signal is one waveform that fills the band and lasts a whole period; slot k of a record plays it
    k staggers later, round the period. It must have been running for one response before what is
    recorded counts.

    sweep: Rate, band, amplitude and fades; its length, silence and averages do not matter.
    actuators: How many, >= 1.
    taps: Length L of the responses, at most a stagger.
    stagger_samples: Delay from slot to slot, >= 1.
    groups: Records of a position, 1 to `actuators`.
    periods: Periods of a record that count, >= 1.

    Raises InputError: a value outside the range above, or a period too short for its band.
    """

    sweep: PlayedExcitation
    actuators: int
    taps: int
    stagger_samples: int
    groups: int = 1
    periods: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.groups <= self.actuators:
            raise InputError(
                f"capture groups is {self.groups}; allowed is 1 to the number of actuators, {self.actuators}"
            )
        if self.periods < 1:
            raise InputError(f"capture periods is {self.periods}; allowed is 1 or more")
        if not 1 <= self.taps <= self.stagger_samples:
            raise InputError(f"taps is {self.taps}; allowed is 1 to a stagger, {self.stagger_samples} samples")
        self._period_sweep()

    @property
    def slots(self) -> int:
        """Actuators that sound at once, at most."""
        return -(-self.actuators // self.groups)

    @property
    def period_samples(self) -> int:
        """Samples of a period on the playback clock."""
        return self.slots * self.stagger_samples

    @property
    def used_samples(self) -> int:
        """Samples of a record that count: its periods, and a little more whatever the clocks do."""
        return self.periods * self.period_samples + math.ceil(MARGIN_SHARE * self.periods * self.period_samples)

    def _period_sweep(self) -> PlayedExcitation:
        """One sweep as long as the period, without silence."""
        duration_s = self.period_samples / self.sweep.sample_rate_hz
        return replace(self.sweep, duration_s=duration_s, decay_s=0.0, averages=1)

    def base_v(self) -> Float64Array:
        """One period of the base signal in volts, shape (period_samples,)."""
        return self._period_sweep().base_v()

    def schedule(self) -> Schedule:
        """What plays when in the records of a position."""
        return staggered(self.actuators, self.stagger_samples / self.sweep.sample_rate_hz, self.groups)

    def played_v(self, lead_samples: int) -> list[tuple[Float64Array, dict[int, Float64Array]]]:
        """What each record plays, as if it had always been running.

        lead_samples: Samples before those that count: the player's latency and the time in which responses build up.

        Returns list of (float64 array, dict from actuator to float64 array), each of shape (lead + used,): the base
        signal for the loopback, and each actuator's signal, in volts.
        """
        base, length = self.base_v(), lead_samples + self.used_samples
        slots_v = [np.resize(np.roll(base, slot * self.stagger_samples), length) for slot in range(self.slots)]
        return [
            (slots_v[0], {int(actuator): slots_v[slot] for slot, actuator in enumerate(row) if actuator != EMPTY})
            for row in self.schedule().actuator
        ]
