"""What another program played, and on which clock: sweeps of a stated law, each by itself or one that runs on."""

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.clock.known_signal_clock import KnownSignalClock
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.clock.period_spectrum import period_spectrum, require_coverage
from wavefocus.calibration.clock.resampling import decimate, resampled
from wavefocus.calibration.clock.timing import ClockFitter
from wavefocus.calibration.estimator.estimate import MAX_PPM
from wavefocus.calibration.excitation import RecordedExcitation
from wavefocus.calibration.numerics import fourier_sum
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader

# A sweep sounds beyond its band by about so many times the root of its rate in Hz per second.
BEYOND_BAND = 4.0
# Of a stated sweep the fades are unknown, so that it explains this much of the reference at least: 10 dB, as elsewhere.
FOUND_SHARE = 0.9
# The fades lie within this share of a sweep at either end; the rest is compared with the law in so many blocks.
ENDS_SHARE, BLOCKS, STEPS = 0.12, 400, 3
# A sweep between its fades explains this much of itself, in amplitude.
SAME_SHARE = 0.97
# Steps of round durations in s, the roundest first, and how much a sweep's fades may shorten it.
ROUND_S, FADED = (1.0, 0.5, 0.1, 0.05, 0.01), 0.05
# Share of the energy outside the sweeps of a record.
END_ENERGY = 1e-4
REMEDY = (
    'state averages, sweep_s and decay_s, and sweep_law = "linear" or "exponential" (from the lower end of band_hz to '
    "the upper one, phase 0 or 90 degrees), or same_clock = true where one clock played and recorded"
)


@dataclass(frozen=True, slots=True)
class FoundSweeps:
    """The sweeps of a sequential record, found in its reference channel.

    sweep_samples, period_samples: Length of one sweep, and of a sweep with its silence, on the playback clock.
    averages: Number of sweeps.
    offset: DAQ sample at which the first one begins.
    ratio: DAQ rate over playback rate.
    """

    sweep_samples: int
    period_samples: int
    averages: int
    offset: float
    ratio: float


def find_sweeps(reference: Float32Array, header: RawHeader) -> FoundSweeps:
    """Find the sweeps of a sequential record: reference channel (samples,) in volts, and what the file says of them.

    Raises InputError: the sweeps are not there, or the file states no law.
    """
    for sweep, period, averages in _shapes(reference, header):
        for base, cycles in _stated_sweeps(header, sweep):
            played = np.tile(np.pad(base, (0, period - sweep)), averages)[: period * (averages - 1) + sweep]
            with suppress(ReferenceMissingError):
                fit = ClockFitter(played, max_ppm=MAX_PPM).fit(reference, diagnose=False)
                found = _without_fades(reference, cycles, period, averages, fit.offset_samples, fit.ratio)
                if found is not None:
                    return FoundSweeps(sweep, period, averages, *found)
                break
    raise _no_clock(header)


