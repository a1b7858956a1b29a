"""From one record in which several actuators play at once, delayed, to their Green's functions."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import require_coverage, ring_signal, ring_spectrum
from calibration.clock.periodic_clock import RingClock, RingFit
from calibration.clock.resampling import Thinned, Thinning
from calibration.clock.timing import ReferenceMissingError
from calibration.defects.clipping import count_clipped, find_peaks
from calibration.defects.defect_finder import LEAKS
from calibration.defects.figures import not_looked_at
from calibration.estimator.multichannel_fir_fit import JointFit
from calibration.estimator.sequential import EDGE, FLOOR, MAX_PPM, Estimate, decibel
from storage.errors import InputError

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# Bins whose nominal energy is below this share of the median in band carry noise only.
LEAST_POWER = 1e-4
# Reference energy in band that the base signal leaves unexplained.
REFERENCE_LIMIT = 10**-1.5
# The way from player to reference input rings for less than the inverse of this, so its factor is smooth.
SMOOTH_HZ = 10.0
# The residual is looked at in moments of this length; chance makes the loudest of thousands six times the median.
BURST_S = 0.005
BURST_OVER_MEDIAN = 12.0
# Chance makes the loudest of 1e12 bins 40 times the median; twice that is a tone.
LINE_OVER_MEDIAN = 80.0
# Repeats can be compared from so many periods on.
LEAST_PERIODS = 1.9


class StaggeredEstimator:
    """Joint least squares for the causal FIRs of all slots of a record, on the ring of the playback clock.

    The record holds a periodic base signal that is already running when it starts (or, with `runs_on` False, one
    that begins and ends in it). Offset and clock ratio
    come from the reference; the spectra of both channels are then taken at the frequencies of the ring on the
    playback clock, exactly, whatever the record's length. The recorded reference is cleaned of its
    noise: it is the base signal times a smooth factor. Safe to call from several threads.

    base_v, float64 (period,): One period of the base signal in volts, on the playback clock.
    sample_rate_hz: Rate in Hz, > 0.
    band_hz: Lowest and highest frequency of the base signal in Hz.
    taps: Length L of the FIRs.
    delay_samples, float64 (slots,): How much later each slot plays the base signal, in playback samples, from 0 to the
        period; L or more apart on the ring.
    gain, float64 (slots,): Drive volts of each slot per volt of the base signal, not 0.
    reference_gain, response_per_volt, inter_channel_delay_s: As of `calibration.estimator.sequential.Estimator`.
    expected_ratio: DAQ rate over playback rate that is tried first; it saves time and changes nothing else.
    ridge: Penalty on the FIRs' energy relative to the base signal's median power in band, > 0.
    runs_on: Whether the base signal repeats and was already running when the record started. Else `base_v` is all of
        it, with enough silence at its end for record, delays and responses, and outside of the record there is silence.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self,
        base_v: Float64Array,
        sample_rate_hz: float,
        band_hz: tuple[float, float],
        taps: int,
        delay_samples: Float64Array,
        gain: Float64Array,
        *,
        reference_gain: float = 1.0,
        response_per_volt: float = 1.0,
        inter_channel_delay_s: float = 0.0,
        expected_ratio: float = 1.0,
        ridge: float = 1e-6,
        runs_on: bool = True,
    ) -> None:
        require_slots(delay_samples, gain, base_v.size, taps)
        self.period = base_v.size
        self._runs_on = runs_on
        self._sample_rate_hz = sample_rate_hz
        self.taps = taps
        nominal = scipy.fft.rfft(base_v)
        power = np.abs(nominal) ** 2
        hertz = np.arange(nominal.size) * sample_rate_hz / base_v.size
        in_band = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
        self._median_power = float(np.median(power[in_band]))
        enough = np.flatnonzero(power > LEAST_POWER * self._median_power)
        enough = enough[(enough > 0) & (enough < base_v.size / 2)]
        self._bins = slice(int(enough[0]), int(enough[-1]) + 1)
        self._highest = self._bins.stop / base_v.size
        self._thinning = Thinning(self._highest)
        self._clock = RingClock(nominal[: self._bins.stop], base_v.size, MAX_PPM)
        self._nominal_power = power[self._bins]
        # What the sweep excites beyond its band is fitted and not judged: what hums there does no harm.
        low, high = np.searchsorted(hertz[self._bins], [band_hz[0] * (1 - EDGE), band_hz[1] * (1 + EDGE)])
        self._in_band = slice(int(low), int(high))
        self._share = (self._in_band.stop - self._in_band.start) / (self._bins.stop - self._bins.start)
        self._omega = 2 * np.pi * np.arange(self._bins.start, self._bins.stop) / base_v.size
        self._fit = JointFit(
            self._omega,
            self._nominal_power / self._median_power,
            base_v.size,
            taps,
            np.asarray(delay_samples, dtype=np.float64),
            ridge,
            periodic=runs_on,
        )
        self._weight = self._fit.weight * np.exp(-1j * self._omega * inter_channel_delay_s * sample_rate_hz)
        self._scale = (reference_gain * response_per_volt / np.asarray(gain, dtype=np.float64)).astype(np.float32)
        self._reference_power = reference_gain**2
        self._expected_ratio = expected_ratio
        width = max(round(SMOOTH_HZ * base_v.size / sample_rate_hz) // 2, 0)
        self._smoothing = np.hanning(2 * width + 3)[1:-1]

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float], name: str = "record"
    ) -> Estimate:
        """Estimate the Green's functions of one record.

        reference_v, response_v, float32 (samples,): The two DAQ channels in volts; one period or more.
        range_v: Largest input magnitude in volts on (reference, response), each > 0.
        name: Name of the record for messages.

        Returns Estimate: one row per slot. `residual_db`, `coherence`, `peak_v`, `repeat_db`, `noise_v`, `clip_count`,
        `offset_samples` and `clock_ratio` are the record's and the same for all its slots; the two that compare repeats
        are NaN for less than two periods. `offset_samples` is where a period starts.

        Raises InputError: arrays of wrong shapes, values that are not finite, or less than one period.
        ReferenceMissingError: a reference that does not carry the base signal.
        """
        if reference_v.ndim != 1 or reference_v.shape != response_v.shape:
            raise InputError(
                f"reference and response have shapes {reference_v.shape} and {response_v.shape}; "
                "allowed is (samples,) for both"
            )
        channels = np.stack([reference_v, response_v]).astype(np.float32, copy=False)
        peaks = find_peaks(channels)
        if not np.isfinite(peaks[0]).all():
            raise InputError(f"{name} holds values that are not finite; allowed are volts")
        samples = channels.shape[1]
        if self._runs_on:
            require_coverage(samples, self.period, self._highest, name)
        thinned = self._thinning(channels)
        clock = self._found_clock(thinned, name)
        turn = 2 * np.pi / (self.period * clock.ratio)
        sums = self._thinning.spectrum(thinned, turn, 0, self._bins.stop)
        reference, answered = ring_spectrum(sums, turn, samples) if self._runs_on else sums * (2 / self.period)
        base = self._cleaned(reference[self._bins], clock)
        data = (self._weight * answered[self._bins] * base.conj() / np.maximum(np.square(np.abs(base)), FLOOR)).astype(
            np.complex64
        )
        solution = self._fit.solve(data)

        periods = samples / (self.period * clock.ratio)
        coherence, repeat_db = self._repeatability(thinned, answered, turn, periods)
        here = self._in_band
        whole, unexplained = (float(np.vdot(one[here], one[here]).real) for one in (data, solution.left))
        variance = unexplained / (self._share * self._fit.left_share * self._fit.elements)
        noise = variance * self._fit.elements
        level = float(np.square(np.abs(base) * self.period / 2).sum() / self._nominal_power.sum())
        # Noise is recorded during silence too; over more than a period it is averaged.
        averaged = periods if self._runs_on else 1 / periods
        noise_v = np.sqrt(variance * averaged * level * self._median_power)
        clipped = sum(
            count_clipped(channels[row : row + 1], peaks[0][row : row + 1], peaks[1][row : row + 1], range_v[row])
            for row in range(2)
        )
        slots = solution.energy.size
        defects = not_looked_at(slots)
        if self._runs_on:
            turned = np.zeros(solution.left.size, dtype=np.complex128)
            turned[here] = (solution.left * np.exp(1j * np.angle(base)))[here]
            defects["burst_db"], defects["burst_s"] = self._burst(turned, whole)
            defects["line_db"], defects["line_hz"] = self._line(solution.left, whole)

        def each(figure: float) -> Float32Array:
            return np.full(slots, figure, dtype=np.float32)

        return Estimate(
            green=solution.green * self._scale[:, None],
            snr_db=decibel(solution.energy, np.full(slots, noise)),
            residual_db=each(float(decibel(np.array(unexplained), np.array(whole)))),
            coherence=each(coherence),
            peak_v=each(float(peaks[0][1])),
            repeat_db=each(repeat_db),
            noise_v=each(float(noise_v)),
            clip_count=np.full(slots, int(np.sum(clipped)), dtype=np.int32),
            offset_samples=np.full(slots, clock.offset_samples),
            clock_ratio=np.full(slots, clock.ratio),
            defects=defects,
            reference_db=each(float(decibel(np.array(level), np.array(self._reference_power)))),
        )

    def _burst(self, left: Complex128Array, whole: float) -> tuple[float, float]:
        """Energy of the residual within a moment over all energy, in dB, and when that is in seconds of the period.

        -inf where no moment stands out of the others.
        """
        spectrum = np.zeros(self.period // 2 + 1, dtype=np.complex128)
        spectrum[self._bins] = left
        residual = scipy.fft.irfft(spectrum, self.period) * np.sqrt(2 * self.period)
        step = max(round(BURST_S * self._sample_rate_hz) // 2, 1)
        moments = np.add.reduceat(np.square(residual), np.arange(0, self.period, step))[: self.period // step]
        moments = moments + np.roll(moments, -1)
        loudest = int(np.argmax(moments))
        if moments[loudest] < BURST_OVER_MEDIAN * np.median(moments):
            return -np.inf, np.nan
        # The fits hide their share of it.
        energy = float(moments[loudest]) / self._fit.left_share
        return float(decibel(np.array(energy), np.array(whole))), loudest * step / self._sample_rate_hz

    def _line(self, left: NDArray[np.complex64], whole: float) -> tuple[float, float]:
        """Energy of a steady tone in the residual over all energy, in dB, and its frequency in Hz.

        -inf where none stands out of the others. Of a tone beyond the band that which leaks into it counts.
        """
        power = np.square(np.abs(left)).astype(np.float64)
        inside, outside = power[self._in_band], power.copy()
        outside[self._in_band] = 0.0
        highest = int(np.argmax(outside))
        energy = float(inside.sum())
        if not outside[highest] > LEAKS * energy:
            highest = self._in_band.start + int(np.argmax(inside))
            # A tone between two bins shows in both.
            energy = float(power[max(highest - 1, 0) : highest + 2].sum())
            if energy < LINE_OVER_MEDIAN * np.median(inside):
                return -np.inf, np.nan
        hertz = (self._bins.start + highest) * self._sample_rate_hz / self.period
        return float(decibel(np.array(energy / self._fit.left_share), np.array(whole))), hertz

    def _found_clock(self, thinned: Thinned, name: str) -> RingFit:
        clock = self._clock.fit(thinned, self._thinning, self._expected_ratio)
        if not clock.explained > 1 - REFERENCE_LIMIT or abs(clock.ratio - 1) > 1.01e-6 * MAX_PPM:
            raise ReferenceMissingError(
                f"the reference of {name} does not carry the base signal (explained {100 * clock.explained:.0f} % in "
                f"band, allowed {100 - 100 * REFERENCE_LIMIT:.0f} % or more; clock skew "
                f"{1e6 * (clock.ratio - 1):.1f} ppm, allowed {MAX_PPM:g} ppm); check the loopback"
            )
        return clock

    def _cleaned(self, reference: Complex128Array, clock: RingFit) -> Complex128Array:
        """Amplitudes of the base signal as the reference channel carries it, all but free of its noise."""
        delayed = np.exp(-1j * self._omega * clock.offset_samples / clock.ratio) * (2 / self.period)
        fitted = self._clock.coupled(clock)[self._bins] * delayed
        power = np.square(np.abs(fitted))
        # Both sums fade out together at the ends of the band.
        alike = np.convolve(reference * fitted.conj(), self._smoothing, mode="same")
        around = np.convolve(power, self._smoothing, mode="same")
        return np.asarray(fitted * alike / np.maximum(around, FLOOR))

    def _repeatability(
        self, thinned: Thinned, answered: Complex128Array, turn: float, periods: float
    ) -> tuple[float, float]:
        """Coherence and repeat difference: what of the response in band is not the same in every period."""
        if periods < LEAST_PERIODS:
            return float("nan"), float("nan")
        inside, step = thinned.inside, self._thinning.step
        recorded = thinned.values[1, inside].astype(np.float64)
        place = thinned.first + step * inside.start
        bins = np.arange(answered.size)
        repeated = ring_signal(answered * np.exp(1j * turn * place * bins), turn * step, 0, recorded.size)
        length = scipy.fft.next_fast_len(recorded.size, real=True)
        cycles = np.arange(length // 2 + 1) / (length * step)
        first, last = (self._bins.start + edge for edge in (self._in_band.start, self._in_band.stop))
        band = (cycles >= first / self.period) & (cycles <= last / self.period)
        differing, whole = (
            float(np.square(np.abs(scipy.fft.rfft(signal, length)[band])).sum())
            for signal in (recorded - repeated, recorded)
        )
        coherence = 1 - (differing + FLOOR) / (whole + FLOOR)
        freed = differing * periods / (periods - 1)
        return coherence, float(decibel(np.array(freed), np.array(whole)))


def require_slots(delay_samples: Float64Array, gain: Float64Array, period: int, taps: int) -> None:
    """Refuse slots whose responses overlap.

    delay_samples, gain, float64 (slots,): As of `StaggeredEstimator`.
    period: Samples of the ring.
    taps: Length of the responses.

    Raises InputError: delays out of range or closer than `taps`, or gains of 0.
    """
    delays = np.asarray(delay_samples, dtype=np.float64)
    if delays.ndim != 1 or delays.shape != np.shape(gain) or not delays.size:
        raise InputError(f"delays and gains have shapes {delays.shape} and {np.shape(gain)}; allowed is one per slot")
    if not (np.isfinite(gain).all() and np.all(gain)):
        raise InputError(f"a slot has the gain {gain}; allowed are finite numbers, not 0")
    if not (np.isfinite(delays).all() and delays.min() >= 0 and delays.max() < period):
        raise InputError(
            f"a slot is delayed by {delays.max():g} samples; allowed is 0 or more and less than the period, {period}"
        )
    order = np.argsort(delays)
    apart = np.diff(delays[order], append=delays[order[0]] + period)
    closest = int(np.argmin(apart))
    if not 1 <= taps <= apart[closest] + 1e-6:
        raise InputError(
            f"taps is {taps}; allowed is 1 to the distance of two slots, {apart[closest]:g} samples "
            f"between delays {delays[order[closest]]:g} and {delays[order[(closest + 1) % order.size]]:g}"
        )
