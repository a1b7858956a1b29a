"""What another program played, and on which clock: sweeps of a stated law and length, or what repeats in a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.clock.known_signal_clock import KnownSignalClock
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.clock.period_spectrum import period_spectrum, require_coverage
from wavefocus.calibration.clock.resampling import Decimated, decimate, resampled
from wavefocus.calibration.clock.timing import ClockFitter
from wavefocus.calibration.estimator.estimate import MAX_PPM
from wavefocus.calibration.excitation import RecordedExcitation
from wavefocus.calibration.numerics import fourier_sum
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import Law, RawHeader

# A sweep sounds beyond its band by about so many times the root of its rate in Hz per second.
BEYOND_BAND = 4.0
# Of a stated sweep the fades are unknown, so that it explains this much of the reference at least: 10 dB, as elsewhere.
FOUND_SHARE = 0.9
# The fades lie within this share of a sweep at either end; the rest is compared with the law in so many blocks.
ENDS_SHARE, BLOCKS, STEPS = 0.12, 400, 3
# What comes again, and a sweep between its fades, explains this much of itself, in amplitude.
SAME_SHARE = 0.97
# Steps of round durations in s, the roundest first, and how much a sweep's fades may shorten it.
ROUND_S, FADED = (1.0, 0.5, 0.1, 0.05, 0.01), 0.05
# Share of the energy outside the sweeps of a record.
END_ENERGY = 1e-4
REMEDY = (
    'state averages, sweep_s and decay_s, and sweep_law = "linear" or "exponential" (from the lower end of band_hz to '
    'the upper one, phase 0 or 90 degrees), or "other" for sweeps that repeat in each record, or same_clock = true '
    "where one clock played and recorded"
)


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
    offset: DAQ sample at which the first one begins; about, where they have no stated law.
    ratio: DAQ rate over playback rate.
    by_law: Whether they follow the stated law; else their clock is that of their repeats.
    """

    shape: RecordShape
    offset: float
    ratio: float
    by_law: bool


def highest_cycles(band_hz: tuple[float, float], sweep_s: float, sample_rate_hz: float) -> float:
    """Upper end of what a sweep through a band has to say, in cycles per sample."""
    beyond_hz = BEYOND_BAND * math.sqrt((band_hz[1] - band_hz[0]) / sweep_s)
    return min((band_hz[1] + beyond_hz) / sample_rate_hz, 0.499)


def shape_of(header: RawHeader) -> RecordShape | None:
    """How the sweeps of a record follow each other, None where the file does not say; InputError where it cannot be."""
    if header.sweep_s is None:
        return None
    sweep = round(header.sweep_s * header.sample_rate_hz)
    if header.averages is None or header.decay_s is None:
        return RecordShape(sweep, sweep + header.taps, 1)
    decay = round(header.decay_s * header.sample_rate_hz)
    if sweep < 1 or header.averages * (sweep + decay) > header.samples + decay:
        raise InputError(
            f"averages is {header.averages}, sweep_s {header.sweep_s:g} and decay_s {header.decay_s:g}; records of "
            f"{header.samples} samples do not hold that"
        )
    return RecordShape(sweep, sweep + decay, header.averages)


