"""What another program played, and on which clock, from its reference channels: periodic, or sweeps with silence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.clock.known_signal_clock import KnownSignalClock, KnownSignalFit
from wavefocus.calibration.clock.missing_reference import CARRIED, playing_ratio
from wavefocus.calibration.clock.own_repeats import fit_repeats
from wavefocus.calibration.clock.period_spectrum import period_spectrum, require_coverage
from wavefocus.calibration.clock.resampling import Decimated, decimate, resampled
from wavefocus.calibration.clock.sweep_laws import SweepFit, SweepLaw, fit_sweep_law, roundest
from wavefocus.calibration.estimator.estimate import MAX_PPM
from wavefocus.calibration.excitation import RecordedExcitation
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader

# A record of which this share is explained by another one holds the same signal.
SAME_SHARE = 0.9
# Records cut at places at least this share of a period apart are compared, so many at most, within this of a
# sweep's clock, or at these steps over all ratios.
MIN_CUT = 0.02
MAX_CUTS = 6
CUT_REACH_PPM = 30.0
SCAN_PPM = 20.0
# A sweep sounds beyond its band by about so many times the root of its rate in Hz per second.
BEYOND_BAND = 4.0


def highest_cycles(band_hz: tuple[float, float], sweep_s: float, sample_rate_hz: float) -> float:
    """Upper end of what a sweep through a band has to say, in cycles per sample."""
    beyond_hz = BEYOND_BAND * math.sqrt((band_hz[1] - band_hz[0]) / sweep_s)
    return min((band_hz[1] + beyond_hz) / sample_rate_hz, 0.499)


def learn_base(references: Sequence[Float32Array], header: RawHeader) -> tuple[Float64Array, float]:
    """Find the base signal of periodic records as the mean of several, put on one clock.

    The clocks' ratio comes from the signal's own repeats where a record is longer than a period, else from a
    sweep through the band. Where one clock played and recorded, it is 1, and the first record has the signal.

    references, sequence of float32 (samples,): Reference channels in volts; more of them give a cleaner base signal.
    header: Period, rate, band and law of the sweeps.

    Returns base signal : float64 (period,), in DAQ volts on the playback clock, its beginning arbitrary; DAQ rate over
    playback rate of the first record. Raises InputError: less than one period, a period that is no whole number of
    samples, silence, or nothing that shows the clocks' ratio.
    """
    rate_hz, samples = header.sample_rate_hz, header.schedule.period_s * header.sample_rate_hz
    period = round(samples)
    if abs(samples - period) > 1e-6 * samples:
        raise InputError(
            f"period_s is {header.schedule.period_s:g}, which is {samples:g} samples; a whole number of them is needed"
        )
    bins = math.ceil(highest_cycles(header.band_hz, header.sweep_s or period / rate_hz, rate_hz) * period)
    bins = min(bins, (period + 1) // 2)
    seen = [_ReferenceAnalysis(reference, bins / period, period) for reference in references if np.any(reference)]
    if not seen:
        raise InputError("the reference channel is silent; a base signal is needed")
    require_coverage(seen[0].samples, period * (1 - 1e-6 * MAX_PPM), bins / period, "the reference")
    if header.same_clock:
        return scipy.fft.irfft(seen[0].spectrum(bins, 1.0), period), 1.0
    # Fitted to its own repeats each record is as good as any; those of one clock are then averaged.
    sure = [record.repeats is not None and record.repeats.is_sure for record in seen]
    start = sure.index(True) if any(sure) else 0
    fit = seen[start].repeats
    ratio = fit.ratio if fit is not None and sure[start] else _ratio_of_cuts(seen, bins, header)
    clock = KnownSignalClock(seen[start].spectrum(bins, ratio), period, MAX_PPM)
    matches = [clock.fit(record.decimated, ratio) for record in seen]
    same = [match.explained > SAME_SHARE for match in matches]
    off = [
        (record.repeats.ratio / match.ratio - 1, record.repeats.sigma_ppm)
        for record, match, is_sure, is_same in zip(seen, matches, sure, same, strict=True)
        if record.repeats is not None and is_sure and is_same
    ]
    stretch = 1.0
    if off:
        weights = np.array([1 / sigma**2 for _, sigma in off])
        stretch = 1 + float(np.average([off_by for off_by, _ in off], weights=weights))
    total, level = np.zeros(bins, dtype=np.complex128), 0.0
    for record, match, is_same in zip(seen, matches, same, strict=True):
        if is_same:
            turned = np.exp(2j * np.pi / period * np.arange(bins) * match.offset_samples / match.ratio)
            total += match.gain * record.spectrum(bins, match.ratio * stretch) * turned
            level += match.gain**2
    return scipy.fft.irfft(total / level, period), matches[0].ratio * stretch


class _ReferenceAnalysis:
    """A reference recording, decimated, and what it says of the clocks by itself."""

    def __init__(self, reference: Float32Array, highest: float, period: int) -> None:
        self.samples, self.period = reference.size, period
        self.decimated = decimate(np.ascontiguousarray(reference[None], dtype=np.float32), highest)
        self.repeats = fit_repeats(self.decimated, period, reference.size, MAX_PPM)

    def spectrum(self, bins: int, ratio: float) -> Complex128Array:
        """Transform of one period, at a clock ratio, beginning with the record."""
        turn = 2 * np.pi / (self.period * ratio)
        found = period_spectrum(self.decimated.spectrum(turn, 0, bins), turn, self.samples)[0] * (self.period / 2)
        found[0] *= 2
        return np.asarray(found)


def _ratio_of_cuts(seen: Sequence[_ReferenceAnalysis], bins: int, header: RawHeader) -> float:
    """Clock ratio of records that are hardly longer than a period, by a sweep, or cut at different places.

    Where one record begins and ends, another one runs on: only at the true ratio do they agree.
    """
    first, *others = seen[:MAX_CUTS]
    sweep_s = header.sweep_s or first.period / header.sample_rate_hz
    sweep_samples = min(round(sweep_s * header.sample_rate_hz), first.period)
    fit = _fit_law(first.decimated, header, sweep_samples, [0], period=first.period)
    guess = None if fit is None else fit.ratio

    def fits(ratio: float, some: Sequence[_ReferenceAnalysis]) -> list[KnownSignalFit]:
        clock = KnownSignalClock(first.spectrum(bins, ratio), first.period, MAX_PPM)
        return [clock.fit(record.decimated, ratio, search=False) for record in some]

    def misfit(ratio: float, some: Sequence[_ReferenceAnalysis]) -> float:
        return -sum(fit.explained for fit in fits(ratio, some))

    reach = CUT_REACH_PPM
    if guess is None and others:
        tried = 1 + 1e-6 * SCAN_PPM * np.arange(-round(MAX_PPM / SCAN_PPM), round(MAX_PPM / SCAN_PPM) + 1)
        guess, reach = (
            float(tried[int(np.argmin([misfit(tried_ratio, others[:2]) for tried_ratio in tried]))]),
            SCAN_PPM,
        )
    if guess is not None:
        offsets = np.array([fit.offset_samples for fit in fits(guess, others)])
        if np.any(np.abs(offsets) > MIN_CUT * first.period):
            import scipy.optimize  # slow to load; most records are cut alike and need no search

            ends = guess - 1e-6 * reach, guess + 1e-6 * reach
            best = scipy.optimize.minimize_scalar(
                lambda tried_ratio: misfit(float(tried_ratio), others),
                bounds=ends,
                method="bounded",
                options={"xatol": 1e-8},
            )
            return float(best.x)
        if reach == CUT_REACH_PPM:
            return guess
    raise InputError(
        "the reference shows no clock ratio: its records are hardly longer than a period, cut at the same place, and "
        f"hold no sweep through band_hz{_of_law(header)}; record at least 1.05 periods"
    )


# Taken where nothing says how long a sweep is.
MIN_SWEEP_S = 0.05
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


@dataclass(frozen=True, slots=True)
class FoundSweeps:
    """The sweeps of a sequential record, found in its reference channel.

    shape: How they follow each other.
    offset: DAQ sample at which the first one begins; about, unless a law was found.
    ratio: DAQ rate over playback rate.
    by_law: Whether the clocks' ratio comes from the law of the sweeps; else from their repeats.
    highest: Upper end of the band in cycles per sample.
    """

    shape: RecordShape
    offset: float
    ratio: float
    by_law: bool
    highest: float


def shape_of(header: RawHeader) -> RecordShape | None:
    """How the sweeps of a record follow each other, if the file says so; InputError where it cannot be."""
    if header.averages is None or header.sweep_s is None or header.decay_s is None:
        return None
    sweep, decay = (round(duration_s * header.sample_rate_hz) for duration_s in (header.sweep_s, header.decay_s))
    if sweep < 1 or header.averages * (sweep + decay) > header.samples + decay:
        raise InputError(
            f"averages is {header.averages}, sweep_s {header.sweep_s:g} and decay_s {header.decay_s:g}; records of "
            f"{header.samples} samples do not hold that"
        )
    return RecordShape(sweep, sweep + decay, header.averages)


def find_sweeps(reference: Float32Array, header: RawHeader, sweep_samples: int | None = None) -> FoundSweeps:
    """Find the sweeps of a sequential record.

    reference, float32 (samples,): Reference channel in volts.
    header: Rate, band and law of the sweeps, and how they follow each other; where it does not say, that is found,
        and durations are taken to be round. The silence must hold the taps.
    sweep_samples: Length of one sweep; by default that of the header, if any.

    Returns FoundSweeps. Raises InputError: silence, or nothing that shows the clocks' ratio.
    """
    if not np.any(reference):
        raise InputError("the reference channel is silent; the sweeps are needed")
    if sweep_samples is None and header.sweep_s is not None:
        sweep_samples = round(header.sweep_s * header.sample_rate_hz)
    rows, given = np.ascontiguousarray(reference[None], dtype=np.float32), shape_of(header)
    shortest_s = MIN_SWEEP_S if given is None else given.sweep_samples / header.sample_rate_hz
    decimated = decimate(rows, highest_cycles(header.band_hz, shortest_s, header.sample_rate_hz))
    for shape in [given] if given is not None else _shapes(decimated, header, sweep_samples):
        found = _clock(rows, decimated, header, shape, sweep_samples)
        if found is not None:
            return found
    if sweep_samples is not None and (skew_ppm := _skew_beyond(reference, header, sweep_samples)) is not None:
        raise InputError(
            f"the reference carries the sweep on a clock that differs by {skew_ppm:.0f} ppm, allowed {MAX_PPM:g} ppm: "
            "the interface ran at another rate than it was asked for, or sample_rate_hz is wrong"
        )
    more = "state averages, sweep_s and decay_s" if given is None else "check averages, sweep_s, decay_s and band_hz"
    raise InputError(
        f"the reference shows no clock ratio: no sweep from one end of band_hz to the other{_of_law(header)} and no "
        f"repeats were found in it; {more}, or same_clock = true where one clock played and recorded"
    )


def _of_law(header: RawHeader) -> str:
    """Which law the sweeps must follow, for a message."""
    others = '"exponential", or "other" for sweeps that repeat'
    stated = f"sweep_law is {header.sweep_law!r}" if header.sweep_law else f"without sweep_law: linear, state {others}"
    return f" ({stated})"


def _fit_law(
    decimated: Decimated,
    header: RawHeader,
    sweep_samples: int | None,
    starts: Sequence[int],
    *,
    period: int | None = None,
) -> SweepFit | None:
    """Sweeps of the header's law in a recording; None where there are none, or the law is another."""
    if header.law is None:
        return None
    return fit_sweep_law(
        decimated, header.law, header.sample_rate_hz, header.band_hz, sweep_samples, starts, period=period
    )