def _without_fades(
    reference: Float32Array, cycles: Float64Array, period: int, averages: int, offset: float, ratio: float
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
        for repeat in range(averages):
            start = offset + ratio * period * repeat
            spectrum = scipy.fft.fft(resampled(row, start, ratio, sweep)[0])
            spectrum[sweep // 2 :] = 0
            turned = (scipy.fft.ifft(spectrum) * law)[middle]
            turns.append(np.add.reduceat(turned, edges))
            here = place + period * repeat
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


def _shapes(reference: Float32Array, header: RawHeader) -> list[tuple[int, int, int]]:
    """Samples of a sweep, of a sweep with its silence, and sweeps in a record, as the file has them.

    Where it does not say, one sweep of round durations, by where its energy lies, the roundest first.
    """
    rate_hz, taps = header.sample_rate_hz, header.taps
    if header.sweep_s is None:
        energy = np.cumsum(np.square(reference, dtype=np.float64))
        begin, end = np.searchsorted(energy, [END_ENERGY * energy[-1], (1 - END_ENERGY) * energy[-1]])
        shortest_s = float(end - begin) / rate_hz
        lasting_s = [step_s * math.ceil(shortest_s / step_s - 1e-3) for step_s in ROUND_S]
        lengths = dict.fromkeys(round(one * rate_hz) for one in lasting_s if one < (1 + FADED) * shortest_s)
        return [(sweep, sweep + taps, 1) for sweep in lengths]
    sweep = round(header.sweep_s * rate_hz)
    if header.averages is None or header.decay_s is None:
        return [(sweep, sweep + taps, 1)]
    decay = round(header.decay_s * rate_hz)
    if sweep < 1 or header.averages * (sweep + decay) > header.samples + decay:
        raise InputError(
            f"averages is {header.averages}, sweep_s {header.sweep_s:g} and decay_s {header.decay_s:g}; records of "
            f"{header.samples} samples do not hold that"
        )
    return [(sweep, sweep + decay, header.averages)]


def _stated_sweeps(header: RawHeader, samples: int) -> Iterator[tuple[Float64Array, Float64Array]]:
    """Sweeps of the stated law from the lower end of the band to the upper one, at 0 and 90 degrees; their cycles.

    Sources: linear, the chirp's definition; exponential, A. Farina, 108th AES Convention, preprint 5093 (2000).
    """
    if header.law is None:
        return
    low, high = header.band_hz
    duration_s, time_s = samples / header.sample_rate_hz, np.arange(samples) / header.sample_rate_hz
    cycles = low * time_s + (high - low) * time_s**2 / (2 * duration_s)
    if header.law == "exponential" and low > 0:
        growth = math.log(high / low)
        cycles = low * duration_s / growth * np.expm1(growth * time_s / duration_s)
    yield np.sin(2 * np.pi * cycles), cycles
    yield np.cos(2 * np.pi * cycles), cycles


def _no_clock(header: RawHeader) -> InputError:
    law = f"sweep_law is {header.sweep_law!r}" if header.sweep_law else "without sweep_law: linear"
    return InputError(f"the reference shows no clock ratio ({law}): {REMEDY}")


def _highest_cycles(header: RawHeader, sweep_s: float) -> float:
    """Upper end of what a sweep through the band has to say, in cycles per sample."""
    low, high = header.band_hz
    return min((high + BEYOND_BAND * math.sqrt((high - low) / sweep_s)) / header.sample_rate_hz, 0.499)


def learn_sweeps(found: FoundSweeps, reference: Float32Array, header: RawHeader) -> RecordedExcitation:
    """The mean of the sweeps of a record, on the playback clock; what `find_sweeps` found, and what it was found in."""
    period, ratio = found.period_samples, found.ratio
    highest = _highest_cycles(header, found.sweep_samples / header.sample_rate_hz)
    decay = period - found.sweep_samples
    starts = found.offset + ratio * period * np.arange(found.averages)
    inside = starts[starts + 0.5 * found.sweep_samples < reference.size]
    low = max(math.floor(inside[0]) - decay // 2, 0)
    sweeps = reference[low : math.floor(inside[-1] + ratio * period) - decay // 2].astype(np.float64)
    # Their sum on the ring of a period.
    bins, turn = math.ceil(highest * period), 2 * np.pi / (period * ratio)
    spectrum = fourier_sum(sweeps, turn, 0, bins) * np.exp(1j * turn * (inside[0] - low) * np.arange(bins))
    base = scipy.fft.irfft(spectrum / ratio, period) / inside.size
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / highest), max(decay - header.taps, 0) // 2))
    return RecordedExcitation(base, header.sample_rate_hz, *header.band_hz, decay, found.averages)


def learn_base(reference: Float32Array, header: RawHeader) -> tuple[Float64Array, float]:
    """Find the base signal of periodic records.

    reference, float32 (samples,): Reference channel of one of them in volts.
    header: Period, rate, band and law of the sweeps.

    Returns base signal : float64 (period,), in DAQ volts on the playback clock, its beginning arbitrary; DAQ rate over
    playback rate. Raises InputError: less than one period, a period that is no whole number of samples, silence, or
    nothing that shows the clocks' ratio.
    """
    if not np.any(reference):
        raise InputError("the reference channel is silent; a base signal is needed")
    rate_hz, samples = header.sample_rate_hz, header.schedule.period_s * header.sample_rate_hz
    period = round(samples)
    if abs(samples - period) > 1e-6 * samples:
        raise InputError(
            f"period_s is {header.schedule.period_s:g}, which is {samples:g} samples; a whole number of them is needed"
        )
    bins = math.ceil(_highest_cycles(header, header.sweep_s or period / rate_hz) * period)
    bins = min(bins, (period + 1) // 2)
    require_coverage(reference.size, period * (1 - 1e-6 * MAX_PPM), bins / period, "the reference")
    decimated = decimate(np.ascontiguousarray(reference[None], np.float32), bins / period)
    ratio = 1.0
    if not header.same_clock:
        sweep = min(round(header.sweep_s * rate_hz), period) if header.sweep_s else period
        bases = (np.pad(base, (0, period - sweep)) for base, _ in _stated_sweeps(header, sweep))
        fits = (KnownSignalClock(scipy.fft.rfft(base)[:bins], period, MAX_PPM).fit(decimated) for base in bases)
        found = (fit.ratio for fit in fits if fit.explained > FOUND_SHARE and abs(fit.ratio - 1) < 1e-6 * MAX_PPM)
        if (ratio := next(found, 0.0)) == 0.0:
            raise _no_clock(header)
    turn = 2 * np.pi / (period * ratio)
    spectrum = period_spectrum(decimated.spectrum(turn, 0, bins), turn, reference.size)[0] * (period / 2)
    spectrum[0] *= 2
    return scipy.fft.irfft(spectrum, period), ratio
