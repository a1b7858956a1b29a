"""Clocks: where a known signal lies in a recording, and the recording on the clock that played it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from calibration.clock.known_signal import BlockSearch, StretchedModels, resampled
from storage.errors import InputError, WavefocusError

# Reference not explained by the known signal, above which a fit would be a guess.
REFERENCE_LIMIT_DB = -10.0
# Gauss-Newton steps at most.
MOST_STEPS = 10
# Corners of coupling capacitors allowed for, as shares of the lowest frequency played.
CORNERS = (0.1, 0.3, 1.0)
# Share of the known signal's energy that may lie outside the bins that are looked at.
BAND_SHARE = 1e-9
# Silence around the known signal that the fit may look at, for a first guess that is off and for tails.
GUARD_SAMPLES = 64
# Spacing of the clock ratios for which models are made, for the first step and for the others, in ppm.
COARSE_PPM, FINE_PPM = 20.0, 1.0


class ReferenceMissingError(WavefocusError):
    """The reference channel does not hold the whole known signal, clearly enough to fit the clock."""


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Sample k of the known signal appears at DAQ sample ``offset_samples + k * ratio``.

    offset_samples: DAQ sample at which the known signal starts.
    ratio: DAQ rate over playback rate in true time: 1 plus or minus tens of ppm.
    gain: Recorded volts per volt of the known signal; negative when the wires are crossed.
    residual_db: Energy of the reference that the known signal, through coupling capacitors or not, leaves unexplained
        over that which it explains.
    """

    offset_samples: float
    ratio: float
    gain: float
    residual_db: float

    @property
    def skew_ppm(self) -> float:
        """How much faster the DAQ clock runs than the playback clock, in parts per million."""
        return 1e6 * (self.ratio - 1)


