"""The base signal of staggered records and its clock, from their reference channels alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import require_coverage, ring_spectrum
from calibration.clock.known_signal import Thinned, Thinning, resampled
from calibration.clock.periodic_clock import RepeatFit, RingClock, RingFit, fit_repeats
from calibration.clock.sweep_laws import fit_sweep_law, roundest
from calibration.estimator.estimate import MAX_PPM
from storage.errors import InputError
from storage.raw.header import LAWS, Law

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# A clock fitted to the signal's own repeats must be as sure as this; 1 ppm would cost 1 dB at -63 dB.
SURE_PPM = 0.3
REPEATING = 0.03
# A record of which this share is explained by another one holds the same signal.
SAME_SHARE = 0.9
# Records cut at places at least this share of a period apart are compared, so many at most, within this of a
# sweep's clock, or at these steps over all ratios.
LEAST_CUT = 0.02
MOST_CUTS = 6
CUT_REACH_PPM = 30.0
SCAN_PPM = 20.0
# A sweep sounds beyond its band by about so many times the root of its rate in Hz per second.
BEYOND_BAND = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class BaseSignal:
    """One period of what the reference channels carry.

    base_v, float64 (period,): In DAQ volts, on the playback clock; its beginning is arbitrary.
    ratio: DAQ rate over playback rate of the first record.
    """

    base_v: Float64Array
    ratio: float


def highest_cycles(band_hz: tuple[float, float], sweep_s: float, sample_rate_hz: float) -> float:
    """Upper end of what a sweep through a band has to say, in cycles per sample."""
    beyond_hz = BEYOND_BAND * math.sqrt((band_hz[1] - band_hz[0]) / sweep_s)
    return min((band_hz[1] + beyond_hz) / sample_rate_hz, 0.499)


def learn_base(
    references: Sequence[Float32Array],
    period: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    sweep_s: float | None = None,
    *,
    laws: Sequence[Law] = LAWS,
    same_clock: bool = False,
) -> BaseSignal:
    """Find the base signal of periodic records as the mean of several, put on one clock.

    The clocks' ratio comes from the signal's own repeats where a record is longer than a period, else from a
    sweep through the band.

    references, sequence of float32 (samples,): Reference channels in volts; more of them give a cleaner base signal.
    period: Period in playback samples.
    sample_rate_hz: Rate in Hz.
    band_hz: Band of the base signal in Hz.
    sweep_s: Length of the sweep in a period in seconds, if it is not all of it.
    laws: Laws of sweeps that are looked for.
    same_clock: Whether one clock played and recorded, so that its ratio is 1 and any base signal will do.

    Returns BaseSignal. Raises InputError: less than one period, silence, or nothing that shows the clocks' ratio.
    """
    bins = math.ceil(highest_cycles(band_hz, sweep_s or period / sample_rate_hz, sample_rate_hz) * period)
    bins = min(bins, (period + 1) // 2)
    thinning = Thinning(bins / period)
    seen = [_Seen(reference, thinning, period) for reference in references if np.any(reference)]
    if not seen:
        raise InputError("the reference channel is silent; a base signal is needed")
    require_coverage(seen[0].samples, period * (1 - 1e-6 * MAX_PPM), bins / period, "the reference")
    if same_clock:
        return _same_clock_base(seen, bins, period)
    # Fitted to its own repeats each record is as good as any; those of one clock are then averaged.
    own = [record.repeats for record in seen]
    sure = [fit is not None and fit.sigma_ppm < SURE_PPM and fit.misfit < REPEATING for fit in own]
    start = next((index for index, is_sure in enumerate(sure) if is_sure), 0)
    fit = own[start]
    if fit is not None and sure[start]:
        ratio = fit.ratio
    else:
        ratio = _ratio_of_cuts(seen, bins, _ratio_of_sweep(seen[0], period, sample_rate_hz, band_hz, sweep_s, laws))
    spectrum = seen[start].spectrum(bins, ratio)
    clock = RingClock(spectrum, period, MAX_PPM)
    fits = [clock.fit(record.thinned, thinning, ratio) for record in seen]
    same = [fit.explained > SAME_SHARE for fit in fits]
    wrong = [
        (fit.ratio / match.ratio - 1, fit.sigma_ppm)
        for fit, match, is_sure, is_same in zip(own, fits, sure, same, strict=True)
        if fit is not None and is_sure and is_same
    ]
    stretch = 1.0
    if wrong:
        weights = np.array([1 / sigma**2 for _, sigma in wrong])
        stretch = 1 + float(np.average([off for off, _ in wrong], weights=weights))
    total, level = np.zeros(bins, dtype=np.complex128), 0.0
    for record, match, is_same in zip(seen, fits, same, strict=True):
        if not is_same:
            continue
        ratio = match.ratio * stretch
        turned = np.exp(2j * np.pi / period * np.arange(bins) * match.offset_samples / match.ratio)
        total += match.gain * record.spectrum(bins, ratio) * turned
        level += match.gain**2
    mean = total / level
    return BaseSignal(scipy.fft.irfft(mean, period), fits[0].ratio * stretch)


def _same_clock_base(seen: Sequence[_Seen], bins: int, period: int) -> BaseSignal:
    """The first record's period, at the clock ratio 1."""
    return BaseSignal(scipy.fft.irfft(seen[0].spectrum(bins, 1.0), period), 1.0)