def _skew_beyond(reference: Float32Array, header: RawHeader, sweep_samples: int) -> float | None:
    """Clock skew in ppm at which a reference carries the sweep of the header's law, where it is beyond the allowed."""
    if header.law is None:
        return None
    low, high = (edge_hz / header.sample_rate_hz for edge_hz in header.band_hz)
    turns, _ = SweepLaw(header.law, low, high, [0.0], sweep_samples).turns(np.arange(sweep_samples, dtype=np.float64))
    ratio, share, sure_to = playing_ratio(reference.astype(np.float64), np.sin(2 * np.pi * turns))
    skew_ppm = 1e6 * (ratio - 1)
    return skew_ppm if share > CARRIED and abs(skew_ppm) > max(MAX_PPM, 1e6 * sure_to) else None


def learn_sweeps(found: FoundSweeps, reference: Float32Array, header: RawHeader) -> RecordedExcitation:
    """The mean of the sweeps of a record, on the playback clock; what `find_sweeps` found, and what it was found in."""
    shape, ratio = found.shape, found.ratio
    starts = found.offset + ratio * shape.period_samples * np.arange(shape.averages)
    inside = starts[starts + 0.5 * shape.sweep_samples < reference.size]
    row = np.asarray(reference, dtype=np.float64)[None]
    repeats = [resampled(row, start, ratio, shape.period_samples)[0] for start in inside]
    base = _low_passed(np.mean(repeats, axis=0), found.highest)
    decay = shape.period_samples - shape.sweep_samples
    if not found.by_law:
        # The silence may be longer than the shape says, unless the file has the shape.
        base = np.roll(base, -_start(base, decay, exact=shape_of(header) is not None))
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / found.highest), max(decay - header.taps, 0) // 2))
    return RecordedExcitation(base, header.sample_rate_hz, *header.band_hz, decay, shape.averages)


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
    rows: Float32Array, decimated: Decimated, header: RawHeader, shape: RecordShape | None, sweep_samples: int | None
) -> FoundSweeps | None:
    """The sweeps of a record of one shape, or one sweep without it; None where it does not hold them."""
    samples, highest = rows.shape[1], decimated.highest
    if shape is not None and shape.averages > 1:
        # Compared where all of its repeats are, so that what is compared repeats throughout.
        length = min(shape.averages * shape.period_samples, samples)
        energy = np.concatenate([[0.0], np.cumsum(np.square(rows[0], dtype=np.float64))])
        within = energy[length:] - energy[:-length]
        last = int(np.flatnonzero(within > (1 - END_ENERGY) * within.max())[-1])
        first = max(last - (shape.period_samples - shape.sweep_samples) // 4, 0)
        cut = decimate(np.ascontiguousarray(rows[:, first : first + length]), highest)
        fit = fit_repeats(cut, shape.period_samples, length, MAX_PPM)
        if fit is not None and fit.is_sure:
            return FoundSweeps(shape, float(first), fit.ratio, by_law=False, highest=highest)
    starts = [0] if shape is None else [repeat * shape.period_samples for repeat in range(shape.averages)]
    fitted = _fit_law(decimated, header, sweep_samples, starts)
    if fitted is None:
        return None
    sweep = fitted.sweep_samples
    if shape is None:
        followed = RecordShape(sweep, sweep + header.taps, 1)
    else:
        followed = RecordShape(sweep, shape.period_samples, shape.averages)
    return FoundSweeps(followed, float(fitted.offset_samples), float(fitted.ratio), by_law=True, highest=highest)


def _shapes(decimated: Decimated, header: RawHeader, sweep_samples: int | None) -> list[RecordShape | None]:
    """Shapes that a record may have, by its energy and its repeats; None is one sweep."""
    values = decimated.values[0].astype(np.float64)
    length = scipy.fft.next_fast_len(2 * values.size, real=True)
    correlation = scipy.fft.irfft(np.abs(scipy.fft.rfft(values, length)) ** 2, length)[: values.size]
    shortest = math.ceil(header.taps / decimated.step)
    lag, share = 0, 0.0
    if shortest < values.size:
        lag = shortest + int(np.argmax(correlation[shortest:]))
        share = float(correlation[lag] / correlation[0])
    if share <= REPEAT_SHARE:
        return [None]
    energy = np.cumsum(np.square(values))
    ends = np.searchsorted(energy / energy[-1], [END_ENERGY, 1 - END_ENERGY]) * decimated.step
    averages = round(1 / (1 - share))
    period = roundest(lag * decimated.step, header.sample_rate_hz, decimated.step / (lag * decimated.step))
    sweep = sweep_samples or round((1 + MARGIN_SHARE) * (ends[1] - ends[0] - (averages - 1) * period))
    return [RecordShape(min(max(sweep, 1), max(period - header.taps, 1)), period, averages), None]
