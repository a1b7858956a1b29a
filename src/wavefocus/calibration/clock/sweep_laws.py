"""The clock from a sweep of another program: its law is stated, its phase and its fades are not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array
from wavefocus.calibration.clock.known_signal import CORNERS
from wavefocus.calibration.clock.resampling import Decimated
from wavefocus.calibration.estimator.estimate import MAX_PPM
from wavefocus.storage.raw.header import Law

# Fades, and where an abrupt end rings, are left out of the fit: this share of the sweep at either end.
ENDS_SHARE = 0.12
# A law that explains so much of the rest is the one that was played.
LAW_SHARE = 0.97
# Blocks of a sweep in each of which a frequency, and later a phase, is fitted.
BLOCKS = 400
MIN_BLOCK = 4
# A block this far below the loudest ones is silence; a frequency this share of the band away is another sweep.
LOUD_SHARE = 0.05
JUMP_SHARE = 0.1
# A run of blocks shorter than this is not enough for a law.
MIN_BLOCKS = 16
# How much longer than it should be a sweep of a given length may seem before its frequencies are fitted well.
LENGTH_SHARE = 0.05
# Laboratories choose round durations: of those that the clocks allow, the roundest is meant, in seconds.
ROUND_S = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
LIKELY_PPM = 300.0
MAX_STEPS = 12
# Coupling capacitors turn low frequencies nearly as a clock skew does: they count where they explain more than half
# of what is left without them.
CORNERS_SHARE = 0.5
# The first steps take shorter blocks, in which the phase turns less while the frequencies are still off.
BLOCK_PARTS = (16, 4)
ENOUGH_TURNS = 1e-9


@dataclass(frozen=True, slots=True)
class SweepFit:
    """Where sweeps of one law lie in a recording.

    offset_samples: DAQ sample at which the first sweep begins.
    ratio: DAQ rate over playback rate.
    explained: Share of the recording's energy in band, at the places that count, that the law explains.
    sweep_samples: Length of a sweep in playback samples.
    """

    offset_samples: float
    ratio: float
    explained: float
    sweep_samples: int


def fit_sweep_law(
    decimated: Decimated,
    law: Law,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    sweep_samples: int | None,
    starts: Sequence[int],
    *,
    period: int | None = None,
) -> SweepFit | None:
    """Find linear or exponential sweeps through a band, up or down, of any phase and fades.

    Length and place of one sweep are fitted to the frequencies of the recording's moments; the phases of the
    blocks of all sweeps, turned back by that law, then give offset, clock ratio and phase by least squares.

    decimated: One recording.
    law: How the frequency rises.
    sample_rate_hz: Rate in Hz.
    band_hz: Where the sweeps begin and end in Hz.
    sweep_samples: Length of each; without it the roundest duration that the clocks allow is taken.
    starts: Playback samples at which sweeps begin, from the first one on.
    period: Playback samples after which all of them come again, before and after, for as long as the record lasts.

    Returns SweepFit or None: none where no such sweeps are there.
    """
    recording = _Analytic(decimated)
    low, high = band_hz[0] / sample_rate_hz, band_hz[1] / sample_rate_hz
    run = recording.longest_run(high - low)
    if run is None or not 0 < low < high:
        return None
    ends = (low, high) if run.frequency[-1] > run.frequency[0] else (high, low)
    fit = _fit(recording, run, law, ends, sample_rate_hz, sweep_samples, starts, period)
    return fit if fit is not None and fit.explained > LAW_SHARE else None


@dataclass(frozen=True, slots=True)
class _Run:
    """Blocks of one sweep: their middles in samples of the recording, frequency in cycles per sample, and energy."""

    place: Float64Array
    frequency: Float64Array
    energy: Float64Array


class _Analytic:
    """A recording with its negative frequencies taken out."""

    def __init__(self, decimated: Decimated) -> None:
        values = decimated.values[0]
        length = scipy.fft.next_fast_len(values.size)
        spectrum = scipy.fft.rfft(values.astype(np.float64), length)
        cycles = np.arange(spectrum.size) / (length * decimated.step)
        spectrum[(cycles == 0) | (cycles > decimated.highest)] = 0
        both = np.zeros(length, dtype=np.complex128)
        both[: spectrum.size] = 2 * spectrum
        self.values: Complex64Array = scipy.fft.ifft(both)[: values.size].astype(np.complex64)
        self.first, self.step = decimated.first, decimated.step

    def longest_run(self, width: float) -> _Run | None:
        """The longest part in which the frequency, in a band so many cycles wide, rises all the time, or falls."""
        energy = np.square(np.abs(self.values))
        loud = np.flatnonzero(energy > LOUD_SHARE * np.quantile(energy, 0.99))
        if loud.size < MIN_BLOCKS * MIN_BLOCK:
            return None
        size = max((int(loud[-1]) - int(loud[0])) // BLOCKS, MIN_BLOCK)
        blocks = self.values.size // size
        rows = self.values[: blocks * size].reshape(blocks, size).astype(np.complex128)
        turn = (rows[:, 1:] * rows[:, :-1].conj()).sum(axis=1)
        frequency = (np.angle(turn) % (2 * np.pi)) / (2 * np.pi * self.step)
        power = np.square(np.abs(rows)).sum(axis=1, dtype=np.float64)
        place = self.first + self.step * ((np.arange(blocks) + 0.5) * size - 0.5)
        sounds = power > LOUD_SHARE * np.quantile(power, 0.95)
        best: slice | None = None
        for direction in (1, -1):
            step = direction * np.diff(frequency)
            goes_on = sounds[1:] & sounds[:-1] & (step > -JUMP_SHARE * width)
            edges = np.flatnonzero(np.diff(np.concatenate([[0], goes_on.astype(np.int8), [0]])))
            for first, last in edges.reshape(-1, 2):
                rises = direction * (frequency[last] - frequency[first]) > JUMP_SHARE * width
                if rises and (best is None or last + 1 - first > best.stop - best.start):
                    best = slice(int(first), int(last) + 1)
        if best is None or best.stop - best.start < MIN_BLOCKS:
            return None
        return _Run(place[best].astype(np.float64), frequency[best], power[best])

    def block_phases(self, turns: Float64Array, low: int, high: int, size: int) -> tuple[Complex128Array, Float64Array]:
        """Means of blocks of the values from `low` to `high`, turned back by `turns`, and energies of the blocks."""
        values = self.values[low:high]
        blocks = max(values.size // size, 1)
        size = min(size, values.size)
        part = values[: blocks * size].astype(np.complex128) * np.exp(-2j * np.pi * turns[: blocks * size])
        rows = part.reshape(blocks, size)
        return rows.sum(axis=1), np.square(np.abs(rows)).sum(axis=1) * size


def _fit(
    recording: _Analytic,
    run: _Run,
    law: Law,
    ends: tuple[float, float],
    sample_rate_hz: float,
    sweep_samples: int | None,
    starts: Sequence[int],
    period: int | None,
) -> SweepFit | None:
    """The sweeps of one law between frequencies in cycles per sample, from their ends in time to all of them."""
    length, offset = _guess(run, law, *ends)
    if not (np.isfinite(length) and np.isfinite(offset) and length > 0):
        return None
    if sweep_samples is not None and abs(length / sweep_samples - 1) > LENGTH_SHARE:
        return None
    # One sweep by itself: place and length.
    single = SweepLaw(law, *ends, [0.0], float(length if sweep_samples is None else sweep_samples))
    found = _refined(recording, single, offset, length / single.samples)
    if found is None:
        return None
    offset, ratio, _ = found
    samples = roundest(ratio * single.samples, sample_rate_hz, 0.0) if sweep_samples is None else sweep_samples
    ratio = ratio * single.samples / samples
    # All sweeps together, each a whole number of playback samples after the first.
    every = _all_starts(recording, offset, ratio, samples, starts, period)
    joint = _refined(recording, SweepLaw(law, *ends, every, float(samples)), offset, ratio)
    if joint is None or abs(joint[1] - 1) > 1.01e-6 * MAX_PPM:
        return None
    offset, ratio, explained = joint
    return SweepFit(offset + (min(every) if period is None else 0.0) * ratio, ratio, explained, samples)


def _guess(run: _Run, law: Law, first: float, last: float) -> tuple[float, float]:
    """Length and start of the sweep in DAQ samples, from a line through its (logarithmic) frequencies."""
    value, ends = run.frequency, (first, last)
    if law == "exponential":
        value, ends = np.log(np.maximum(value, 1e-9)), (math.log(first), math.log(last))
    slope, level = 0.0, 0.0
    weight = np.sqrt(run.energy)
    for _ in range(3):
        slope, level = np.polyfit(run.place, value, 1, w=weight)
        off = np.abs(value - np.polyval([slope, level], run.place))
        weight = np.sqrt(run.energy) / (1 + (off / max(2 * float(np.median(off)), 1e-12)) ** 2)
    if slope == 0 or (slope > 0) != (last > first):
        return math.nan, math.nan
    return (ends[1] - ends[0]) / float(slope), (ends[0] - float(level)) / float(slope)


@dataclass(frozen=True, slots=True)
class SweepLaw:
    """SweepLaw of one law from `first` to `last` cycles per playback sample, each `samples` long, at `starts`."""

    law: Law
    first: float
    last: float
    starts: Sequence[float]
    samples: float

    def turns(self, since: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Cycles done, and frequency, so many playback samples after the start of a sweep."""
        if self.law == "linear":
            slope = (self.last - self.first) / self.samples
            return since * (self.first + 0.5 * slope * since), self.first + slope * since
        growth = math.log(self.last / self.first) / self.samples
        frequency = self.first * np.exp(growth * since)
        return (frequency - self.first) / growth, frequency