class _Seen:
    """A reference recording, thinned, and what it says of the clocks by itself."""

    def __init__(self, reference: Float32Array, thinning: Thinning, period: int) -> None:
        self.samples = reference.size
        self.thinned: Thinned = thinning(np.ascontiguousarray(reference[None], dtype=np.float32))
        self.repeats: RepeatFit | None = fit_repeats(self.thinned, thinning, period, reference.size, MAX_PPM)
        self.thinning, self.period = thinning, period

    def spectrum(self, bins: int, ratio: float) -> Complex128Array:
        """Transform of one period, at a clock ratio, beginning with the record."""
        turn = 2 * np.pi / (self.period * ratio)
        sums = self.thinning.spectrum(self.thinned, turn, 0, bins)
        found = ring_spectrum(sums, turn, self.samples)[0] * (self.period / 2)
        found[0] *= 2
        return np.asarray(found)


def _ratio_of_cuts(seen: Sequence[_Seen], bins: int, guess: float | None) -> float:
    """Clock ratio of records that are hardly longer than a period, but cut from it at different places.

    Where one record begins and ends, another one runs on: only at the true ratio do they agree.
    """
    first, *others = seen[:MOST_CUTS]

    def fits(ratio: float, some: Sequence[_Seen]) -> list[RingFit]:
        clock = RingClock(first.spectrum(bins, ratio), first.period, MAX_PPM)
        return [clock.fit(record.thinned, first.thinning, ratio, search=False) for record in some]

    def misfit(ratio: float, some: Sequence[_Seen]) -> float:
        return -sum(fit.explained for fit in fits(ratio, some))

    reach = CUT_REACH_PPM
    if guess is None and others:
        tried = 1 + 1e-6 * SCAN_PPM * np.arange(-round(MAX_PPM / SCAN_PPM), round(MAX_PPM / SCAN_PPM) + 1)
        guess, reach = float(tried[int(np.argmin([misfit(one, others[:2]) for one in tried]))]), SCAN_PPM
    if guess is not None:
        offsets = np.array([fit.offset_samples for fit in fits(guess, others)])
        if np.any(np.abs(offsets) > LEAST_CUT * first.period):
            import scipy.optimize  # slow to load; most records are cut alike and need no search

            ends = guess - 1e-6 * reach, guess + 1e-6 * reach
            best = scipy.optimize.minimize_scalar(
                lambda one: misfit(float(one), others), bounds=ends, method="bounded", options={"xatol": 1e-8}
            )
            return float(best.x)
        if reach == CUT_REACH_PPM:
            return guess
    raise InputError(
        "the reference shows no clock ratio: its records are hardly longer than a period, cut at the same place, and "
        "hold no sweep through band_hz; record at least 1.05 periods"
    )


def _ratio_of_sweep(
    record: _Seen,
    period: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    sweep_s: float | None,
    laws: Sequence[Law],
) -> float | None:
    """Clock ratio of a record that hardly repeats, if it holds a sweep; a full period is tried where not said."""
    sweep_samples = period if sweep_s is None else min(round(sweep_s * sample_rate_hz), period)
    fit = fit_sweep_law(
        record.thinned, record.thinning, sample_rate_hz, band_hz, sweep_samples, [0], MAX_PPM, period=period, laws=laws
    )
    return None if fit is None else fit.ratio


# Taken where nothing says how long a sweep is.
SHORTEST_SWEEP_S = 0.05
# A record whose autocorrelation reaches this share at some lag holds repeats.
REPEAT_SHARE = 0.4
# Share of the energy outside a sweep's beginning and end.
END_ENERGY = 1e-4
# What counts as silence: energy of the quietest part of a period, times this, and this share of the period's.
QUIET_FACTOR = 1.5
QUIET_SHARE = 1e-7
# Rather taken too long by this, for what sounds must not pass for silence.
MARGIN_SHARE = 0.03


