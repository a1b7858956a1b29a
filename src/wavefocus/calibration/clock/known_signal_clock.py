"""The clock of records of a known signal, periodic or played once, by least squares on its wave."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.clock.known_signal import CORNERS
from wavefocus.calibration.clock.period_spectrum import periodic_signal
from wavefocus.calibration.clock.resampling import Decimated
from wavefocus.calibration.numerics import fourier_sum, periodic_top

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
# Steps converge as their squares: the next one would be below a ten-thousandth of this.
NEAR_SAMPLES = 1e-4


@dataclass(frozen=True, slots=True)
class KnownSignalFit:
    """The recording is ``gain * base((n - offset) / ratio)`` at its sample n, coupling capacitors apart.

    offset_samples: DAQ sample at which a period starts, of those the one nearest to the first sample.
    ratio: DAQ rate over playback rate.
    gain: Recorded volts per volt of the base signal; negative when the wires are crossed.
    explained: Share of the recording's energy in band that this explains, 0 to 1.
    coupling, float64 (corners,): Shares of the signal below each corner frequency.
    left: Energy in band that it leaves of the recording, in squared volts.
    """

    offset_samples: float
    ratio: float
    gain: float
    explained: float
    coupling: Float64Array
    left: float


class KnownSignalClock:
    """Fits the clock of records of one periodic signal, or of one that is played once with silence around it.

    spectrum, complex128 (bins,): Discrete Fourier transform of one period on the playback clock, bins 0 and on; what is
        left out is not looked at.
    period: Samples of the period on the playback clock.
    max_ppm: Largest clock skew in parts per million.
    below_share: Share of the energy in the lowest bins that is left out.

    highest: Upper end of the band in cycles per sample.
    """

    def __init__(self, spectrum: Complex128Array, period: int, max_ppm: float, *, below_share: float = 1e-6) -> None:
        self.period, self._max_ppm, self._whole = period, max_ppm, spectrum
        power = np.abs(spectrum) ** 2
        below = np.cumsum(power)
        self._first = max(int(np.searchsorted(below, below_share * below[-1])), 1)
        self._spectrum = spectrum[self._first :]
        bins = np.arange(self._first, spectrum.size)
        self.highest = spectrum.size / period
        self._amplitudes = self._spectrum * 2 / period
        lowest = max(int(np.searchsorted(below, 0.01 * below[-1])), 1)
        self._slope = 2j * np.pi * bins / period
        # Corner frequencies in bins.
        corners = lowest * np.array(CORNERS)
        self._all_coupling = 1 / (1 + 1j * np.arange(spectrum.size) / corners[:, None])
        self._coupling = self._all_coupling[:, self._first :]

    def coupled(self, fit: KnownSignalFit) -> Complex128Array:
        """Spectrum of the base signal (bins,) as the reference channel carries it, but for the offset."""
        return np.asarray(self._whole * (fit.gain + fit.coupling @ self._all_coupling))

    def fit(self, decimated: Decimated) -> KnownSignalFit:
        """Find offset and ratio, first near a ratio of 1, then further and further away.

        decimated: One recording of the reference.

        Returns KnownSignalFit: the best there is; its `explained` shows how good it is.
        """
        values, place = _inside(decimated)
        # One period is enough to begin with, and lets the search take wider steps.
        short = math.ceil(self.period / decimated.step)
        short = values.size if values.size < 1.5 * short else short
        step = 2 * SEARCH_TURN / (math.pi * self.highest * (place[short - 1] - place[0]))
        best: KnownSignalFit | None = None
        for turn in range(2 * math.ceil(1e-6 * self._max_ppm / step) + 1):
            ratio = 1.0 + (turn // 2 + turn % 2) * (1 if turn % 2 else -1) * step
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

    def near(self, length: int, step: int, offset: float, ratio: float) -> NearClock:
        """Make the fit of parts of recordings of `length` samples, a multiple of `step`, of nearly this ratio."""
        place = np.arange(0, length, step)
        waves = np.stack([self._amplitudes, self._amplitudes * self._slope, *(self._amplitudes * self._coupling)])
        return NearClock(self._waves_at(waves, place, offset, ratio), length, self.highest, offset, ratio)

    def _offset(self, values: Float64Array, place: Int64Array, ratio: float) -> float:
        """Offset in samples to about one, from the envelope of the cross-correlation on the ring."""
        step = int(place[1] - place[0])
        turn = 2 * np.pi / (self.period * ratio)
        sums = fourier_sum(values, turn * step, self._first, self._spectrum.size)
        sums = sums * np.exp(-1j * turn * place[0] * (self._first + np.arange(sums.size)))
        length = scipy.fft.next_fast_len(2 * self._spectrum.size)
        envelope = np.abs(scipy.fft.ifft(sums * self._spectrum.conj(), length))
        late = periodic_top(envelope) / length * self.period
        return float((late - self.period if late > self.period / 2 else late) * ratio)

    def _gauss_newton(self, values: Float64Array, place: Int64Array, offset: float, ratio: float) -> KnownSignalFit:
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
            shares, taken = _least_squares(model @ model.T, model @ values)
            explained = taken / (energy + 1e-300)
            gain, coupling = float(shares[0]), shares[3:-1]
            if gain == 0 or not np.isfinite(shares).all():
                break
            # base(theta + moved) = base + base' * moved, theta = (n - offset) / ratio
            moved, stretched = shares[1] / gain, shares[2] / gain
            limit = 0.25 / self.highest
            moved, stretched = (float(np.clip(change, -limit, limit)) for change in (moved, stretched))
            slope = 1 / ratio + stretched / max(place[-1] - middle, 1.0)
            at_middle = (middle - offset) / ratio + moved
            ratio = 1 / slope
            offset = middle - at_middle * ratio
            far = abs(moved) + abs(stretched) > FAR_SAMPLES
            if step and abs(moved) + abs(stretched) < ENOUGH_SAMPLES:
                break
        period = self.period * ratio
        left = (1 - explained) * energy * float(place[1] - place[0])
        return KnownSignalFit(offset - period * round(offset / period), ratio, gain, explained, coupling, left)

    def _waves_at(self, amplitudes: Complex128Array, place: Int64Array, offset: float, ratio: float) -> Float64Array:
        """Ring signals (rows, values) at places of the recording."""
        turn = 2 * np.pi / (self.period * ratio)
        bins = self._first + np.arange(amplitudes.shape[1])
        moved = amplitudes * np.exp(1j * turn * (place[0] - offset) * bins)
        return periodic_signal(moved, turn * float(place[1] - place[0]), self._first, place.size)


class NearClock:
    """Fits spectra of recordings that differ by little but their beginning, far sooner than sums of frequencies do.

    waves, float64 (waves, values): The signal, its derivative and what coupling capacitors leave out, evenly spaced
        over a part of a recording.
    length: Samples of the part.
    highest: Upper end of the band in cycles per sample.
    offset, ratio: Of the waves.
    """

    def __init__(self, waves: Float64Array, length: int, highest: float, offset: float, ratio: float) -> None:
        self._length, self._offset, self._middle, self._highest = length, offset, 0.5 * length, highest
        self.ratio = ratio
        lever = np.linspace(-1, 1, waves.shape[1], endpoint=False)
        spectra = scipy.fft.rfft(np.insert(waves, 2, waves[1] * lever, axis=0)) * (length / waves.shape[1])
        self._bins = slice(1, min(math.ceil(highest * length) + 1, spectra.shape[1]))
        self._spectra = np.ascontiguousarray(spectra[:, self._bins]).view(np.float64)
        self._gram = self._spectra @ self._spectra.T
        self._turns = 2j * np.pi / length * np.arange(1, self._bins.stop)

    def fit(self, spectrum: Complex64Array, offset: float) -> KnownSignalFit:
        """Fit offset and ratio of a part, (length // 2 + 1,), from an offset right to about a sample."""
        part = spectrum[self._bins].astype(np.complex128)
        late, stretched, taken, gain = offset - self._offset, 0.0, 0.0, 0.0
        coupling = np.zeros(len(self._gram) - 3)
        for _ in range(MAX_STEPS):
            matched = self._spectra @ (part * np.exp(self._turns * late)).view(np.float64)
            shares, taken = _least_squares(self._gram, matched)
            gain, coupling = float(shares[0]), shares[3:]
            if gain == 0 or not np.isfinite(shares).all():
                break
            limit = 0.25 / self._highest
            moved, stretched = (float(np.clip(change, -limit, limit)) for change in shares[1:3] / gain)
            late -= moved * self.ratio
            if abs(moved) < NEAR_SAMPLES:
                break
        ratio = 1 / (1 / self.ratio + stretched / self._middle)
        begin = self._middle - (self._middle - self._offset) / self.ratio * ratio + late
        beyond = spectrum[self._bins.stop :]
        within = float(np.vdot(part, part).real)
        left = 2 / self._length * (within - taken + float(np.vdot(beyond, beyond).real))
        return KnownSignalFit(begin, ratio, gain, taken / (within + 1e-300), coupling, left)


def _least_squares(gram: Float64Array, matched: Float64Array) -> tuple[Float64Array, float]:
    """Shares of waves in a recording, from their products with each other and with it; the energy that they explain."""
    size = np.sqrt(np.diag(gram)) + 1e-300
    shares = np.linalg.lstsq(gram / np.outer(size, size), matched / size, rcond=1e-10)[0]
    return shares / size, float(matched / size @ shares)


def _inside(decimated: Decimated) -> tuple[Float64Array, Int64Array]:
    """Values that count, and the samples of the recording at which they lie."""
    inside = decimated.inside
    place = decimated.first + decimated.step * np.arange(inside.start, inside.stop)
    return decimated.values[0, inside].astype(np.float64), place
