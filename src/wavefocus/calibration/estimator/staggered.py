"""From records in which several actuators play at once, delayed, to their Green's functions."""

from collections.abc import Iterator

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.estimator.causal_fit import RIDGE
from wavefocus.calibration.estimator.defect_finder import energy, find_moment, find_tone, measure_levels, not_looked_at
from wavefocus.calibration.estimator.estimate import EDGE, FLOOR, Estimate, Records, decibel
from wavefocus.calibration.estimator.multichannel_fir_fit import JointFit
from wavefocus.calibration.known_signal import (
    MAX_PPM,
    REFERENCE_LIMIT,
    ClockFit,
    KnownSignalClock,
    filled_bins,
)
from wavefocus.calibration.numerics import periodic_signal
from wavefocus.calibration.resampling import Decimated, decimate
from wavefocus.calibration.timing import missing_reference, other_rate
from wavefocus.storage.errors import InputError

# What of a period lies outside the record may last so many periods of the highest frequency: what sounds
# there is still determined by what sounds around it.
MAX_MISSING = 1.3
# Relative residual at which the conjugate gradients end, and how many steps they may take.
CG_TOLERANCE = 1e-5
MAX_STEPS = 100


def require_coverage(samples: int, period: float, highest: float, what: str) -> None:
    """Refuse a record too short for a period.

    samples: Its samples.
    period: The period in samples of the record.
    highest: Upper end of the band in cycles per sample.
    what: Name of the record for the message.

    Raises InputError: more of the period is missing than its band allows.
    """
    if (period - samples) * highest > MAX_MISSING:
        raise InputError(
            f"{what} has {samples} samples, less than the period of {period:.0f}; record one period or more"
        )


def period_spectrum(sums: Complex128Array, turn: float, samples: int) -> Complex128Array:
    """Amplitudes of the ring's frequencies by least squares, from the Fourier sums of recordings at them.

    Over whole periods these would be proportional; over any other length the frequencies leak into each
    other, by a kernel that depends only on the difference of two, so the system is Toeplitz.

    sums, complex128 (records, bins): Sums over n = 0 ... samples - 1 of ``recording[n] * exp(-j n m turn)`` for m = 0
        ... bins - 1.
    turn: Spacing of the frequencies in radians per sample.
    samples: Length of the recordings; a period or more, but for what `require_coverage` allows.

    Returns complex128 (records, bins): A such that ``recording[n] = real part of sum over m of A[m] * exp(j n m
    turn)``; A[0] is real.
    """
    bins = sums.shape[1]
    length = scipy.fft.next_fast_len(4 * bins, real=True)
    # Two-sided spectra and the kernel are Hermitian: their transforms are real.
    kernel = scipy.fft.hfft(_dirichlet(turn, samples, np.arange(2 * bins)), length)

    def leaked(half: Complex128Array) -> Complex128Array:
        return np.asarray(scipy.fft.ihfft(scipy.fft.hfft(half, length) * kernel)[:, :bins])

    wanted = sums.copy()
    wanted[:, 0] = wanted[:, 0].real
    found = wanted / samples
    left = wanted - leaked(found)
    step = left.copy()
    power = _dot(left, left)
    goal = CG_TOLERANCE**2 * _dot(wanted, wanted)
    for _ in range(MAX_STEPS):
        if (power <= goal).all():
            break
        turned = leaked(step)
        length_of_step = power / np.maximum(_dot(step, turned), 1e-300)
        found += length_of_step * step
        left -= length_of_step * turned
        before, power = power, _dot(left, left)
        step = left + power / np.maximum(before, 1e-300) * step
    found[:, 1:] *= 2
    return np.asarray(found)


def _dot(first: Complex128Array, other: Complex128Array) -> Float64Array:
    """Inner products of two-sided spectra that are given by their one side, shape (records, 1)."""
    products = (first.conj() * other).real
    return np.asarray(2 * products[:, 1:].sum(axis=1, keepdims=True) + products[:, :1])


def _dirichlet(turn: float, samples: int, differences: Int64Array) -> Complex128Array:
    """Sums over n = 0 ... samples - 1 of ``exp(-j n turn difference)``."""
    half = 0.5 * turn * differences
    sine = np.sin(half)
    whole = np.abs(sine) < 1e-12
    ratio = np.where(whole, samples, np.sin(samples * half) / np.where(whole, 1.0, sine))
    return np.asarray(ratio * np.exp(-1j * (samples - 1) * half))


# Bins whose nominal energy is below this share of the median in band carry noise only.
MIN_POWER = 1e-4
# The way from player to reference input rings for less than the inverse of this, so its factor is smooth.
SMOOTH_HZ = 10.0
# The fit smears what it cannot explain. Chance makes the loudest of thousands of moments six times their median, the
# loudest of 1e12 bins 40 times.
BURST_OVER_MEDIAN, TONE_OVER_MEDIAN = 12.0, 80.0
# Repeats can be compared from so many periods on.
MIN_PERIODS = 1.9