@dataclass(frozen=True, slots=True)
class RecordShape:
    """How the sweeps of a sequential record follow each other on the playback clock.

    sweep_samples: Length of one sweep.
    period_samples: Length of a sweep and its silence.
    averages: Number of sweeps.
    """

    sweep_samples: int
    period_samples: int
    averages: int


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSweeps:
    """The sweeps of a sequential record as its reference channel carried them: `calibration.sweeps.Sweeps`.

    base, float64 (period,): One sweep and its silence in DAQ volts, on the playback clock.
    sample_rate_hz: Rate in Hz.
    start_hz, stop_hz: Lowest and highest frequency in Hz.
    decay_samples: Samples of silence after each sweep.
    averages: Number of sweeps in a record.
    """

    base: Float64Array
    sample_rate_hz: float
    start_hz: float
    stop_hz: float
    decay_samples: int
    averages: int

    @property
    def decay_s(self) -> float:
        """Silence after each sweep in seconds."""
        return self.decay_samples / self.sample_rate_hz

    def base_v(self) -> Float64Array:
        """One sweep and its silence in volts, shape (period,)."""
        return self.base


@dataclass(frozen=True, slots=True)
class FoundSweeps:
    """The sweeps of a sequential record, found in its reference channel.

    shape: How they follow each other.
    offset: DAQ sample at which the first one begins; about, unless a law was found.
    ratio: DAQ rate over playback rate.
    law: Their law; empty where the clocks' ratio comes from the repeats.
    highest: Upper end of the band in cycles per sample.
    """

    shape: RecordShape
    offset: float
    ratio: float
    law: str
    highest: float


def find_sweeps(
    reference: Float32Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    taps: int,
    shape: RecordShape | None,
    *,
    sweep_samples: int | None = None,
    laws: Sequence[Law] = LAWS,
) -> FoundSweeps:
    """Find the sweeps of a sequential record.

    reference, float32 (samples,): Reference channel in volts.
    sample_rate_hz: Rate in Hz.
    band_hz: Band of the sweeps in Hz.
    taps: Length of the responses, which the silence must hold.
    shape: How the sweeps follow each other; without it, it is found, and durations are taken to be round.
    sweep_samples: Length of one sweep, where that alone is given.
    laws: Laws of sweeps that are looked for.

    Returns FoundSweeps. Raises InputError: silence, or nothing that shows the clocks' ratio.
    """
    if not np.any(reference):
        raise InputError("the reference channel is silent; the sweeps are needed")
    rows = np.ascontiguousarray(reference[None], dtype=np.float32)
    shortest_s = SHORTEST_SWEEP_S if shape is None else shape.sweep_samples / sample_rate_hz
    highest = highest_cycles(band_hz, shortest_s, sample_rate_hz)
    thinning = Thinning(highest)
    thinned = thinning(rows)
    shapes = [_Tried(shape, None if shape is None else shape.sweep_samples)]
    if shape is None:
        shapes = _shapes(thinned, thinning, sample_rate_hz, taps, sweep_samples)
    for tried in shapes:
        found = _clock(rows, thinned, thinning, sample_rate_hz, band_hz, tried, taps, laws)
        if found is not None:
            return found
    more = "state averages, sweep_s and decay_s" if shape is None else "check averages, sweep_s, decay_s and band_hz"
    raise InputError(
        "the reference shows no clock ratio: no linear or exponential sweep from one end of band_hz to the other and "
        f"no repeats were found in it; {more}, or same_clock = true where one clock played and recorded"
    )


def learn_sweeps(
    found: FoundSweeps,
    reference: Float32Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    taps: int,
    *,
    exact: bool,
) -> RecordedSweeps:
    """The mean of the sweeps of a record, on the playback clock.

    found, reference, sample_rate_hz, band_hz, taps: What `find_sweeps` found, and what it was found in.
    exact: Whether the silence after a sweep is no longer than the shape says.

    Returns RecordedSweeps.
    """
    shape, ratio = found.shape, found.ratio
    starts = found.offset + ratio * shape.period_samples * np.arange(shape.averages)
    inside = starts[starts + 0.5 * shape.sweep_samples < reference.size]
    row = np.asarray(reference, dtype=np.float64)[None]
    repeats = [resampled(row, start, ratio, shape.period_samples)[0] for start in inside]
    base = _low_passed(np.mean(repeats, axis=0), found.highest)
    decay = shape.period_samples - shape.sweep_samples
    if not found.law:
        base = np.roll(base, -_start(base, decay, exact=exact))
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / found.highest), max(decay - taps, 0) // 2))
    return RecordedSweeps(base, sample_rate_hz, *band_hz, decay, shape.averages)


