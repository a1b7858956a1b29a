"""Clocks of periodic records: from a known period, or from the recording's own repeats."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.clock.known_signal import CORNERS
from wavefocus.calibration.clock.period_spectrum import periodic_signal
from wavefocus.calibration.clock.resampling import KERNEL_HALF, Decimated, resampled
from wavefocus.calibration.numerics import fourier_sum, parabola_vertex

# The search steps through the clock ratios so that the signal turns this far at most, in radians, at the ends
# of the record and the top of the band.
SEARCH_TURN = 0.6
# The search ends where this share of the reference is explained; else the best of all that was tried counts.
FOUND_SHARE = 0.97
MAX_STEPS = 8
# What the coupling capacitors left out is computed anew while a step moves the samples by more than this.
FAR_SAMPLES = 0.1
# Gauss-Newton has ended when no sample moves by more.
ENOUGH_SAMPLES = 1e-4


@dataclass(frozen=True, slots=True)
class PeriodicFit:
    """The recording is ``gain * base((n - offset) / ratio)`` at its sample n, coupling capacitors apart.

    offset_samples: DAQ sample at which a period starts, of those the one nearest to the first sample.
    ratio: DAQ rate over playback rate.
    gain: Recorded volts per volt of the base signal; negative when the wires are crossed.
    explained: Share of the recording's energy in band that this explains, 0 to 1.
    coupling, float64 (corners,): Shares of the signal below each corner frequency.
    """

    offset_samples: float
    ratio: float
    gain: float
    explained: float
    coupling: Float64Array


class PeriodicClock:
    """Fits the clock of records of one periodic signal.

    spectrum, complex128 (bins,): Discrete Fourier transform of one period on the playback clock, bins 0 and on; what is
        left out is not looked at.
    period: Samples of the period on the playback clock.
    max_ppm: Largest clock skew in parts per million.
    """

    def __init__(self, spectrum: Complex128Array, period: int, max_ppm: float) -> None:
        self._period, self._max_ppm, self._whole = period, max_ppm, spectrum
        power = np.abs(spectrum) ** 2
        below = np.cumsum(power)
        self._first = max(int(np.searchsorted(below, 1e-6 * below[-1])), 1)
        self._spectrum = spectrum[self._first :]
        bins = np.arange(self._first, spectrum.size)
        self._highest = spectrum.size / period
        self._amplitudes = self._spectrum * 2 / period
        lowest = max(int(np.searchsorted(below, 0.01 * below[-1])), 1)
        self._slope = 2j * np.pi * bins / period
        # Corner frequencies in bins.
        corners = lowest * np.array(CORNERS)
        self._all_coupling = 1 / (1 + 1j * np.arange(spectrum.size) / corners[:, None])
        self._coupling = self._all_coupling[:, self._first :]

    def coupled(self, fit: PeriodicFit) -> Complex128Array:
        """Spectrum of the base signal (bins,) as the reference channel carries it, but for the offset."""
        return np.asarray(self._whole * (fit.gain + fit.coupling @ self._all_coupling))

    def fit(self, decimated: Decimated, expected: float = 1.0, *, search: bool = True) -> PeriodicFit:
        """Find offset and ratio, first near the expected ratio, then further and further away.

        decimated: One recording of the reference.
        expected: Clock ratio that is tried first.
        search: Whether others are tried after it.

        Returns PeriodicFit: the best there is; its `explained` shows how good it is.
        """
        inside = decimated.inside
        values = decimated.values[0, inside].astype(np.float64)
        place = decimated.first + decimated.step * np.arange(inside.start, inside.stop)
        # One period is enough to begin with, and lets the search take wider steps.
        short = math.ceil(self._period / decimated.step)
        short = values.size if values.size < 1.5 * short else short
        step = 2 * SEARCH_TURN / (math.pi * self._highest * (place[short - 1] - place[0]))
        best: PeriodicFit | None = None
        for turn in range(2 * math.ceil(1e-6 * self._max_ppm / step) + 1 if search else 1):
            ratio = expected + (turn // 2 + turn % 2) * (1 if turn % 2 else -1) * step
            if turn and abs(ratio - 1) > 1e-6 * self._max_ppm + step:
                continue
            start = self._offset(values[:short], place[:short], ratio)
            found = self._gauss_newton(values[:short], place[:short], start, ratio)
            if best is None or found.explained > best.explained:
                best = found
            if best.explained > FOUND_SHARE:
                break
        assert best is not None
        if values.size > short:
            best = self._gauss_newton(values, place, best.offset_samples, best.ratio)
        return best

    def _offset(self, values: Float64Array, place: Int64Array, ratio: float) -> float:
        """Offset in samples to about one, from the envelope of the cross-correlation on the ring."""
        step = int(place[1] - place[0])
        turn = 2 * np.pi / (self._period * ratio)
        sums = fourier_sum(values, turn * step, self._first, self._spectrum.size)
        sums = sums * np.exp(-1j * turn * place[0] * (self._first + np.arange(sums.size)))
        length = scipy.fft.next_fast_len(2 * self._spectrum.size)
        envelope = np.abs(scipy.fft.ifft(sums * self._spectrum.conj(), length))
        top = int(np.argmax(envelope))
        peak = top + parabola_vertex(*(envelope[(top + side) % length] for side in (-1, 0, 1)))
        late = peak / length * self._period
        return float((late - self._period if late > self._period / 2 else late) * ratio)

    def _gauss_newton(self, values: Float64Array, place: Int64Array, offset: float, ratio: float) -> PeriodicFit:
        energy = float(values @ values)
        middle = 0.5 * (place[0] + place[-1])
        lever = (place - middle) / max(place[-1] - middle, 1.0)
        ones = np.ones_like(values)
        coupled = np.zeros((0, values.size))
        gain, explained, coupling, far = 0.0, 0.0, np.zeros(len(self._coupling)), True
        for step in range(MAX_STEPS):
            waves = [self._amplitudes, self._amplitudes * self._slope]
            if far:
                waves += list(self._amplitudes * self._coupling)
            sampled = self._waves_at(np.stack(waves), place, offset, ratio)
            if far:
                coupled = sampled[2:]
            model = np.concatenate([sampled[:2], (sampled[1] * lever)[None], coupled, ones[None]])
            size = np.sqrt(np.square(model).sum(axis=1)) + 1e-300
            model /= size[:, None]
            gram, matched = model @ model.T, model @ values
            shares = np.linalg.lstsq(gram, matched, rcond=1e-10)[0]
            explained = float(matched @ shares / (energy + 1e-300))
            shares = shares / size
            gain, coupling = float(shares[0]), shares[3:-1]
            if gain == 0 or not np.isfinite(shares).all():
                break
            # base(theta + moved) = base + base' * moved, theta = (n - offset) / ratio
            moved, stretched = shares[1] / gain, shares[2] / gain
            limit = 0.25 / self._highest
            moved, stretched = (float(np.clip(one, -limit, limit)) for one in (moved, stretched))
            slope = 1 / ratio + stretched / max(place[-1] - middle, 1.0)
            at_middle = (middle - offset) / ratio + moved
            ratio = 1 / slope
            offset = middle - at_middle * ratio
            far = abs(moved) + abs(stretched) > FAR_SAMPLES
            if step and abs(moved) + abs(stretched) < ENOUGH_SAMPLES:
                break
        period = self._period * ratio
        return PeriodicFit(offset - period * round(offset / period), ratio, gain, explained, coupling)

    def _waves_at(self, amplitudes: Complex128Array, place: Int64Array, offset: float, ratio: float) -> Float64Array:
        """Ring signals (rows, values) at places of the recording."""
        turn = 2 * np.pi / (self._period * ratio)
        bins = self._first + np.arange(amplitudes.shape[1])
        moved = amplitudes * np.exp(1j * turn * (place[0] - offset) * bins)
        return periodic_signal(moved, turn * float(place[1] - place[0]), self._first, place.size)


# Lags looked at are so many decimated samples apart: a thirtieth of a period of the highest frequency.
LAG_STEP = 0.1
# Step over which a derivative is taken, in decimated samples.
DERIVATIVE_STEP = 0.02
# A clock fitted to the signal's own repeats must be as sure as this; 1 ppm would cost 1 dB at -63 dB.
MAX_SIGMA_PPM = 0.3
MAX_MISFIT = 0.03
# Fewer decimated samples than this are not enough.
MIN_SAMPLES = 32


@dataclass(frozen=True, slots=True)
class RepeatFit:
    """How a recording repeats itself.

    ratio: DAQ rate over playback rate.
    sigma_ppm: Standard deviation of that in parts per million, from what does not repeat.
    misfit: Energy that does not repeat over that which could.
    """

    ratio: float
    sigma_ppm: float
    misfit: float

    @property
    def is_sure(self) -> bool:
        """Whether it repeats so well that its own clock can be used."""
        return self.sigma_ppm < MAX_SIGMA_PPM and self.misfit < MAX_MISFIT


def fit_repeats(decimated: Decimated, period: float, samples: int, max_ppm: float) -> RepeatFit | None:
    """Compare a recording with itself some periods later.

    decimated: One recording of a signal that repeats throughout it.
    period: The period in playback samples.
    samples: Length of the undecimated recording.
    max_ppm: Largest clock skew in parts per million.

    Returns RepeatFit or None: None where the recording is hardly longer than a period.
    """
    values = decimated.values[0, decimated.inside].astype(np.float64)
    values = values - values.mean()
    best: tuple[float, int, int] | None = None
    for periods in range(1, math.floor(samples / period) + 1):
        longest = periods * period * (1 + 1e-6 * max_ppm) / decimated.step
        common = values.size - math.ceil(longest) - 2 * KERNEL_HALF
        worth = periods * math.sqrt(max(common, 0))
        if common >= MIN_SAMPLES and (best is None or worth > best[0]):
            best = worth, periods, common
    if best is None:
        return None
    _, periods, common = best
    lag = periods * period / decimated.step
    first = values[KERNEL_HALF : KERNEL_HALF + common]

    def later(by: float) -> Float64Array:
        return np.asarray(resampled(values[None], KERNEL_HALF + by, 1.0, common)[0])

    lag = _coarse_lag(values, first, lag, math.ceil(1e-6 * max_ppm * lag / LAG_STEP))
    left, slope = later(lag) - first, np.zeros(common)
    for _ in range(MAX_STEPS):
        slope = (later(lag + DERIVATIVE_STEP) - later(lag - DERIVATIVE_STEP)) / (2 * DERIVATIVE_STEP)
        steep = float(slope @ slope)
        if steep == 0:
            return None
        moved = float(np.clip(-(slope @ left) / steep, -LAG_STEP, LAG_STEP))
        lag += moved
        left = later(lag) - first
        if abs(moved) < 1e-7 * lag:
            break
    ratio = lag * decimated.step / (periods * period)
    sigma = math.sqrt(float(left @ left) / common / steep) / lag
    energy = float(first @ first) + 1e-300
    return RepeatFit(ratio, 1e6 * sigma, float(left @ left) / energy)


def _coarse_lag(values: Float64Array, first: Float64Array, lag: float, reach: int) -> float:
    """The lag at which `first`, which begins `KERNEL_HALF` after the values, comes back best; by a correlation."""
    tried = lag + LAG_STEP * np.arange(-reach, reach + 1)
    length = scipy.fft.next_fast_len(values.size + first.size, real=True)
    cross = scipy.fft.rfft(values, length) * scipy.fft.rfft(first, length).conj()
    # All bins but the first count twice, for the negative frequencies.
    turn = 2 * np.pi * LAG_STEP / length
    cross = 2 * cross * np.exp(2j * np.pi / length * (KERNEL_HALF + tried[0]) * np.arange(cross.size))
    cross[0] /= 2
    correlation = fourier_sum(cross.conj(), turn, 0, tried.size).real / length
    energy = np.concatenate([[0.0], np.cumsum(np.square(values))])
    begin = np.clip(np.round(tried).astype(np.int64) + KERNEL_HALF, 0, values.size - first.size)
    return float(tried[int(np.argmin(energy[begin + first.size] - energy[begin] - 2 * correlation))])