def _refined(recording: _Analytic, sweeps: SweepLaw, offset: float, ratio: float) -> tuple[float, float, float] | None:
    """Offset, ratio and explained share by least squares on the phases of blocks; at first on their frequencies."""
    size = max(round(sweeps.samples * (1 - 2 * ENDS_SHARE) * ratio / recording.step) // BLOCKS, 1)
    explained = 0.0
    for step in range(MAX_STEPS):
        block = max(size // BLOCK_PARTS[step], 1) if step < len(BLOCK_PARTS) else size
        rows = [part for start in sweeps.starts if (part := _phases(recording, sweeps, start, offset, ratio, block))]
        if not rows:
            return None
        turn, frequency, means, energy = (np.concatenate(column) for column in zip(*rows, strict=True))
        # How the phase in turns changes with offset, ratio, phase, and below the corners of coupling capacitors.
        lowest = min(sweeps.first, sweeps.last)
        columns = [-frequency / ratio, -frequency * turn / ratio, np.ones_like(frequency)]
        columns += [np.arctan2(corner * lowest, frequency) / (2 * np.pi) for corner in CORNERS]
        weight = np.abs(means) / math.sqrt(float(np.square(np.abs(means)).sum()) + 1e-300)
        # Each sweep is unwrapped by itself and then put next to the others.
        edge = np.cumsum([len(row[0]) for row in rows])[:-1]
        phases = [np.unwrap(np.angle(part)) / (2 * np.pi) for part in np.split(means, edge)]
        middles = [
            np.average(part, weights=near + 1e-30) for part, near in zip(phases, np.split(weight, edge), strict=True)
        ]
        phase = np.concatenate([part - round(at - middles[0]) for part, at in zip(phases, middles, strict=True)])
        shares, left = _least_squares(np.stack(columns[:3], axis=1), phase, weight)
        with_corners = _least_squares(np.stack(columns, axis=1), phase, weight)
        if np.square(with_corners[1] * weight).sum() < CORNERS_SHARE * np.square(left * weight).sum():
            shares, left = with_corners
        moved, stretched = float(shares[0]), float(shares[1])
        explained = float((np.square(np.abs(means)) * np.cos(2 * np.pi * left) ** 2).sum() / (energy.sum() + 1e-300))
        offset, ratio = offset + moved, ratio + stretched
        if not (np.isfinite(offset) and 0 < ratio < 2):
            return None
        if step >= len(BLOCK_PARTS) and (abs(moved) + sweeps.samples * abs(stretched)) < ENOUGH_TURNS * sweeps.samples:
            break
    return offset, ratio, explained


def _least_squares(model: Float64Array, phase: Float64Array, weight: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Shares of the columns of `model`, and what they leave of the phases."""
    scale = np.sqrt(np.square(model * weight[:, None]).sum(axis=0)) + 1e-300
    shares = np.linalg.lstsq(model / scale * weight[:, None], phase * weight, rcond=1e-9)[0] / scale
    return np.asarray(shares), np.asarray(phase - model @ shares)


def _phases(
    recording: _Analytic, sweeps: SweepLaw, start: float, offset: float, ratio: float, size: int
) -> tuple[Float64Array, Float64Array, Complex128Array, Float64Array] | None:
    """Blocks of one sweep: playback time since the first start, frequency, turned means, energies."""
    begin = offset + ratio * (start + ENDS_SHARE * sweeps.samples)
    end = offset + ratio * (start + (1 - ENDS_SHARE) * sweeps.samples)
    low = max(math.ceil((begin - recording.first) / recording.step), 0)
    high = min(math.floor((end - recording.first) / recording.step), recording.values.size)
    if high - low < max(size, 1) * MIN_BLOCKS:
        return None
    place = recording.first + recording.step * np.arange(low, high, dtype=np.float64)
    since = (place - offset) / ratio
    turns, frequency = sweeps.turns(since - start)
    means, energy = recording.block_phases(turns, low, high, size)
    middles = slice(size // 2, means.size * size, size)
    return since[middles], frequency[middles], means, energy


def _all_starts(
    recording: _Analytic, offset: float, ratio: float, samples: int, starts: Sequence[int], period: int | None
) -> list[float]:
    """Starts of all sweeps in the recording, of which one begins at `offset`."""
    end = recording.first + recording.step * recording.values.size
    if period is not None:
        before = math.floor(offset / (ratio * period)) + 1
        after = math.floor((end - offset) / (ratio * period)) + 1
        return [float(period * turn) for turn in range(-before, after + 1)]
    if len(starts) == 1:
        return [0.0]
    # Which of them it is: the one that puts most of the others where it sounds.
    energy = np.concatenate([[0.0], np.cumsum(np.square(np.abs(recording.values), dtype=np.float64))])

    def within(begin: float) -> float:
        places = (np.array([begin, begin + ratio * samples]) - recording.first) / recording.step
        low, high = np.clip(np.round(places), 0, recording.values.size).astype(np.int64)
        return float(energy[high] - energy[low])

    sums = [sum(within(offset + ratio * (start - own)) for start in starts) for own in starts]
    own = starts[int(np.argmax(sums))]
    return [float(start - own) for start in starts]


def roundest(samples: float, sample_rate_hz: float, uncertainty: float) -> int:
    """The whole number of samples near a measured one that makes the roundest duration.

    samples: As measured on another clock.
    sample_rate_hz: Rate in Hz.
    uncertainty: Relative uncertainty besides that of the clocks.

    Returns int.
    """
    allowed = samples * (1e-6 * LIKELY_PPM + uncertainty)
    for unit_s in ROUND_S:
        near = round(samples / (unit_s * sample_rate_hz)) * unit_s * sample_rate_hz
        if near > 0 and abs(near - samples) <= allowed and abs(near - round(near)) < 1e-6:
            return round(near)
    return round(samples)
