"""Clocks: where a known signal lies in a recording."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from wavefocus.calibration import Complex64Array, Float64Array
from wavefocus.calibration.known_signal import (
    MAX_PPM,
    REFERENCE_LIMIT,
    ClockFit,
    KnownSignalClock,
    NearClock,
    ReferenceMissingError,
)
from wavefocus.calibration.numerics import parabola_vertex, periodic_top
from wavefocus.calibration.resampling import decimation_step, resampled
from wavefocus.storage.errors import InputError

# Share of the known signal's energy that may lie outside the bins that are looked at.
BAND_SHARE = 1e-9
# Silence around the known signal that the fit may look at, for a first guess that is off and for tails.
GUARD_SAMPLES = 64
# A stretch that turns the top of the band by less than this at the ends of a record, in radians, is found without
# iteration: what is neglected is its third power.
NEAR_TURN, MAX_STEPS = 0.01, 8


# Blocks of the known signal that are looked for one by one; silent ones are left out.
BLOCKS = 8
MIN_ENERGY = 0.05
# Points per bin of the band on the way back to lags: near enough for a parabola through the envelope's top.
OVERSAMPLING = 1.5
# Silence around the signal where its blocks are looked for in itself.
TRIAL_MARGIN_SAMPLES = 200

RATES_HZ = (48_000, 44_100, 96_000, 88_200)
"""Rates that audio interfaces are set to, the usual ones first."""
CARRIED = 0.3
"""The signal is there when it explains this share of the energy where it lies."""
LONGEST_SAMPLES = 1 << 15
"""Of a signal at another rate so many samples are looked for, which takes some seconds."""
SHORTEST_SAMPLES = 32
"""Of less nothing is told."""
SILENT = 0.005
"""Less than this of the signal's rms is silence with its noise, for a loopback with a gain near 1: -46 dB."""


class _BlockSearch:
    """Finds blocks of a known signal by cross-correlation and draws a line through where they lie.

    The envelopes of the blocks' correlations are added without phase, so that neither repeats in the signal
    nor a drift over the record can mislead it. Only the band of the signal is transformed back.

    A stretch moves a block of a sweep also because its frequencies are met elsewhere in the sweep. How far each
    block moves per unit of stretch is therefore measured on the known signal, stretched on purpose.

    known, float64 (known,): The signal, not all zeros.
    band: Lowest and highest frequency that matter, in cycles per sample.
    """

    def __init__(self, known: Float64Array, band: tuple[float, float]) -> None:
        self._known, self._band = known, band
        edges = np.linspace(0, known.size, BLOCKS + 1).astype(int)
        spans = [(int(low), int(high)) for low, high in itertools.pairwise(edges) if high > low]
        energy = np.array([np.square(known[low:high]).sum() for low, high in spans])
        loud = energy > MIN_ENERGY * energy.max()
        self._spans = [span for span, is_loud in zip(spans, loud, strict=True) if is_loud]
        # The place of a block is the less sure the narrower its band is (Cramer-Rao: energy times squared width); where
        # one sweep ends in it and another begins, its band is not as wide as that seems.
        widths = np.array([_squared_width(known[low:high]) for low, high in self._spans])
        self._worth = energy[loud] * np.minimum(widths, np.median(widths))
        # Records of one campaign are equally long, and so are the parts of them that are cut out.
        self._blocks = lru_cache(maxsize=2)(self._transformed)
        self._moves = np.zeros(len(self._spans))
        if len(self._spans) > 1:
            trial = 0.5e-6 * MAX_PPM
            samples = known.size + 2 * TRIAL_MARGIN_SAMPLES
            lags = [
                self._lags(resampled(known[None], -TRIAL_MARGIN_SAMPLES, 1 / (1 + skew), samples)[0])
                for skew in (trial, -trial)
            ]
            self._moves = (lags[0] - lags[1]) / (2 * trial)

    def first_guess(self, recorded: NDArray[np.floating]) -> tuple[float, float]:
        """Offset and clock ratio, to about a sample over the record.

        recorded, float (samples,): The recording; the signal may lie anywhere in it, or stick out at either end.
        """
        lags = self._lags(recorded)
        share = self._worth / self._worth.sum()
        moves = self._moves - share @ self._moves
        spread = float(share @ moves**2)
        # Blocks that all move alike do not show the stretch.
        slope = float(share @ (moves * lags)) / spread if spread > 1.0 else 0.0
        slope = min(max(slope, -1e-6 * MAX_PPM), 1e-6 * MAX_PPM)
        return float(share @ (lags - slope * self._moves)), 1.0 + slope

    def top(self, spectrum: NDArray[np.complexfloating], length: int) -> float:
        """Sample at which the whole signal correlates most with a ring of `length` samples of this spectrum."""
        bins, lags, _, whole = self._blocks(length)
        return periodic_top(np.abs(scipy.fft.ifft(spectrum[bins] * whole, lags))) * length / lags

    def _lags(self, recorded: NDArray[np.floating]) -> Float64Array:
        """Sample at which the signal would begin, by each block."""
        length = scipy.fft.next_fast_len(recorded.size + self._known.size, real=True)
        bins, lags, blocks, _ = self._blocks(length)
        spectrum = scipy.fft.rfft(recorded.astype(np.float32, copy=False), length)[bins]
        envelopes = np.abs(scipy.fft.ifft(spectrum * blocks, lags, axis=1))
        step = length / lags
        top = int(np.argmax(envelopes.sum(axis=0)))
        # A sweep stretched moves its blocks by twice the stretch.
        reach = math.ceil((2e-6 * MAX_PPM * self._known.size + 8) / step)
        near = (top + np.arange(-reach - 1, reach + 2)) % lags
        close = envelopes[:, near].astype(np.float64)
        found = 1 + np.argmax(close[:, 1:-1], axis=1)
        late = found - reach - 1 + parabola_vertex(*(close[np.arange(len(close)), found + side] for side in (-1, 0, 1)))
        return np.asarray(step * (top + late) - (length if step * top >= recorded.size else 0))

    def _transformed(self, length: int) -> tuple[slice, int, Complex64Array, Complex64Array]:
        """The band of a transform, lags of the way back, conjugate spectra of blocks and of all together there."""
        bins = slice(max(int(self._band[0] * length), 1), math.ceil(self._band[1] * length))
        alone = np.zeros((len(self._spans), length))
        for row, (low, high) in zip(alone, self._spans, strict=True):
            row[low:high] = self._known[low:high]
        spectra = scipy.fft.rfft(alone)[:, bins].conj().astype(np.complex64)
        lags = scipy.fft.next_fast_len(math.ceil(OVERSAMPLING * spectra.shape[1]))
        return bins, lags, spectra, spectra.sum(axis=0)