def find_sweeps(reference: Float32Array, header: RawHeader) -> FoundSweeps:
    """Find the sweeps of a sequential record: reference channel (samples,) in volts, and what the file says of them.

    Raises InputError: silence, or nothing that shows the clocks' ratio.
    """
    if not np.any(reference):
        raise InputError("the reference channel is silent; the sweeps are needed")
    shape = shape_of(header)
    for likely in _single_sweeps(reference, header) if shape is None else [shape]:
        if (fit := _fit_law(reference, header, likely)) is not None:
            return FoundSweeps(likely, *fit, by_law=True)
    if shape is not None and shape.averages > 1:
        # Cut where all of its repeats are.
        length = min(shape.averages * shape.period_samples, reference.size)
        energy = np.concatenate([[0.0], np.cumsum(np.square(reference, dtype=np.float64))])
        within = energy[length:] - energy[:-length]
        last = int(np.flatnonzero(within > (1 - END_ENERGY) * within.max())[-1])
        first = max(last - (shape.period_samples - shape.sweep_samples) // 4, 0)
        ratio = repeat_ratio(reference[first:], shape.period_samples, shape.averages - 1)
        if ratio is not None:
            return FoundSweeps(shape, float(first), ratio, by_law=False)
    raise InputError(f"the reference shows no clock ratio{_of_law(header)}: {REMEDY}")


def _single_sweeps(reference: Float32Array, header: RawHeader) -> list[RecordShape]:
    """Round durations that a record of one sweep may have, by where its energy lies, the roundest first."""
    energy = np.cumsum(np.square(reference, dtype=np.float64))
    begin, end = np.searchsorted(energy, [END_ENERGY * energy[-1], (1 - END_ENERGY) * energy[-1]])
    shortest_s = float(end - begin) / header.sample_rate_hz
    lasting_s = [step_s * math.ceil(shortest_s / step_s - 1e-3) for step_s in ROUND_S]
    lengths = dict.fromkeys(round(one * header.sample_rate_hz) for one in lasting_s if one < (1 + FADED) * shortest_s)
    return [RecordShape(sweep, sweep + header.taps, 1) for sweep in lengths]


def _fit_law(reference: Float32Array, header: RawHeader, shape: RecordShape) -> tuple[float, float] | None:
    """Offset and clock ratio by the stated law, None where the sweeps do not follow it."""
    if header.law is None:
        return None
    cycles = sweep_cycles(header.law, header, shape.sweep_samples)
    for begin_at in (np.sin, np.cos):
        base = np.zeros(shape.period_samples)
        base[: shape.sweep_samples] = begin_at(2 * np.pi * cycles)
        played = np.tile(base, shape.averages)[: shape.period_samples * (shape.averages - 1) + shape.sweep_samples]
        with suppress(ReferenceMissingError):
            fit = ClockFitter(played, max_ppm=MAX_PPM).fit(reference, diagnose=False)
            return _without_fades(reference, shape, cycles, fit.offset_samples, fit.ratio)
    return None


def _without_fades(
    reference: Float32Array, shape: RecordShape, cycles: Float64Array, offset: float, ratio: float
) -> tuple[float, float] | None:
    """Offset and ratio by the phases of the sweeps' middle parts, where unknown fades count for nothing.

    A delay d and a stretch s turn the phase of a sweep of frequency f by 2 pi f (d + s k) at its sample k.
    """
    sweep = cycles.size
    middle = slice(round(ENDS_SHARE * sweep), round((1 - ENDS_SHARE) * sweep))
    edges = np.linspace(middle.start, middle.stop, BLOCKS + 1).astype(int)[:-1] - middle.start
    hertz, place = np.gradient(cycles)[middle], np.arange(sweep)[middle]
    row, law, share = np.asarray(reference, np.float64)[None], np.exp(-2j * np.pi * cycles), 0.0
    for _ in range(STEPS):
        turns, rows = [], []
        for repeat in range(shape.averages):
            start = offset + ratio * shape.period_samples * repeat
            spectrum = scipy.fft.fft(resampled(row, start, ratio, sweep)[0])
            spectrum[sweep // 2 :] = 0
            turned = (scipy.fft.ifft(spectrum) * law)[middle]
            turns.append(np.add.reduceat(turned, edges))
            here = place + shape.period_samples * repeat
            curves = [hertz, hertz * here, np.ones(here.size)]
            rows.append(
                np.stack([np.add.reduceat(curve, edges) for curve in curves]) / np.diff(edges, append=place.size)
            )
        turn, curve = np.concatenate(turns), np.concatenate(rows, axis=1)
        phase, weight = np.unwrap(np.angle(turn)), np.abs(turn)
        late, stretch, first = np.linalg.lstsq((curve * weight).T, phase * weight / (-2 * np.pi), rcond=None)[0]
        share = abs(np.sum(turn * np.exp(2j * np.pi * (late * curve[0] + stretch * curve[1] + first)))) / weight.sum()
        offset, ratio = offset + late, ratio + stretch
    return (float(offset), float(ratio)) if share > SAME_SHARE and abs(ratio - 1) < 1e-6 * MAX_PPM else None


def sweep_cycles(law: Law, header: RawHeader, samples: int) -> Float64Array:
    """Cycles that a sweep from the lower end of the band to the upper one has run through at each of its samples.

    Sources: linear, the chirp's definition; exponential, A. Farina, 108th AES Convention, preprint 5093 (2000).
    """
    low, high = header.band_hz
    duration_s, time_s = samples / header.sample_rate_hz, np.arange(samples) / header.sample_rate_hz
    if law == "linear" or low <= 0:
        return np.asarray(low * time_s + (high - low) * time_s**2 / (2 * duration_s))
    growth = math.log(high / low)
    return np.asarray(low * duration_s / growth * np.expm1(growth * time_s / duration_s))


def _of_law(header: RawHeader) -> str:
    return f" (sweep_law is {header.sweep_law!r})" if header.sweep_law else " (without sweep_law: linear)"


def repeat_ratio(signal: Float32Array, period: int, repeats: int) -> float | None:
    """DAQ rate over playback rate, from where the first period of a recording comes again so many periods later.

    The slope of the cross-spectrum's phase gives the delay, its correlation the whole samples of it. Returns None where
    what comes again is something else, or the recording is too short.
    """
    window = np.hanning(period)
    first = scipy.fft.rfft(window * signal[:period])
    omega, place = 2 * np.pi * np.arange(first.size) / period, float(repeats * period)
    share = 0.0
    for _ in range(4):
        begin = min(round(place), signal.size - period)
        if begin < 0.5 * period:
            return None
        cross = scipy.fft.rfft(window * signal[begin : begin + period]) * first.conj()
        correlation = scipy.fft.irfft(cross, period)
        lag = int(np.argmax(correlation))
        late = float(lag - period if lag > period // 2 else lag)
        power = np.abs(cross)
        turned = np.angle(cross * np.exp(1j * omega * late))
        late -= float((power * omega) @ turned) / max(float(power @ omega**2), 1e-300)
        share = float((cross * np.exp(1j * omega * late)).real.sum()) / max(float(power.sum()), 1e-300)
        place = begin + late
    ratio = place / (repeats * period)
    return ratio if share > SAME_SHARE and abs(ratio - 1) < 1e-6 * MAX_PPM else None


def learn_sweeps(found: FoundSweeps, reference: Float32Array, header: RawHeader) -> RecordedExcitation:
    """The mean of the sweeps of a record, on the playback clock; what `find_sweeps` found, and what it was found in."""
    shape, ratio = found.shape, found.ratio
    highest = highest_cycles(header.band_hz, shape.sweep_samples / header.sample_rate_hz, header.sample_rate_hz)
    decay = shape.period_samples - shape.sweep_samples
    starts = found.offset + ratio * shape.period_samples * np.arange(shape.averages)
    inside = starts[starts + 0.5 * shape.sweep_samples < reference.size]
    low = max(math.floor(inside[0]) - decay // 2, 0)
    sweeps = reference[low : math.floor(inside[-1] + ratio * shape.period_samples) - decay // 2]
    base = _on_ring(sweeps, inside[0] - low, ratio, shape.period_samples, highest) / inside.size
    if not found.by_law:
        base = np.roll(base, -_end_of_silence(base, decay))
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / highest), max(decay - header.taps, 0) // 2))
    return RecordedExcitation(base, header.sample_rate_hz, *header.band_hz, decay, shape.averages)


def _end_of_silence(base: Float64Array, decay: int) -> int:
    """Where the quietest stretch of so many samples of a period ends."""
    energy = np.concatenate([[0.0], np.cumsum(np.square(np.concatenate([base, base[:decay]])))])
    return int(np.argmin(energy[decay:-1] - energy[: -1 - decay])) + decay if decay else 0


def whole_record(found: FoundSweeps, reference: Float32Array, header: RawHeader, samples: int) -> Float64Array:
    """All that the reference channel of a record carried in DAQ volts on the playback clock, `samples` long."""
    sweep_s = found.shape.sweep_samples / header.sample_rate_hz
    return _on_ring(
        reference, 0.0, found.ratio, samples, highest_cycles(header.band_hz, sweep_s, header.sample_rate_hz)
    )


def _on_ring(recording: Float32Array, offset: float, ratio: float, period: int, highest: float) -> Float64Array:
    """Sum of a recording's periods on the playback clock, up to `highest` cycles per sample; one begins at `offset`."""
    bins, turn = math.ceil(highest * period), 2 * np.pi / (period * ratio)
    spectrum = fourier_sum(recording.astype(np.float64), turn, 0, bins) * np.exp(1j * turn * offset * np.arange(bins))
    return np.asarray(scipy.fft.irfft(spectrum / ratio, period))


def learn_base(references: Sequence[Float32Array], header: RawHeader) -> tuple[Float64Array, float]:
    """Find the base signal of periodic records as the mean of several, put on one clock.

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
    heard = [np.asarray(reference, np.float32) for reference in references if np.any(reference)]
    if not heard:
        raise InputError("the reference channel is silent; a base signal is needed")
    require_coverage(heard[0].size, period * (1 - 1e-6 * MAX_PPM), bins / period, "the reference")
    seen = [decimate(np.ascontiguousarray(reference[None]), bins / period) for reference in heard]
    ratio = 1.0 if header.same_clock else _periodic_ratio(heard[0], seen[0], header, period, bins)

    def spectrum(record: int, at_ratio: float) -> Complex128Array:
        turn = 2 * np.pi / (period * at_ratio)
        sums = seen[record].spectrum(turn, 0, bins)
        found = period_spectrum(sums, turn, heard[record].size)[0] * (period / 2)
        found[0] *= 2
        return np.asarray(found)

    first = spectrum(0, ratio)
    if header.same_clock:
        return scipy.fft.irfft(first, period), 1.0
    clock = KnownSignalClock(first, period, MAX_PPM)
    total, level = np.zeros(bins, dtype=np.complex128), 0.0
    for record, decimated in enumerate(seen):
        match = clock.fit(decimated, ratio)
        if match.explained > FOUND_SHARE:
            turned = np.exp(2j * np.pi / period * np.arange(bins) * match.offset_samples / match.ratio)
            total += match.gain * spectrum(record, match.ratio) * turned
            level += match.gain**2
    return scipy.fft.irfft(total / level, period), ratio


def _periodic_ratio(reference: Float32Array, decimated: Decimated, header: RawHeader, period: int, bins: int) -> float:
    """Clock ratio of a record of a running periodic signal, by the stated law, else by its repeats."""
    if header.law is not None:
        base = np.zeros(period)
        sweep = min(round(header.sweep_s * header.sample_rate_hz), period) if header.sweep_s else period
        for begin_at in (np.sin, np.cos):
            base[:sweep] = begin_at(2 * np.pi * sweep_cycles(header.law, header, sweep))
            fit = KnownSignalClock(scipy.fft.rfft(base)[:bins], period, MAX_PPM).fit(decimated)
            if fit.explained > FOUND_SHARE and abs(fit.ratio - 1) < 1e-6 * MAX_PPM:
                return fit.ratio
    repeats = int(reference.size / (period * (1 + 1e-6 * MAX_PPM))) - 1
    ratio = repeat_ratio(reference, period, repeats) if repeats else None
    if ratio is None:
        raise InputError(
            f"the reference shows no clock ratio{_of_law(header)}: {REMEDY}; or record two periods or more"
        )
    return ratio