class ClockFitter:
    """Finds offset, clock ratio and gain of one known signal in recordings of the reference channel.

    Blocks of the known signal are first found by cross-correlation, envelopes added without phase, so that
    neither repeats nor a drift over the record can mislead it; then Gauss-Newton on the spectrum, in the bins
    where the known signal has energy. What depends on the known signal alone is computed once. Safe to
    share between threads; a result depends on its recording alone.

    known_v, (known,): What was played in volts, on the playback clock, its silences included; known <= samples.
    max_ppm: Largest skew of the clocks looked for, in parts per million, > 0.

    Raises InputError: an array of a wrong shape, values that are not finite, or all zeros.
    """

    def __init__(self, known_v: ArrayLike, *, max_ppm: float = 500.0) -> None:
        known = np.asarray(known_v, dtype=np.float64)
        if known.ndim != 1 or known.size < 2:
            raise InputError(f"the known signal has the shape {known.shape}; allowed is one axis, 2 or more")
        if not np.isfinite(known).all():
            raise InputError("the known signal holds values that are not finite; allowed are volts")
        if not known.any():
            raise InputError("the known signal is all zeros; allowed is a signal with energy")
        self._known = known
        self._energy = float(known @ known)
        self._max_ppm = max_ppm
        stretch = math.ceil(1e-6 * max_ppm * known.size)
        self._length = scipy.fft.next_fast_len(known.size + stretch + 2 * GUARD_SAMPLES, real=True)
        spectrum = scipy.fft.rfft(known, self._length)
        below = np.cumsum(np.abs(spectrum) ** 2)
        first = max(int(np.searchsorted(below, BAND_SHARE * below[-1])), 1)
        last = max(int(np.searchsorted(below, (1 - BAND_SHARE) * below[-1])), first)
        # Half the sample rate is left out: a delay by a fraction of a sample is not defined there.
        self._bins = slice(first, min(last + 1, (self._length + 1) // 2))
        lowest = max(int(np.searchsorted(below, 0.01 * below[-1])), 1)
        corners = [share * 2 * np.pi * lowest / self._length for share in CORNERS]
        self._models = StretchedModels(known, self._length, self._bins, corners)
        band = (first / self._length, self._bins.stop / self._length)
        self._search = BlockSearch(known, band, max_ppm)

    def fit(self, recorded_v: ArrayLike) -> ClockFit:
        """Find the known signal in one recording.

        recorded_v, (samples,): Reference channel in volts, on the DAQ clock.

        Raises InputError: an array of a wrong shape or values that are not finite. ReferenceMissingError: the signal is
        absent, too noisy, or not entirely inside the recording.
        """
        recorded = np.asarray(recorded_v)
        if recorded.ndim != 1:
            raise InputError(f"the reference has the shape {recorded.shape}; allowed is one axis")
        if not np.isfinite(recorded).all():
            raise InputError("the reference holds values that are not finite; allowed are volts")
        if not recorded.any():
            raise ReferenceMissingError("the reference channel is silent; check the loopback cable and its channel")
        offset, ratio = self._search.first_guess(recorded)
        cut, first = self._cut(recorded, offset)
        spectrum = scipy.fft.rfft(cut)[self._bins]
        step_ppm, gain = COARSE_PPM, 0.0
        for _ in range(MOST_STEPS):
            model = self._models.at(step_ppm * round(1e6 * (ratio - 1) / step_ppm))
            pairs = (spectrum * self._advance(offset - first)).view(np.float64)
            factors = model.solve @ pairs
            gain = factors[0] / model.ratio
            if gain == 0:
                break
            late, moved = factors[1] / factors[0], model.ratio + factors[2] / factors[0] - ratio
            offset, ratio = offset + late, ratio + moved
            if abs(ratio - 1) > 2e-6 * self._max_ppm:
                break
            if step_ppm == FINE_PPM and abs(late) + self._known.size * abs(moved) < 1e-7:
                break
            step_ppm = FINE_PPM
        in_band = np.square(pairs - factors @ model.regressors).sum() - pairs @ pairs
        # A constant voltage is the DAQ's own affair.
        left = (2 * in_band - cut.sum() ** 2) / self._length + cut @ cut
        explained = float(gain**2 * self._energy)
        residual_db = 10 * math.log10((max(float(left), 0.0) + 1e-300) / (explained + 1e-300))
        if not residual_db <= REFERENCE_LIMIT_DB or abs(ratio - 1) > 1.01e-6 * self._max_ppm:
            raise ReferenceMissingError(
                f"the reference channel does not carry the known signal (unexplained {residual_db:.1f} dB, "
                f"allowed {REFERENCE_LIMIT_DB:g} dB; clock skew {1e6 * (ratio - 1):.1f} ppm, allowed "
                f"{self._max_ppm:g} ppm); check the loopback"
            )
        check_inside(offset, ratio, self._known.size, recorded.size, "the reference")
        return ClockFit(float(offset), float(ratio), float(gain), float(residual_db))

    def _cut(self, recorded: NDArray[np.floating], offset: float) -> tuple[NDArray[np.float64], int]:
        """The part of the recording around the signal, zeros beyond its ends, and where it starts."""
        first = math.floor(offset) - GUARD_SAMPLES
        cut = np.zeros(self._length)
        low, high = max(first, 0), min(first + self._length, recorded.size)
        if high > low:
            cut[low - first : high - first] = recorded[low:high]
        return cut, first

    def _advance(self, samples: float) -> NDArray[np.complex128]:
        """The factor in each bin that undoes a delay, from two short exponentials."""
        bins = self._bins.stop - self._bins.start
        row = math.isqrt(bins) + 1
        turn = 2j * np.pi * samples / self._length
        coarse = np.exp(turn * (self._bins.start + row * np.arange(-(-bins // row))))
        return np.outer(coarse, np.exp(turn * np.arange(row))).ravel()[:bins]


def fit_clock(recorded_v: ArrayLike, known_v: ArrayLike, *, max_ppm: float = 500.0) -> ClockFit:
    """Find a known signal in one recording; for many recordings of one signal see `ClockFitter`.

    recorded_v, (samples,): Reference channel in volts, on the DAQ clock.
    known_v, (known,): What was played in volts, on the playback clock, its silences included; known <= samples.
    max_ppm: Largest skew of the clocks looked for, in parts per million, > 0.

    Raises InputError, ReferenceMissingError: as `ClockFitter` and its `fit`.
    """
    return ClockFitter(known_v, max_ppm=max_ppm).fit(recorded_v)


def to_playback_clock(
    recorded: ArrayLike, fit: ClockFit, samples: int, first: int = 0, delay_samples: float = 0.0
) -> NDArray[np.float32] | NDArray[np.float64]:
    """Resample recordings to the clock that played the drive, band-limited.

    ``out[..., k]`` is the recording at DAQ sample ``offset + (first + k) * ratio + delay_samples``; beyond
    its ends a recording is taken as 0. Kaiser-windowed sinc of 40 samples: errors below -100 dB up to 0.8
    of half the sample rate.

    recorded, (..., recorded): Recordings on the DAQ clock; float32 stays float32, all else becomes float64.
    fit: Offset and ratio of the clocks.
    samples: Number of output samples, >= 0.
    first: Playback sample of the first output sample.
    delay_samples: Added to every DAQ position: ``-inter_channel_delay_s * sample_rate_hz`` for a channel that is
        sampled that much later than the reference.

    Returns float32 or float64 (..., samples). Raises InputError: `samples` below 0, or a fit that is not finite.
    """
    recorded = np.asarray(recorded)
    start = fit.offset_samples + first * fit.ratio + delay_samples
    if samples < 0 or not np.isfinite(start) or not np.isfinite(fit.ratio):
        raise InputError(
            f"resampling to {samples} samples from DAQ sample {start:g}; "
            "allowed is 0 or more samples and a finite offset"
        )
    rows = recorded.reshape(-1, recorded.shape[-1])
    if rows.dtype == np.float32:
        single = resampled(rows.astype(np.float32, copy=False), start, fit.ratio, samples)
        return single.reshape(*recorded.shape[:-1], samples)
    double = resampled(rows.astype(np.float64, copy=False), start, fit.ratio, samples)
    return double.reshape(*recorded.shape[:-1], samples)


def check_inside(offset: float, ratio: float, known: int, recorded: int, what: str) -> None:
    """Refuse a fit whose signal reaches beyond the ends of the record.

    offset, ratio: Where the known signal lies, as in `ClockFit`.
    known, recorded: Samples of the known signal and of the recording.
    what: Name of the recording for the message.

    Raises ReferenceMissingError: more than half a sample of the signal lies outside.
    """
    last = offset + (known - 1) * ratio
    if offset < -0.5 or last > recorded - 0.5:
        raise ReferenceMissingError(
            f"{what} holds only a part of the signal, which spans samples {offset:.1f} to {last:.1f} of "
            f"{recorded}; make pre-roll and post-roll longer"
        )
