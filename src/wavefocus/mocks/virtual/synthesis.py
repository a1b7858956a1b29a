"""Voltages at the recorder's inputs, exact in time and clock, from player volts through chain and plate.

Signals that were played are kept once, with their spectra.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil

import numpy as np
import scipy
from numpy.typing import NDArray

from wavefocus.drivers.protocols import Float32Array, Float64Array
from wavefocus.mocks.plates import MAX_RINGING_S, REFERENCE_C, Complex64Array, Complex128Array, Plate, impulse_length
from wavefocus.mocks.plates.making import make_plate
from wavefocus.mocks.virtual.settings import VirtualSettings

_LEFT_OUT = 1e-12  # share of a signal's energy above the bins that are kept: -120 dB
_PHASE_BLOCK = 256


class PlayedSignal:
    """One signal as the player's 16-bit converter puts it out.

    full_scale_v: Full scale of the converter in volts.

    peak_v: Its largest magnitude; NaN if it is not all finite.
    """

    def __init__(self, volts: Float64Array, full_scale_v: float) -> None:
        self.volts = volts
        self.peak_v = float(np.abs(volts).max()) if volts.size else 0.0
        self._step_v = full_scale_v / 32768
        self._spectra = lru_cache(3)(self._transform)

    def spectrum(self, length: int, scale: float, samples: int) -> Complex64Array:
        """Spectrum of the first samples, on the clock of the recorder.

        The output is band-limited, so its spectrum on another clock is its Fourier transform at scaled
        frequencies: exact, no interpolation.

        length: Length N of the recorder's transform; bin m lies at m / N cycles per recorder sample.
        scale: Recorder samples per player sample.
        samples: How many samples were played.

        Returns complex64 (bins,): up to where it has energy, at most half the player's or half the recorder's rate.
        """
        return self._spectra(length, scale, samples)

    def delayed(self, length: int, scale: float, samples: int, delay: float, wanted: int) -> Float32Array:
        """The waveform on the clock of the recorder, some recorder samples late, band-limited.

        length, scale, samples: See `spectrum`.
        delay: Recorder samples, any number; what leaves at one end of the transform comes in at the other.
        wanted: How many of its samples, 0 to `length`.

        Returns float32 (wanted,).
        """
        spectrum = self.spectrum(length, scale, samples)
        turned = spectrum * _delay_factor(delay, spectrum.size, length)
        return np.asarray(scipy.fft.irfft(turned, length)[:wanted], dtype=np.float32)

    def _transform(self, length: int, scale: float, samples: int) -> Complex64Array:
        bins = min(length // 2, int(length / (2 * scale))) + 1
        counts = np.clip(np.rint(self.volts[:samples] / self._step_v), -32768, 32767)
        if counts.size == 0:
            return np.zeros(bins, dtype=np.complex64)
        spectrum = _fourier_sum(counts, 2 * np.pi * scale / length, 0, bins)
        energy_above = np.cumsum(np.abs(spectrum[::-1]) ** 2)[::-1]
        kept = int(np.count_nonzero(energy_above > _LEFT_OUT * energy_above[0]))
        return np.asarray(scale * self._step_v * spectrum[:kept], dtype=np.complex64)


class SignalStore:
    """Recognises signals by their content, so that a signal played again costs one comparison.

    full_scale_v: Full scale of the player in volts.
    size: How many signals to keep.
    """

    def __init__(self, full_scale_v: float, size: int = 64) -> None:
        self._full_scale_v = full_scale_v
        self._size = size
        self._held: OrderedDict[tuple[int, bytes], PlayedSignal] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, volts: Float64Array) -> PlayedSignal:
        """The signal of this content; new ones are copied."""
        key = (volts.size, volts[:: max(1, volts.size // 64)].tobytes())
        with self._lock:
            held = self._held.get(key)
            if held is None or not np.array_equal(held.volts, volts):
                held = PlayedSignal(volts.copy(), self._full_scale_v)
                self._held[key] = held
                if len(self._held) > self._size:
                    self._held.popitem(last=False)
            self._held.move_to_end(key)
            return held


def _fourier_sum(signal: Float64Array, turn: float, first: int, bins: int) -> NDArray[np.complex128]:
    """Fourier sum of a signal at evenly spaced frequencies, by Bluestein's chirp transform.

    ``sum over n of signal[n] * exp(-j * n * turn * (first + m))`` for m = 0 ... bins - 1.

    turn: Spacing of the frequencies in radians per sample.
    first, bins: The first frequency is ``first * turn``; how many there are.
    """
    index = np.arange(signal.size, dtype=np.float64)
    bin_index = np.arange(bins, dtype=np.float64)
    between = np.arange(1 - signal.size, bins, dtype=np.float64)
    length = scipy.fft.next_fast_len(between.size)
    down = signal * np.exp(-1j * turn * index * (first + 0.5 * index))
    up = np.exp(0.5j * turn * between**2)
    product = scipy.fft.ifft(scipy.fft.fft(down, length) * scipy.fft.fft(up, length))[signal.size - 1 : between.size]
    return np.asarray(product * np.exp(-0.5j * turn * bin_index**2), dtype=np.complex128)


def _delay_factor(samples: float, bins: int, length: int) -> Complex64Array:
    """The factor that delays a spectrum of a transform of some length, from two short float64 exponentials."""
    radians_per_bin = -2 * np.pi * samples / length
    coarse = np.exp(1j * radians_per_bin * (_PHASE_BLOCK * np.arange(-(-bins // _PHASE_BLOCK))))
    fine = np.exp(1j * radians_per_bin * np.arange(_PHASE_BLOCK))
    return np.outer(coarse.astype(np.complex64), fine.astype(np.complex64)).ravel()[:bins]


_COIL_OHM = 14.0  # the paper, section IV.A
# Poles of the Bessel filter of order 4 with -3 dB at 1 rad/s, each with its conjugate (`scipy.signal.bessel` with
# norm="mag", whose import would cost every command half a second).
_VIBROMETER_POLES = (-0.995208764350272 + 1.257105739454664j, -1.3700678305514422 + 0.41024971749375155j)


def chain_response(frequency_hz: Float64Array) -> Complex128Array:
    """Amplifier, coil and vibrometer as one transfer function, 1 in the middle of the band.

    frequency_hz, float64 array: Frequencies in Hz, >= 0.
    """
    frequency = np.asarray(frequency_hz, dtype=np.float64)
    # The paper, section IV.A: amplified voltage signals from 20 Hz.
    slow = 1j * frequency / 20.0
    # Butterworth of two orders rather than one: the plate's slow diffusion would leave a long tail at the lowest
    # frequencies.
    amplifier = slow**2 / (slow**2 + np.sqrt(2) * slow + 1)
    # The paper, section IV.A: a coil of 5 mH.
    coil = _COIL_OHM / (_COIL_OHM + 2j * np.pi * frequency * 5e-3)
    # The decoder's low-pass. With coil and magnet it leaves -85 dB at 5 kHz, so that 10 kHz is free of aliasing and the
    # FIR of pre-ringing; a Bessel filter, for it does not ring itself.
    fast = 1j * frequency / 1200.0
    response = np.asarray(amplifier * coil, dtype=np.complex128)
    for pole in _VIBROMETER_POLES:
        response *= abs(pole) ** 2 / ((fast - pole) * (fast - pole.conjugate()))
    return response


def _actuator_gains(actuators: int, spread_db: float, seed: int) -> Float64Array:
    """Gain of each actuator, evenly spread in decibels; the polarity is the same for all.

    actuators: Number of actuators.
    spread_db: Largest deviation from 0 dB, >= 0.
    seed: Seed of the rig.
    """
    level_db = np.random.default_rng([seed, 0x6A1]).uniform(-spread_db, spread_db, actuators)
    return np.asarray(10 ** (level_db / 20), dtype=np.float64)


def output_errors(
    outputs: int, latency_spread_s: float, gain_spread_db: float, seed: int
) -> tuple[Float64Array, Float64Array]:
    """What calibration has to find of a player's outputs: latency and gain of each, evenly spread.

    outputs: Number of outputs.
    latency_spread_s: Largest deviation of an output's latency in s, >= 0.
    gain_spread_db: Largest deviation of an output's gain in dB, >= 0.
    seed: Seed of the rig.

    Returns tuple of float64 (outputs,): latencies in s and gains.
    """
    chance = np.random.default_rng([seed, 0x0F7])
    latency_s = chance.uniform(-latency_spread_s, latency_spread_s, outputs)
    gain_db = chance.uniform(-gain_spread_db, gain_spread_db, outputs)
    return np.asarray(latency_s), np.asarray(10 ** (gain_db / 20), dtype=np.float64)


TAIL_S = 0.3  # what a response may ring on before a transform may wrap
_VELOCITY_SCALE = 0.0064
"""Strength of actuators and amplifier: the strongest response of the default grid to a sweep of 1 V peaks at 6 V."""
_TABLE_BINS = 1000  # tables end at a multiple of this, so that few are made


@dataclass(slots=True)
class VirtualPlay:
    """A play on its way: what was asked for, and when it reaches the outputs."""

    requested_ns: int
    sample_rate_hz: float
    signals: dict[int, PlayedSignal]
    samples: int
    latency_s: float | None = None

    @property
    def duration_s(self) -> float:
        return self.samples / self.sample_rate_hz


@dataclass(frozen=True, slots=True)
class Spot:
    """Where the laser was during some samples of a record; nowhere, if it moved or missed the surface."""

    first: int
    stop: int
    place_mm: tuple[float, float] | None


class Synthesis:
    """Plate and signal chain of one virtual rig."""

    def __init__(self, settings: VirtualSettings) -> None:
        self._settings = settings
        actuator_mm = np.asarray(settings.actuator_mm, dtype=np.float64).reshape(-1, 2)
        gains = _actuator_gains(settings.actuators, settings.gain_spread_db, settings.seed)
        if settings.actuator_strength is not None:
            gains = gains * np.asarray(settings.actuator_strength, dtype=np.float64)
        self._velocity_per_volt = _VELOCITY_SCALE * gains
        self._output_gain = settings.output_gain or (1.0,) * settings.player_channels
        self._output_late_s = settings.output_latency_s or (0.0,) * settings.player_channels
        self._uneven = settings.output_gain is not None or settings.output_latency_s is not None
        self._keys = dict(settings.plate_keys)
        self._actuator_mm = actuator_mm
        self._plate_at = lru_cache(4)(self._make_plate)
        self._plate = self._plate_at(self._warmer_k(0))
        self._transfer = lru_cache(4)(self._make_transfer)
        # All records of a position find the mirror as it was.
        self._place_mm = lru_cache(64)(self._find_place_mm)

    def voltages(
        self,
        samples: int,
        sample_rate_hz: float,
        start_ns: int,
        plays: Sequence[VirtualPlay],
        spots: Sequence[Spot],
        patched: tuple[int, ...] | None = None,
    ) -> tuple[Float32Array, Float32Array]:
        """Noise-free reference and response of one record, in volts.

        A player sample k arrives at recorder sample offset + k * scale, so the response is
        D(f) exp(-j 2 pi f offset) G(f) on the recorder's frequencies: D the drive's spectrum on the
        recorder's clock, G the transfer function at true frequencies.

        samples: Samples per channel.
        sample_rate_hz: Nominal rate of the recorder in Hz.
        start_ns: Virtual time of the first sample.
        plays: What sounds during the record, latencies known.
        spots: Where the laser was; samples of no spot are zero.
        patched: Outputs of the player that are plugged into the response input in place of the vibrometer.

        Returns tuple of float32 (samples,): reference and response.
        """
        rate_hz = sample_rate_hz * self._settings.clock_ratio
        warmer_k = self._warmer_k(start_ns)
        length = self._length(samples, rate_hz, start_ns, plays)
        reference_v = np.zeros(samples, dtype=np.float32)
        response_v = np.zeros(samples, dtype=np.float32)
        lit = [(spot, spot.place_mm) for spot in spots if spot.place_mm is not None and patched is None]
        responses: dict[tuple[float, float], Complex64Array] = {place: np.zeros(0, np.complex64) for _, place in lit}
        for play in plays:
            offset = ((play.requested_ns - start_ns) * 1e-9 + (play.latency_s or 0.0)) * rate_hz
            scale = rate_hz / play.sample_rate_hz
            looped = self._settings.channel_of_loopback
            if looped in play.signals:
                reference_v += self._output(play, looped, length, scale, offset, rate_hz, samples)
            for channel in patched or ():
                if channel in play.signals:
                    earlier = offset - self._settings.inter_channel_delay_s * rate_hz
                    response_v += self._output(play, channel, length, scale, earlier, rate_hz, samples)
            driven = {
                actuator: play.signals[channel]
                for actuator, channel in enumerate(self._settings.channel_of_actuator)
                if channel in play.signals
            }
            if not driven or not responses:
                continue
            spectra = {actuator: signal.spectrum(length, scale, play.samples) for actuator, signal in driven.items()}
            bins = max(spectrum.size for spectrum in spectra.values())
            delay = _delay_factor(offset, bins, length)
            table_bins = min(length // 2 + 1, _TABLE_BINS * ceil(bins / _TABLE_BINS))
            for place_mm, before in responses.items():
                transfer = self._transfer(place_mm, rate_hz / length, table_bins, warmer_k)
                total = np.zeros(max(bins, before.size), dtype=np.complex64)
                for actuator, spectrum in spectra.items():
                    size = spectrum.size
                    response = spectrum * transfer[actuator, :size]
                    if self._uneven:
                        response *= self._output_factor(actuator, size, rate_hz / length)
                    total[:size] += response
                total[:bins] *= delay
                total[: before.size] += before
                responses[place_mm] = total
        response_of = {place: scipy.fft.irfft(spectrum, length) for place, spectrum in responses.items()}
        for spot, place_mm in lit:
            response_v[spot.first : spot.stop] = response_of[place_mm][spot.first : spot.stop]
        return reference_v, response_v

    def add_crosstalk(
        self, response_v: Float32Array, sample_rate_hz: float, start_ns: int, plays: Sequence[VirtualPlay]
    ) -> None:
        """Add volts of outputs that leak into the response input to a response, float32 (samples,).

        The leak is electrical: it is there whatever the laser meets. Arguments: see `voltages`.
        """
        settings = self._settings
        leaks = [(settings.channel_of_loopback, settings.crosstalk, settings.crosstalk_delay_s)]
        leaks += [(channel, share, 0.0) for channel, share in settings.pickup]
        if not any(share for _, share, _ in leaks):
            return
        samples, rate_hz = response_v.size, sample_rate_hz * settings.clock_ratio
        length = self._length(samples, rate_hz, start_ns, plays)
        leaked_v = np.zeros(samples, dtype=np.float32)
        for play in plays:
            offset = ((play.requested_ns - start_ns) * 1e-9 + (play.latency_s or 0.0)) * rate_hz
            scale = rate_hz / play.sample_rate_hz
            for channel, share, delay_s in leaks:
                if share and channel in play.signals:
                    late = (delay_s - settings.inter_channel_delay_s) * rate_hz
                    volts = self._output(play, channel, length, scale, offset + late, rate_hz, samples)
                    leaked_v += volts * np.float32(share)
        response_v += leaked_v

    def spots(
        self, aims: Sequence[tuple[int, tuple[float, float] | None]], start_ns: int, samples: int, rate_hz: float
    ) -> list[Spot]:
        """Where the laser was during the samples of a record that began at `start_ns`.

        aims: See `wavefocus.mocks.virtual.mirror.MirrorMotion.aims`.
        rate_hz: True rate of the recorder.
        """
        firsts = [min(samples, round((instant - start_ns) * 1e-9 * rate_hz)) for instant, _ in aims]
        ends = [*firsts[1:], samples]
        return [Spot(first, stop, self.place_mm(aim)) for first, stop, (_, aim) in zip(firsts, ends, aims, strict=True)]

    def place_mm(self, aim_mrad: tuple[float, float] | None) -> tuple[float, float] | None:
        """Where the laser meets the surface from a mirror that stands so; None where it moves, or misses it."""
        return None if aim_mrad is None else self._place_mm(aim_mrad)

    def _find_place_mm(self, aim_mrad: tuple[float, float]) -> tuple[float, float] | None:
        spot_mm = self._settings.mirror.spot_mm(*aim_mrad)
        return spot_mm if bool(self._settings.outline.contains(spot_mm)) else None

    def green(self, place_mm: tuple[float, float], taps: int, sample_rate_hz: float) -> Float64Array:
        """FIRs from drive to surface velocity, see `wavefocus.mocks.virtual.rig.VirtualRig.truth`."""
        length = impulse_length(taps, sample_rate_hz, self._plate.ringing_s)
        response = self._plate.response(place_mm, sample_rate_hz / length, length // 2 + 1, single=False)
        spectrum = response * self._velocity_per_volt[:, None]
        return np.asarray(scipy.fft.irfft(spectrum, length, axis=1)[:, :taps], dtype=np.float64)

    def green_spectra(
        self, position_mm: Float64Array, taps: int, sample_rate_hz: float, length: int, bins: slice
    ) -> Complex128Array:
        """Some bins of the transforms of `green` at many positions: complex128 (positions, actuators, bins)."""
        spectra = self._plate.fir_spectra(position_mm, taps, sample_rate_hz, length, bins)
        return np.asarray(spectra * self._velocity_per_volt[:, None])

    def _output(
        self, play: VirtualPlay, channel: int, length: int, scale: float, offset: float, rate_hz: float, samples: int
    ) -> Float32Array:
        """The first volts at one output of the player, on the recorder's clock: float32 (samples,)."""
        late = self._output_late_s[channel] * rate_hz
        wave = play.signals[channel].delayed(length, scale, play.samples, offset + late, samples)
        return wave if not self._uneven else wave * np.float32(self._output_gain[channel])

    def _output_factor(self, actuator: int, bins: int, step_hz: float) -> Complex64Array:
        """Gain and delay of an actuator's output, as a factor on its spectrum."""
        channel = self._settings.channel_of_actuator[actuator]
        return _delay_factor(self._output_late_s[channel] * step_hz, bins, 1) * np.float32(self._output_gain[channel])

    def _warmer_k(self, instant_ns: int) -> float:
        """Kelvin by which a plate that follows the room is warmer than its keys say, in steps of 0.05."""
        if not ("speed_per_k" in self._keys or "loss_per_k" in self._keys):
            return 0.0
        seconds, celsius = np.array(self._settings.room_c).T
        return float(round(20 * (np.interp(1e-9 * instant_ns, seconds, celsius) - REFERENCE_C)) / 20)

    def _make_plate(self, warmer_k: float) -> Plate:
        settings = self._settings
        return make_plate(settings.plate, self._actuator_mm, settings.outline, chain_response, self._keys, warmer_k)

    def _make_transfer(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, warmer_k: float
    ) -> Complex64Array:
        """Response volts per drive volt of every actuator, as the recorder samples them."""
        gains = self._velocity_per_volt / self._settings.sensitivity_m_s_per_v
        response = self._plate_at(warmer_k).response(place_mm, step_hz, bins, single=True)
        response *= gains.astype(np.float32)[:, None]
        # The response is sampled later, so the same wave appears earlier in it; the vibrometer makes it late.
        earlier = (self._settings.vibrometer_latency_s - self._settings.inter_channel_delay_s) * step_hz
        response *= _delay_factor(earlier, bins, 1)
        return response.astype(np.complex64, copy=False)

    def _length(self, samples: int, rate_hz: float, start_ns: int, plays: Sequence[VirtualPlay]) -> int:
        """A transform long enough that neither end of anything wraps; the same for every latency."""
        first, last = 0.0, float(samples)
        tail_s = max(TAIL_S, min(self._plate.ringing_s, MAX_RINGING_S))
        for play in plays:
            requested_s = (play.requested_ns - start_ns) * 1e-9
            first = min(first, requested_s * rate_hz)
            ends_s = requested_s + self._settings.latency_s[1] + play.duration_s + tail_s
            last = max(last, ends_s * rate_hz)
        # Rounded up so that records of nearly one length share their tables.
        return int(scipy.fft.next_fast_len(2000 * ceil((last - first + 100) / 2000), real=True))