def _squared_width(block: Float64Array) -> float:
    """Mean square distance of a signal's frequencies from their mean, in squared thousandths of the rate."""
    power = np.square(np.abs(scipy.fft.rfft(block * np.hanning(block.size)))) + 1e-300
    bins = np.arange(power.size) * (1e3 / block.size)
    mean = np.average(bins, weights=power)
    return float(np.average(np.square(bins - mean), weights=power)) + 1e-12


class ClockFitter:
    """Finds offset, clock ratio and gain of one known signal in recordings of the reference channel.

    Blocks of the known signal are first found by cross-correlation (`_BlockSearch`); then its wave is fitted to the
    recording by Gauss-Newton (`NearClock`), as a period with silence around it. Safe to share between threads; a
    result depends on its recording alone.

    known_v, (known,): What was played in volts, on the playback clock, its silences included; known <= samples.

    Raises InputError: an array of a wrong shape, values that are not finite, or all zeros.
    """

    def __init__(self, known_v: ArrayLike) -> None:
        known = np.asarray(known_v, dtype=np.float64)
        if known.ndim != 1 or known.size < 2:
            raise InputError(f"the known signal has the shape {known.shape}; allowed is one axis, 2 or more")
        if not np.isfinite(known).all():
            raise InputError("the known signal holds values that are not finite; allowed are volts")
        if not known.any():
            raise InputError("the known signal is all zeros; allowed is a signal with energy")
        self._known = known
        stretch = math.ceil(1e-6 * MAX_PPM * known.size)
        room = known.size + stretch + 2 * GUARD_SAMPLES
        # Longer than the part that is looked at, whatever the clocks do.
        period = scipy.fft.next_fast_len(
            scipy.fft.next_fast_len(room, real=True) + 2 * stretch + GUARD_SAMPLES, real=True
        )
        spectrum = scipy.fft.rfft(known, period)
        below = np.cumsum(np.abs(spectrum) ** 2)
        first = max(int(np.searchsorted(below, BAND_SHARE * below[-1])), 1)
        last = max(int(np.searchsorted(below, (1 - BAND_SHARE) * below[-1])), first)
        # Half the sample rate is left out: a delay by a fraction of a sample is not defined there.
        bins = min(last + 1, (period + 1) // 2)
        self._clock = KnownSignalClock(spectrum[:bins], period, below_share=BAND_SHARE)
        self._step = decimation_step(self._clock.highest)
        self._length = self._step * scipy.fft.next_fast_len(-(-room // self._step), real=True)
        self.search = _BlockSearch(known, (first / period, bins / period))

    def fit(
        self,
        recorded_v: ArrayLike,
        *,
        diagnose: bool = True,
        name: str = "the reference channel",
        near: tuple[float, float] | None = None,
    ) -> ClockFit:
        """Find the known signal in one recording.

        recorded_v, (samples,): Reference channel in volts, on the DAQ clock.
        name: Of the recording, for messages.
        near: Offset and ratio, right to about a sample over the recording, where they are known.
        diagnose: Whether to find out why the signal is absent, which takes a hundred times as long as a fit.

        Raises InputError: an array of a wrong shape or values that are not finite. ReferenceMissingError: the signal is
        absent, too noisy, or not entirely inside the recording.
        """
        recorded = self._checked(np.asarray(recorded_v), name)
        found = self.best(recorded, near)
        if not self._is_found(found):
            words = f"unexplained {found.residual_db:.1f} dB, allowed {10 * np.log10(REFERENCE_LIMIT):g} dB"
            if not diagnose:
                raise ReferenceMissingError(f"{name} does not carry what was played ({words})")
            raise missing_reference(recorded, self._known, self._clock.highest, name, words)
        if not self._is_inside(found, recorded.size):
            first, last = found.offset_samples, found.offset_samples + (self._known.size - 1) * found.ratio
            words = f"holds only a part of the signal, which spans samples {first:.1f} to {last:.1f} of {recorded.size}"
            raise ReferenceMissingError(f"{name} {words}", "cut")
        return found

    def best(self, recorded: NDArray[np.floating], near: tuple[float, float] | None = None) -> ClockFit:
        """The fit of one recording that explains most, whether the signal is there or not; `near` as `fit` has it."""
        offset, ratio = self.search.first_guess(recorded) if near is None else near
        return self._refined(*self._cut(recorded, offset), offset, self._near(ratio))[0]

    def fit_all(self, recorded_v: NDArray[np.floating], names: Sequence[str]) -> list[ClockFit]:
        """Find the known signal in recordings of one pair of clocks: each as `fit`, those after the first sooner.

        recorded_v, (recordings, samples): Reference channel in volts. names: Of the recordings, for messages.

        Raises InputError, ReferenceMissingError: as `fit`.
        """
        fits = [self.fit(recorded_v[0], name=names[0])]
        if len(names) == 1:
            return fits
        known, clock = fits[0], self._near(fits[0].ratio)
        # What the correlation of the whole signal errs by in the first recording, and so in the others.
        bias = known.offset_samples - self._place(recorded_v[0], known.offset_samples)[2]
        for recorded, name in zip(recorded_v[1:], names[1:], strict=True):
            spectrum, first, place = self._place(self._checked(recorded, name), known.offset_samples)
            found, clock = self._refined(spectrum, first, place + bias, clock)
            near = self._is_found(found) and found.residual_db <= known.residual_db + 3.0
            fits.append(found if near and self._is_inside(found, recorded.size) else self.fit(recorded, name=name))
        return fits

    def _near(self, ratio: float) -> NearClock:
        return self._clock.near(self._length, self._step, GUARD_SAMPLES, ratio)

    def _is_found(self, fit: ClockFit) -> bool:
        return fit.residual_db <= 10 * np.log10(REFERENCE_LIMIT) and abs(fit.ratio - 1) <= 1.01e-6 * MAX_PPM

    def _is_inside(self, fit: ClockFit, recorded: int) -> bool:
        last = fit.offset_samples + (self._known.size - 1) * fit.ratio
        return fit.offset_samples >= -0.5 and last <= recorded - 0.5

    def _refined(
        self, spectrum: Complex64Array, first: int, offset: float, clock: NearClock
    ) -> tuple[ClockFit, NearClock]:
        """The fit of the part of a recording from sample `first` on, and the clock near it."""
        offset -= first
        for _ in range(MAX_STEPS):
            fit = clock.fit(spectrum, offset)
            turned = math.pi * self._clock.highest * abs(fit.ratio - clock.ratio) * self._length
            if turned <= NEAR_TURN or not abs(fit.ratio - 1) <= 2e-6 * MAX_PPM:
                break
            clock, offset = self._near(fit.ratio), fit.offset_samples
        explained = float(fit.gain**2 * (self._known @ self._known))
        residual_db = 10 * math.log10((max(fit.left, 0.0) + 1e-300) / (explained + 1e-300))
        return replace(fit, offset_samples=first + fit.offset_samples, residual_db=residual_db), clock

    def _place(self, recorded: NDArray[np.floating], offset: float) -> tuple[Complex64Array, int, float]:
        """Where the whole signal correlates most, looked for near an offset, after spectrum and first sample there."""
        for _ in range(2):  # once more where most of it lies elsewhere
            spectrum, first = self._cut(recorded, offset)
            late = self.search.top(spectrum, self._length) - GUARD_SAMPLES
            late -= self._length * round(late / self._length)
            offset = first + GUARD_SAMPLES + late
            if abs(late) < GUARD_SAMPLES:
                break
        return spectrum, first, offset

    def _checked(self, recorded: NDArray[np.floating], name: str) -> NDArray[np.floating]:
        if recorded.ndim != 1:
            raise InputError(f"{name} has the shape {recorded.shape}; allowed is one axis")
        if not np.isfinite(recorded).all():
            raise InputError(f"{name} holds values that are not finite; allowed are volts")
        if not recorded.any():
            raise ReferenceMissingError(f"{name} is silent", "silence")
        shortest = math.floor((1 - 1e-6 * MAX_PPM) * self._known.size) - 1
        if recorded.size < shortest:
            raise ReferenceMissingError(f"{name} has {recorded.size} samples of {self._known.size}", "cut")
        return recorded

    def _cut(self, recorded: NDArray[np.floating], offset: float) -> tuple[Complex64Array, int]:
        """Spectrum of the part of the recording around the signal, zeros beyond its ends, and where it starts."""
        first = math.floor(offset) - GUARD_SAMPLES
        cut = np.zeros(self._length, np.float32)
        low, high = max(first, 0), min(first + self._length, recorded.size)
        if high > low:
            cut[low - first : high - first] = recorded[low:high]
        return scipy.fft.rfft(cut), first


def missing_reference(
    recorded: NDArray[np.floating], known_v: Float64Array, highest: float, name: str, found: str
) -> ReferenceMissingError:
    """Find out why a reference does not carry the known signal: noise, another rate, silence, or another signal.

    The beginning of the signal is fitted as it is, a little faster and slower, and as interfaces at other rates than
    asked for (`RATES_HZ`) would play it; the fit counts whose signal has the largest share of the recording's energy.

    recorded, float (samples,): The reference channel in volts.
    known_v, float64 (known,): What was played, in volts.
    highest: Upper end of the signal's band in cycles per sample.
    name: Of the recording, for the message.
    found: What was found wrong, for the message.
    """
    steady = recorded - np.mean(recorded, dtype=np.float64)
    rms_v = float(np.sqrt(np.mean(np.square(steady))))
    expected_v = float(np.sqrt(np.sum(np.square(known_v)) / max(steady.size, known_v.size)))
    missing, level = f"{name} does not carry what was played", f"{1e3 * rms_v:.2g} mV rms"
    if rms_v < SILENT * expected_v:
        return ReferenceMissingError(f"{missing}; it is silent, {level}", "silence")
    # A fit reaches as far as MAX_PPM either way. Of pairs with the same ratio that of the usual rates stays.
    tried = {1 + turn * 2e-6 * MAX_PPM: "" for turn in (0, -1, 1)}
    for is_hz, asked_hz in reversed(list(itertools.permutations(RATES_HZ, 2))):
        tried[asked_hz / is_hz] = f", as {is_hz} Hz where {asked_hz} Hz are asked for"
    # So many samples that twice the highest frequency of what plays fastest is still there.
    thinning = max(1, int(0.9 * min(tried) / (2 * highest)))
    padded = np.pad(steady, (0, -steady.size % thinning))
    thinned = np.asarray(scipy.fft.irfft(scipy.fft.rfft(padded), padded.size // thinning))
    # Of a slower signal the end was not recorded.
    longest = min(thinned.size, LONGEST_SAMPLES)
    spectrum = scipy.fft.rfft(known_v)
    share, ratio, as_if = 0.0, 1.0, ""
    for wanted, words in tried.items() if longest >= SHORTEST_SAMPLES else ():
        samples = round(known_v.size * wanted / thinning)
        fit = ClockFitter(scipy.fft.irfft(spectrum, samples)[:longest]).best(thinned)
        # Of the energy where it lies; slow drifts, which look like what coupling capacitors leave out, are not its own.
        own = 1 / (1 + 10 ** (fit.residual_db / 10))
        if own > share:
            share, ratio, as_if = own, thinning * samples / known_v.size * fit.ratio, words
    # Less is a guess: lost samples, too, look like a stretch.
    if share > 1 - REFERENCE_LIMIT and abs(ratio - 1) > 1e-6 * MAX_PPM:
        return other_rate(name, ratio, as_if)
    if share > CARRIED:
        return ReferenceMissingError(f"{missing} clearly enough ({found})", "noise")
    return ReferenceMissingError(f"{missing} but another signal, {level} ({found})", "other")


def other_rate(name: str, ratio: float, as_if: str = "") -> ReferenceMissingError:
    """A recording carries the known signal at another rate: DAQ rate over playback rate, and what that looks like."""
    faster = f"the player's clock runs {1 / ratio:.5f} times as fast as asked{as_if}"
    skew = f"clock skew {1e6 * (ratio - 1):.0f} ppm, allowed {MAX_PPM:g} ppm"
    return ReferenceMissingError(f"{name} carries what was played at another rate: {faster} ({skew})", "rate")