class StaggeredEstimator:
    """Joint least squares for the causal FIRs of all slots of each record, on the ring of the playback clock.

    A record holds a periodic base signal that is already running when it starts. Offset and clock ratio come from the
    reference; the spectra of both channels are then taken at the frequencies of the ring on the playback clock,
    exactly, whatever the record's length. The recorded reference is cleaned of its noise: it is the base signal times a
    smooth factor. Safe to call from several threads.

    base_v, float64 (period,): One period of the base signal in volts, on the playback clock.
    records: What plays when; delays are L or more apart on the ring.

    Raises InputError: delays closer than that, or too much for the memory of a joint fit.
    """

    def __init__(self, base_v: Float64Array, records: Records) -> None:
        self._records = records
        self._rate_hz, self._period, self._base_v = records.sample_rate_hz, base_v.size, base_v
        nominal = scipy.fft.rfft(base_v)
        power = np.abs(nominal) ** 2
        filled = filled_bins(power, base_v.size, records.band_hz, self._rate_hz, MIN_POWER)
        self._bins, self._median_power = filled
        self._highest = self._bins.stop / base_v.size
        self._clock = KnownSignalClock(nominal[: self._bins.stop], base_v.size)
        self._nominal_power = power[self._bins]
        # What the sweep excites beyond its band is fitted and not judged: what hums there does no harm.
        edges = records.band_hz[0] * (1 - EDGE), records.band_hz[1] * (1 + EDGE)
        hertz = np.arange(self._bins.start, self._bins.stop) * self._rate_hz / base_v.size
        low, high = np.searchsorted(hertz, edges)
        self._in_band = slice(int(low), int(high))
        self._share = (self._in_band.stop - self._in_band.start) / (self._bins.stop - self._bins.start)
        self._omega = 2 * np.pi * np.arange(self._bins.start, self._bins.stop) / base_v.size
        self._in_time = np.exp(-1j * self._omega * records.channels.inter_channel_delay_s * self._rate_hz)
        width = max(round(SMOOTH_HZ * base_v.size / self._rate_hz) // 2, 0)
        self._smoothing = np.hanning(2 * width + 3)[1:-1]
        # Records with the same delays share a fit.
        fits: dict[bytes, JointFit] = {}
        self._fits: list[tuple[JointFit, Float32Array]] = []
        for record in range(records.schedule.records):
            _, delay_s, gain = records.schedule.slots(record)
            fit = fits.get(delay_s.tobytes()) or self._fit_of(delay_s * self._rate_hz)
            fits[delay_s.tobytes()] = fit
            scale = records.channels.reference_gain * records.channels.response_per_volt / gain
            self._fits.append((fit, scale.astype(np.float32)))

    def _fit_of(self, delays: Float64Array) -> JointFit:
        order = np.argsort(delays)
        apart = np.diff(delays[order], append=delays[order[0]] + self._period)
        closest, taps = int(np.argmin(apart)), self._records.taps
        if not 1 <= taps <= apart[closest] + 1e-6:
            raise InputError(
                f"taps is {taps}; allowed is 1 to the distance of two slots, {apart[closest]:g} samples between "
                f"delays {delays[order[closest]]:g} and {delays[order[(closest + 1) % order.size]]:g}"
            )
        relative = self._nominal_power / self._median_power
        return JointFit(self._omega, relative, self._period, taps, delays, RIDGE)

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `PositionEstimator`.

        Figures other than `green` and `snr_db` are the record's and the same for all its slots; the coherence
        is NaN for less than two periods. `offset_samples` is where a period starts.
        """
        self._records.require(reference_v, response_v)
        found = [
            self._estimate(reference_v[record], response_v[record], range_v, record)
            for record in range(len(self._fits))
        ]
        return self._records.by_actuator(found, range(len(found)))

    def _estimate(
        self, reference_v: Float32Array, response_v: Float32Array, range_v: tuple[float, float], record: int
    ) -> Estimate:
        fit, scale = self._fits[record]
        channels, name = np.stack([reference_v, response_v]).astype(np.float32, copy=False), f"record {record}"
        levels = measure_levels(channels[:1], channels[1:], range_v, name)
        samples = channels.shape[1]
        require_coverage(samples, self._period, self._highest, name)
        decimated = decimate(channels, self._highest)
        clock = self._clock.fit(decimated)
        what = f"the reference of {name}"
        if not clock.explained > 1 - REFERENCE_LIMIT:
            words = f"explained {100 * clock.explained:.0f} % in band, allowed {100 - 100 * REFERENCE_LIMIT:.0f} %"
            # Half a period, which lies somewhere in the recording as a whole.
            half = self._base_v[: self._period // 2]
            raise missing_reference(channels[0], half, self._highest, what, words)
        if abs(clock.ratio - 1) > 1.01e-6 * MAX_PPM:
            raise other_rate(what, clock.ratio)
        turn = 2 * np.pi / (self._period * clock.ratio)
        reference, answered = period_spectrum(decimated.spectrum(turn, 0, self._bins.stop), turn, samples)
        base = self._cleaned(reference[self._bins], clock)
        transfer = answered[self._bins] * base.conj() / np.maximum(np.square(np.abs(base)), FLOOR)
        data = (fit.weight * self._in_time * transfer).astype(np.complex64)
        green, explained, left = fit.solve(data)
        periods = samples / (self._period * clock.ratio)
        here = self._in_band
        whole, unexplained = (float(np.vdot(values[here], values[here]).real) for values in (data, left))
        variance = unexplained / (self._share * fit.left_share * fit.elements)
        level = float(np.square(np.abs(base) * self._period / 2).sum() / self._nominal_power.sum())
        defects = not_looked_at(len(green))
        defects["slip_db"] = decibel(max(1 - clock.explained, 0.0), 1.0)
        turned = left * np.exp(1j * np.angle(base))
        # The fit hides its share of what is there.
        visible_db = decibel(unexplained / fit.left_share, whole)
        for name, is_there, where in self._concentrated(turned):
            defects[f"{name}_db"] = visible_db if is_there else -np.inf
            defects["burst_s" if name == "burst" else "line_hz"] = where
        return Estimate.of_slots(
            green * scale[:, None],
            decibel(explained, variance * fit.elements),
            defects=defects,
            residual_db=float(decibel(unexplained, whole)),
            coherence=self._coherence(decimated, answered, turn, periods),
            peak_v=float(levels.response_v[0]),
            noise_v=float(np.sqrt(variance * periods * level * self._median_power)),
            clip_count=int(levels.clip_count[0]),
            offset_samples=clock.offset_samples,
            clock_ratio=clock.ratio,
            reference_db=float(decibel(level, self._records.channels.reference_gain**2)),
        )

    def _concentrated(self, left: Complex128Array) -> Iterator[tuple[str, bool, float]]:
        """Whether most of the residual is a tone, and its frequency in Hz; or a burst, and its time in s."""
        _, (over,), (highest,) = find_tone(energy(left)[None], self._in_band)
        is_tone = bool(over > TONE_OVER_MEDIAN)
        yield "line", is_tone, (self._bins.start + highest) * self._rate_hz / self._period
        spectrum = np.zeros(self._period // 2 + 1, dtype=np.complex128)
        spectrum[self._bins][self._in_band] = left[self._in_band]
        residual = scipy.fft.irfft(spectrum, self._period)
        _, (over,), (when_s,) = find_moment(np.square(residual)[None], 1 / self._rate_hz)
        yield "burst", bool(over > BURST_OVER_MEDIAN and not is_tone), float(when_s)

    def _cleaned(self, reference: Complex128Array, clock: ClockFit) -> Complex128Array:
        """Amplitudes of the base signal as the reference channel carries it, all but free of its noise."""
        delayed = np.exp(-1j * self._omega * clock.offset_samples / clock.ratio) * (2 / self._period)
        fitted = self._clock.coupled(clock)[self._bins] * delayed
        power = np.square(np.abs(fitted))
        # Both sums fade out together at the ends of the band.
        alike = np.convolve(reference * fitted.conj(), self._smoothing, mode="same")
        around = np.convolve(power, self._smoothing, mode="same")
        return np.asarray(fitted * alike / np.maximum(around, FLOOR))

    def _coherence(self, decimated: Decimated, answered: Complex128Array, turn: float, periods: float) -> float:
        """Share of the response in band that is the same in every period."""
        if periods < MIN_PERIODS:
            return float("nan")
        inside, step = decimated.inside, decimated.step
        recorded = decimated.values[1, inside].astype(np.float64)
        place = decimated.first + step * inside.start
        bins = np.arange(answered.size)
        repeated = periodic_signal(answered * np.exp(1j * turn * place * bins), turn * step, 0, recorded.size)
        length = scipy.fft.next_fast_len(recorded.size, real=True)
        cycles = np.arange(length // 2 + 1) / (length * step)
        first, last = (self._bins.start + edge for edge in (self._in_band.start, self._in_band.stop))
        band = (cycles >= first / self._period) & (cycles <= last / self._period)
        differing, whole = (
            float(np.square(np.abs(scipy.fft.rfft(signal, length)[band])).sum())
            for signal in (recorded - repeated, recorded)
        )
        return 1 - (differing + FLOOR) / (whole + FLOOR)
