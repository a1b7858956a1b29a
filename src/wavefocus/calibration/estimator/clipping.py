"""What clipping leaves: flat tops, and harmonics at the loudest moment."""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.calibration import Float32Array, Int64Array
from wavefocus.storage.errors import InputError

# Gain errors of converters: 0.04 to 0.2 % of the range (MCC USB-1608FS, USB-1208FS).
CLIP_SHARE = 0.999
# A flat top: this many samples within 0.1 % of the recording's own peak, and a quarter of all within 3 %.
# A sine has 18 % of them there, noise and sweeps over resonances 5 %.
MIN_FLAT = 8
# Where a sweep is cut off, it is cut off many times running: this much on both sides of the peak shows it.
AROUND_SAMPLES = 4096
BELOW_SHARE = 0.97
# With fewer converter steps up to a recording's peak, the top 0.1 % are half a step, and every top is flat.
MIN_STEPS = 0.5 / (1 - CLIP_SHARE)


@dataclass(frozen=True, slots=True)
class Levels:
    """Peaks of records, and what of them is clipped.

    reference_v, response_v, float32 (records,): Largest magnitudes in volts.
    loudest, int64 (records,): Sample of the response's.
    clip_count, int32 (records,): Clipped samples of both channels.
    """

    reference_v: Float32Array
    response_v: Float32Array
    loudest: Int64Array
    clip_count: NDArray[np.int32]


def measure_levels(
    reference_v: Float32Array, response_v: Float32Array, range_v: tuple[float, float], name: str = "a recording"
) -> Levels:
    """Measure records (records, samples) on converters that end at `range_v` on (reference, response).

    Raises InputError: values that are not finite.
    """
    (reference_peak, reference_place), (peak, place) = _peaks(reference_v), _peaks(response_v)
    if not (np.isfinite(reference_peak).all() and np.isfinite(peak).all()):
        raise InputError(f"{name} holds values that are not finite; allowed are volts")
    clipped = _count_clipped(reference_v, reference_peak, reference_place, range_v[0])
    return Levels(reference_peak, peak, place, clipped + _count_clipped(response_v, peak, place, range_v[1]))


def _peaks(channel: Float32Array) -> tuple[Float32Array, Int64Array]:
    rows = np.arange(channel.shape[0])
    highest = np.array([recording.argmax() for recording in channel])
    lowest = np.array([recording.argmin() for recording in channel])
    up, down = channel[rows, highest], -channel[rows, lowest]
    return np.maximum(up, down), np.where(up >= down, highest, lowest)


def _count_clipped(channel: Float32Array, peak_v: Float32Array, place: Int64Array, range_v: float) -> NDArray[np.int32]:
    """Count samples at 0.999 of the range or beyond, or else those of a flat top below it.

    A flat top blurred by noise that was added after it is not seen; the fit's residual shows it then.
    """
    count = np.zeros(channel.shape[0], dtype=np.int32)
    for record, peak in enumerate(peak_v):
        level = range_v
        if peak < CLIP_SHARE * range_v:
            level = float(peak)
            around = channel[record, max(0, place[record] - AROUND_SAMPLES) : place[record] + AROUND_SAMPLES]
            top = _beyond(around, CLIP_SHARE * level)
            if top < MIN_FLAT or 4 * top <= _beyond(around, BELOW_SHARE * level):
                continue
            if converter_steps(around) < MIN_STEPS:
                continue
        count[record] = _beyond(channel[record], CLIP_SHARE * level)
    return count


def converter_steps(recording: Float32Array) -> float:
    """How many steps of its converter a recording in volts reaches; 0 for silence, infinite where it has no steps."""
    levels = np.unique(recording)
    if levels.size < 2:
        return 0.0
    return float(np.abs(levels).max() / np.diff(levels).min())


def _beyond(recording: Float32Array, level_v: float) -> int:
    """Samples of this magnitude or more; two comparisons cost a fifth of one array of magnitudes."""
    level = np.float32(level_v)
    return int(np.count_nonzero(recording >= level) + np.count_nonzero(recording <= -level))


