"""Where a known signal lies in a recording, by least squares on its wave."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.numerics import fourier_sum, periodic_signal, periodic_top
from wavefocus.calibration.resampling import Decimated
from wavefocus.storage.errors import WavefocusError

MAX_PPM = 500.0
"""Largest skew of the clocks that is looked for, in parts per million."""
CORNERS = (0.1, 0.3, 1.0)
"""Corners of coupling capacitors allowed for, as shares of the lowest frequency played."""
REFERENCE_LIMIT = 0.1
"""Share of the reference's energy that the known signal may leave unexplained; where it leaves more, a fit would be a
guess."""


def filled_bins(
    power: Float64Array, period: int, band_hz: tuple[float, float], sample_rate_hz: float, least: float
) -> tuple[slice, float]:
    """Bins of a spectrum that hold more than noise, and the median power in band.

    power, float64 (period // 2 + 1,): Squared magnitudes of the base signal's spectrum.
    period: Samples of the base signal.
    band_hz: Its band in Hz.
    least: Share of the median power below which a bin holds noise only.
    """
    hertz = np.arange(power.size) * sample_rate_hz / period
    median_power = float(np.median(power[(hertz >= band_hz[0]) & (hertz <= band_hz[1])]))
    filled = np.flatnonzero(power > least * median_power)
    # A fraction of a sample is not defined at half the rate.
    filled = filled[(filled > 0) & (filled < period / 2)]
    return slice(int(filled[0]), int(filled[-1]) + 1), median_power


Cause = Literal["rate", "silence", "noise", "other", "cut"]

REMEDIES: dict[Cause, str] = {
    "rate": "set the audio interface and player.interface_rate_hz to one rate, and its clock source to internal",
    "silence": "check the cable from the loopback output to the reference input",
    "noise": "check level, cable and input range of the loopback, and recorder and player for lost samples",
    "other": "check which output is wired to the reference input, and recorder and player for lost samples",
    "cut": "make pre-roll and post-roll longer",
}


class ReferenceMissingError(WavefocusError):
    """The reference channel does not hold the whole known signal, clearly enough to fit the clock.

    cause: ``"rate"``, ``"silence"``, ``"noise"``, ``"other"`` (signal), or ``"cut"`` (only a part of it was recorded).
    remedy: What to do about it; the message ends with it unless it has advice of its own (`advised`).
    """

    def __init__(self, message: str, cause: Cause = "other", *, advised: bool = False) -> None:
        super().__init__(message if advised else f"{message}; {REMEDIES[cause]}")
        self.cause, self.remedy = cause, REMEDIES[cause]


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
class ClockFit:
    """The recording is ``gain * base((n - offset) / ratio)`` at its sample n, coupling capacitors apart.

    offset_samples: DAQ sample at which the signal starts, or a period, of those the one nearest to the first sample.
    ratio: DAQ rate over playback rate in true time: 1 plus or minus tens of ppm.
    gain: Recorded volts per volt of the base signal; negative where the wires are crossed.
    explained: Share of the recording's energy in band that this explains, 0 to 1.
    coupling, float64 (corners,): Shares of the signal below each corner frequency.
    left: Energy in band that it leaves of the recording, in squared volts.
    residual_db: Energy of the recording that a signal which is played once, through coupling capacitors or not, leaves
        unexplained over that which it explains; NaN of a periodic one.
    """

    offset_samples: float
    ratio: float
    gain: float
    explained: float
    coupling: Float64Array
    left: float
    residual_db: float = math.nan

    @property
    def skew_ppm(self) -> float:
        """How much faster the DAQ clock runs than the playback clock, in parts per million."""
        return 1e6 * (self.ratio - 1)


class KnownSignalClock:
    """Fits the clock of records of one periodic signal, or of one that is played once with silence around it.

    spectrum, complex128 (bins,): Discrete Fourier transform of one period on the playback clock, bins 0 and on; what is
        left out is not looked at.
    period: Samples of the period on the playback clock.
    below_share: Share of the energy in the lowest bins that is left out.

    highest: Upper end of the band in cycles per sample.
    """

    def __init__(self, spectrum: Complex128Array, period: int, *, below_share: float = 1e-6) -> None:
        self.period, self._whole = period, spectrum
        power = np.abs(spectrum) ** 2
        below = np.cumsum(power)
        self._first = max(int(np.searchsorted(below, below_share * below[-1])), 1)
        self._spectrum = spectrum[self._first :]
        bins = np.arange(self._first, spectrum.size)
        self.highest = spectrum.size / period
        lowest = max(int(np.searchsorted(below, 0.01 * below[-1])), 1)
        # Corner frequencies in bins.
        corners = lowest * np.array(CORNERS)
        self._coupling = 1 / (1 + 1j * np.arange(spectrum.size) / corners[:, None])
        # Of the signal, its derivative, and what coupling capacitors leave out.
        amplitudes = self._spectrum * 2 / period
        slope, coupled = 2j * np.pi * bins / period * amplitudes, self._coupling[:, self._first :] * amplitudes
        self._waves = np.concatenate([[amplitudes, slope], coupled])

    def coupled(self, fit: ClockFit) -> Complex128Array:
        """Spectrum of the base signal (bins,) as the reference channel carries it, but for the offset."""
        return np.asarray(self._whole * (fit.gain + fit.coupling @ self._coupling))

    def fit(self, decimated: Decimated) -> ClockFit:
        """Find offset and ratio, first near a ratio of 1, then further and further away.

        decimated: One recording of the reference.

        Returns ClockFit: the best there is; its `explained` shows how good it is.
        """
        inside, values = decimated.inside, decimated.values[0, decimated.inside].astype(np.float64)
        place = decimated.first + decimated.step * np.arange(inside.start, inside.stop)
        # One period is enough to begin with, and lets the search take wider steps.
        short = math.ceil(self.period / decimated.step)
        short = values.size if values.size < 1.5 * short else short
        step = 2 * SEARCH_TURN / (math.pi * self.highest * (place[short - 1] - place[0]))
        best: ClockFit | None = None
        for turn in range(2 * math.ceil(1e-6 * MAX_PPM / step) + 1):
            ratio = 1.0 + (turn // 2 + turn % 2) * (1 if turn % 2 else -1) * step
            if turn and abs(ratio - 1) > 1e-6 * MAX_PPM + step:
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
        return NearClock(self._waves_at(self._waves, place, offset, ratio), length, self.highest, offset, ratio)

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

    def _gauss_newton(self, values: Float64Array, place: Int64Array, offset: float, ratio: float) -> ClockFit:
        energy = float(values @ values)
        middle = 0.5 * (place[0] + place[-1])
        lever = (place - middle) / max(place[-1] - middle, 1.0)
        # The signal, its derivative, that times the lever, what coupling capacitors leave out, and a constant.
        model = np.ones((len(self._waves) + 2, values.size))
        gain, explained, coupling, far = 0.0, 0.0, np.zeros(len(self._waves) - 2), True
        for step in range(MAX_STEPS):
            sampled = self._waves_at(self._waves if far else self._waves[:2], place, offset, ratio)
            model[:2], model[2] = sampled[:2], sampled[1] * lever
            if far:
                model[3:-1] = sampled[2:]
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
        return ClockFit(offset - period * round(offset / period), ratio, gain, explained, coupling, left)

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

    def fit(self, spectrum: Complex64Array, offset: float) -> ClockFit:
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
        return ClockFit(begin, ratio, gain, taken / (within + 1e-300), coupling, left)


def _least_squares(gram: Float64Array, matched: Float64Array) -> tuple[Float64Array, float]:
    """Shares of waves in a recording, from their products with each other and with it; the energy that they explain."""
    size = np.sqrt(np.diag(gram)) + 1e-300
    shares = np.linalg.lstsq(gram / np.outer(size, size), matched / size, rcond=1e-10)[0]
    return shares / size, float(matched / size @ shares)
