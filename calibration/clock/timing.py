"""Clocks: where a known signal lies in a recording, and the recording on the clock that played it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.clock.known_signal_clock import KnownSignalClock
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError, missing_reference
from wavefocus.calibration.clock.resampling import Decimated, decimate, resampled
from wavefocus.storage.errors import InputError

# Reference not explained by the known signal, above which a fit would be a guess.
REFERENCE_LIMIT_DB = -10.0
# Share of the known signal's energy that may lie outside the bins that are looked at.
BAND_SHARE = 1e-9
# Silence around the known signal that the fit looks at, for tails.
GUARD_SAMPLES = 64
# Of recordings that are so many times as long only the part around the signal is fitted.
MAX_MARGIN = 1.25
# Fewer samples are not a recording.
MIN_SAMPLES = 16


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

    The known signal and the silence around it are taken as one period of a `KnownSignalClock`. Safe to share between
    threads; a result depends on its recording only.

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
        self._known, self._max_ppm = known, max_ppm
        # Records of one campaign are equally long, and so are the parts that are cut out of them.
        self._clock = lru_cache(maxsize=2)(self._clock_for)

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
            raise ReferenceMissingError("the reference channel is silent", "silence")
        shortest = math.floor((1 - 1e-6 * self._max_ppm) * self._known.size) - 1
        if recorded.size < max(shortest, MIN_SAMPLES):
            raise ReferenceMissingError(f"the reference has {recorded.size} samples of {self._known.size}", "cut")
        first, length = 0, self._known.size + 2 * (math.ceil(1e-6 * self._max_ppm * self._known.size) + GUARD_SAMPLES)
        part = recorded
        if recorded.size > MAX_MARGIN * length:
            # What is recorded long before and after the signal says nothing about it.
            clock, decimated = self._prepared(recorded)
            middle = self._inside(clock, clock.offset(decimated, 1.0), 1.0) + self._known.size / 2
            first = min(max(math.floor(middle - length / 2), 0), recorded.size - length)
            part = recorded[first : first + length]
        clock, decimated = self._prepared(part)
        fit = clock.fit(decimated)
        explained = float(fit.gain**2 * (self._known @ self._known))
        # What the decimation has taken out is noise.
        beyond = scipy.fft.rfft(part.astype(np.float64))[part.size // (2 * decimated.step) + 1 :]
        left = fit.left + 2 / part.size * float(np.vdot(beyond, beyond).real)
        residual_db = 10 * math.log10((max(left, 0.0) + 1e-300) / (explained + 1e-300))
        if not residual_db <= REFERENCE_LIMIT_DB or abs(fit.ratio - 1) > 1.01e-6 * self._max_ppm:
            found = f"unexplained {residual_db:.1f} dB, allowed {REFERENCE_LIMIT_DB:g} dB"
            name = "the reference channel"
            raise missing_reference(recorded, self._known, name, found, self._max_ppm)
        offset = first + self._inside(clock, fit.offset_samples, fit.ratio)
        check_inside(offset, fit.ratio, self._known.size, recorded.size, "the reference")
        return ClockFit(offset, fit.ratio, fit.gain, residual_db)

    def _prepared(self, recorded: NDArray[np.floating]) -> tuple[KnownSignalClock, Decimated]:
        """The clock for a recording, and the recording in its band, with silence beyond its ends."""
        clock = self._clock(recorded.size)
        decimated = decimate(np.ascontiguousarray(recorded[None], dtype=np.float32), clock.highest)
        return clock, replace(decimated, inside=slice(0, decimated.values.shape[1]))

    def _inside(self, clock: KnownSignalClock, offset: float, ratio: float) -> float:
        """An offset in the recording, of those that are whole periods apart."""
        return offset + (clock.period * ratio if offset < -self._known.size else 0.0)

    def _clock_for(self, recorded: int) -> KnownSignalClock:
        """The clock for records of so many samples: the signal and silence around it are a period."""
        period = scipy.fft.next_fast_len(recorded + self._known.size, real=True)
        spectrum = scipy.fft.rfft(self._known, period)
        below = np.cumsum(np.abs(spectrum) ** 2)
        last = int(np.searchsorted(below, (1 - BAND_SHARE) * below[-1]))
        # Half the sample rate is left out: a delay by a fraction of a sample is not defined there.
        bins = min(max(last, 1) + 1, (period + 1) // 2)
        return KnownSignalClock(spectrum[:bins], period, self._max_ppm, below_share=BAND_SHARE)


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
) -> Float32Array | Float64Array:
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
    if recorded.dtype != np.float32:
        recorded = recorded.astype(np.float64, copy=False)
    found = resampled(recorded.reshape(-1, recorded.shape[-1]), start, fit.ratio, samples)
    return found.reshape(*recorded.shape[:-1], samples)


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
            f"{what} holds only a part of the signal, which spans samples {offset:.1f} to {last:.1f} of {recorded}",
            "cut",
        )