def whole_record(found: FoundSweeps, reference: Float32Array, samples: int) -> Float64Array:
    """All that the reference channel of a record carried in DAQ volts on the playback clock, `samples` long."""
    row = np.asarray(reference, dtype=np.float64)[None]
    return _low_passed(resampled(row, 0.0, found.ratio, samples)[0], found.highest)


def _low_passed(signal: Float64Array, highest: float) -> Float64Array:
    spectrum = scipy.fft.rfft(signal)
    spectrum[math.ceil(highest * signal.size) :] = 0
    return np.asarray(scipy.fft.irfft(spectrum, signal.size))


def _start(base: Float64Array, decay: int, *, exact: bool) -> int:
    """Where the silence of a period ends; it may last longer than `decay`, unless that is exact."""
    if not 0 < decay < base.size:
        return 0
    energy = np.concatenate([[0.0], np.cumsum(np.square(np.concatenate([base, base[:decay]])))])
    silence = energy[decay:-1] - energy[: -1 - decay]
    quietest = int(np.argmin(silence))
    if exact:
        return quietest + decay
    # The last of the quiet windows in a row from the quietest on.
    quiet = np.roll(silence < QUIET_FACTOR * silence.min() + QUIET_SHARE * energy[base.size], -quietest)
    return quietest + decay + (0 if quiet.all() else int(np.argmin(quiet)) - 1)


def _clock(
    rows: Float32Array,
    thinned: Thinned,
    thinning: Thinning,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    tried: _Tried,
    taps: int,
    laws: Sequence[Law],
) -> FoundSweeps | None:
    samples, shape = rows.shape[1], tried.shape
    if shape is not None and shape.averages > 1:
        # Compared where all of its repeats are, so that what is compared repeats throughout.
        length = min(shape.averages * shape.period_samples, samples)
        energy = np.concatenate([[0.0], np.cumsum(np.square(rows[0], dtype=np.float64))])
        within = energy[length:] - energy[:-length]
        last = int(np.flatnonzero(within > (1 - END_ENERGY) * within.max())[-1])
        first = max(last - (shape.period_samples - shape.sweep_samples) // 4, 0)
        cut = thinning(np.ascontiguousarray(rows[:, first : first + length]))
        fit = fit_repeats(cut, thinning, shape.period_samples, length, MAX_PPM)
        if fit is not None and fit.sigma_ppm < SURE_PPM and fit.misfit < REPEATING:
            return FoundSweeps(shape, float(first), fit.ratio, "", thinning.highest)
    starts = [0] if shape is None else [repeat * shape.period_samples for repeat in range(shape.averages)]
    law = fit_sweep_law(thinned, thinning, sample_rate_hz, band_hz, tried.sweep_samples, starts, MAX_PPM, laws=laws)
    if law is None:
        return None
    sweep = law.sweep_samples
    period = sweep + taps if shape is None else shape.period_samples
    averages = 1 if shape is None else shape.averages
    return FoundSweeps(
        RecordShape(sweep, period, averages), float(law.offset_samples), float(law.ratio), law.law, thinning.highest
    )


@dataclass(frozen=True, slots=True)
class _Tried:
    """A shape that a record may have, None for one sweep; the length of a sweep, where that is given."""

    shape: RecordShape | None
    sweep_samples: int | None


def _shapes(
    thinned: Thinned, thinning: Thinning, sample_rate_hz: float, taps: int, sweep_samples: int | None
) -> list[_Tried]:
    """Shapes that a record may have, by its energy and its repeats."""
    values = thinned.values[0].astype(np.float64)
    length = scipy.fft.next_fast_len(2 * values.size, real=True)
    correlation = scipy.fft.irfft(np.abs(scipy.fft.rfft(values, length)) ** 2, length)[: values.size]
    shortest = math.ceil(taps / thinning.step)
    lag, share = 0, 0.0
    if shortest < values.size:
        lag = shortest + int(np.argmax(correlation[shortest:]))
        share = float(correlation[lag] / correlation[0])
    alone = _Tried(None, sweep_samples)
    if share <= REPEAT_SHARE:
        return [alone]
    energy = np.cumsum(np.square(values))
    ends = np.searchsorted(energy / energy[-1], [END_ENERGY, 1 - END_ENERGY]) * thinning.step
    averages = round(1 / (1 - share))
    period = roundest(lag * thinning.step, sample_rate_hz, thinning.step / (lag * thinning.step))
    sweep = sweep_samples or round((1 + MARGIN_SHARE) * (ends[1] - ends[0] - (averages - 1) * period))
    return [_Tried(RecordShape(min(max(sweep, 1), max(period - taps, 1)), period, averages), sweep_samples), alone]