# Long enough for a few periods, short enough for a sweep to stay on one frequency.
WINDOW_S = 0.0256
# In bins of the window: below, the fundamental's skirt reaches the third harmonic.
MIN_BIN = 3
# The harmonic must stand this far above the noise, which is taken from the upper half of the spectrum.
OVER_FLOOR = 10.0
# Between these a second look decides.
UNSURE_DB = -72.0
SURE_DB = -36.0
FLOOR = 1e-30


class ThirdHarmonic:
    """Level of the third harmonic around a recording's loudest moment.

    A peak cut off at 0.95 of its height has it at -38 dB, at 0.9 at -30 dB; in-band figures hardly see that, for
    a response of L taps can be bent to explain a resonance that is a little too low.

    sample_rate_hz: Rate in Hz, > 0.
    period: Samples of a sweep with its silence; in the next one the same is as loud again.
    """

    def __init__(self, sample_rate_hz: float, period: int) -> None:
        self._period = period
        self._length = 1 << max(5, round(np.log2(WINDOW_S * sample_rate_hz)))
        self._window = np.hanning(self._length + 1)[:-1].astype(np.float32)

    def __call__(self, response_v: Float32Array, loudest: Int64Array, which: Int64Array) -> Float32Array:
        """Look at a batch of recordings.

        response_v, float32 (records, samples): Recordings in volts.
        loudest, int64 (records,): Sample of their largest magnitude.
        which, int64 (looked at,): The recordings to look at.

        Returns float32 (looked at,): in dB of the fundamental; -inf where it does not stand out from the noise, NaN
        where the fundamental is too low to measure or its third harmonic too high to be sampled.
        """
        samples, length = response_v.shape[1], self._length
        if samples < length or not which.size:
            return np.full(which.size, np.nan, np.float32)
        figure = self._level(response_v, which, loudest[which])
        # The first sample of a cut stretch is as large as all others, and its window half before it.
        after = np.minimum(loudest[which, None] + np.arange(2 * length), samples - 1)
        level_v = np.abs(response_v[which, loudest[which]])[:, None]
        flat = np.count_nonzero(np.abs(response_v[which[:, None], after]) >= np.float32(CLIP_SHARE) * level_v, axis=1)
        unsure = np.flatnonzero(((figure > UNSURE_DB) | (flat >= MIN_FLAT)) & ~(figure > SURE_DB))
        middle = np.array(
            [self._middle(response_v[which[record]], int(loudest[which[record]])) for record in unsure], int
        )
        if unsure.size:
            figure[unsure] = np.fmax(figure[unsure], self._level(response_v, which[unsure], middle))
        return figure

    def _level(self, response_v: Float32Array, which: Int64Array, centre: Int64Array) -> Float32Array:
        length = self._length
        first = np.clip(centre - length // 2, 0, response_v.shape[1] - length)
        pieces = response_v[which[:, None], first[:, None] + np.arange(length)]
        spectra = scipy.fft.rfft(pieces * self._window, axis=1)
        power = np.square(spectra.real) + np.square(spectra.imag)
        rows = np.arange(which.size)
        fundamental = power[:, 1:].argmax(axis=1) + 1
        audible = (fundamental >= MIN_BIN) & (3 * fundamental + 2 <= length // 2)
        fundamental = np.where(audible, fundamental, MIN_BIN)
        near = np.arange(-1, 2)
        whole = power[rows[:, None], fundamental[:, None] + near].sum(axis=1)
        level = power[rows[:, None], 3 * fundamental[:, None] + near].sum(axis=1)
        noise = np.partition(power[:, length // 4 :], length // 8, axis=1)[:, length // 8]
        stands_out = level > 3 * OVER_FLOOR * noise
        figure = np.where(stands_out, 10 * np.log10(np.maximum(level, FLOOR) / np.maximum(whole, FLOOR)), -np.inf)
        return np.where(audible, figure, np.nan).astype(np.float32)

    def _middle(self, recording: Float32Array, loudest: int) -> int:
        """The middle of the stretch that is nearly as loud as the loudest sample."""
        around = slice(max(0, loudest - self._period // 2), loudest + self._period // 2)
        high = np.flatnonzero(np.abs(recording[around]) >= np.float32(BELOW_SHARE) * np.abs(recording[loudest]))
        return around.start + int(high[high.size // 2])
