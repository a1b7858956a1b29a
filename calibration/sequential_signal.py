"""What one actuator played in a sequential record, and on which clock, from the reference channel alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.base_signal import REPEATING, SURE_PPM, highest_cycles
from calibration.errors import InputError
from calibration.estimator import MAX_PPM
from calibration.repeat_clock import fit_repeats
from calibration.resampling import resampled
from calibration.sweep_laws import fit_sweep_law
from calibration.thinning import Thinned, Thinning

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

# Taken where nothing says how long a sweep is.
SHORTEST_SWEEP_S = 0.05
# A record whose autocorrelation reaches this share at some lag holds repeats.
REPEAT_SHARE = 0.4
# Share of the energy that tells where a sweep begins and ends.
END_ENERGY = 1e-4
# Laboratories choose round durations: of those that the clocks allow, the roundest is meant, in seconds.
ROUND_S = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
LIKELY_PPM = 300.0
# How much longer, or shorter, a sweep with long fades may be than its energy tells.
LONGER_SHARE = 0.12
SHORTER_SHARE = 0.02
# What counts as silence: energy of the quietest part of a period, times this, and this share of the period's.
QUIET_FACTOR = 1.5
QUIET_SHARE = 1e-7
# Rather taken too long by this, for what sounds must not pass for silence.
MARGIN_SHARE = 0.03
MOST_LENGTHS = 40


@dataclass(frozen=True, slots=True)
class RecordShape:
    """How the sweeps of a sequential record follow each other on the playback clock.

    Parameters
    ----------
    sweep_samples : int
        Length of one sweep.
    period_samples : int
        Length of a sweep and its silence.
    averages : int
        Number of sweeps.
    """

    sweep_samples: int
    period_samples: int
    averages: int


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSweeps:
    """The sweeps of a sequential record as its reference channel carried them; see `calibration.sweeps.Sweeps`.

    Parameters
    ----------
    base : float64 array, shape (period,)
        One sweep and its silence in DAQ volts, on the playback clock.
    sample_rate_hz : float
        Rate in Hz.
    start_hz, stop_hz : float
        Lowest and highest frequency in Hz.
    decay_samples : int
        Samples of silence after each sweep.
    averages : int
        Number of sweeps in a record.
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


def learn_sweeps(
    reference: Float32Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    taps: int,
    shape: RecordShape | None,
) -> RecordedSweeps:
    """Find the sweeps of a sequential record.

    Parameters
    ----------
    reference : float32 array, shape (samples,)
        Reference channel in volts.
    sample_rate_hz : float
        Rate in Hz.
    band_hz : tuple of float
        Band of the sweeps in Hz.
    taps : int
        Length of the responses, which the silence must hold.
    shape : RecordShape, optional
        How the sweeps follow each other; without it, it is found, and durations are taken to be round.

    Returns
    -------
    RecordedSweeps

    Raises
    ------
    InputError
        Silence, or nothing that tells the clocks' ratio.
    """
    found = _found(reference, sample_rate_hz, band_hz, taps, shape)
    tried, ratio = found.shape, found.ratio
    starts = found.offset + ratio * tried.period_samples * np.arange(tried.averages)
    inside = starts[starts + 0.5 * tried.sweep_samples < reference.size]
    row = np.asarray(reference, dtype=np.float64)[None]
    repeats = [resampled(row, start, ratio, tried.period_samples)[0] for start in inside]
    base = _low_passed(np.mean(repeats, axis=0), found.highest)
    decay = tried.period_samples - tried.sweep_samples
    if not found.by_law:
        base = np.roll(base, -_start(base, decay, exact=shape is not None))
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / found.highest), max(decay - taps, 0) // 2))
    return RecordedSweeps(base, sample_rate_hz, *band_hz, decay, tried.averages)


def whole_record(
    reference: Float32Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    taps: int,
    shape: RecordShape | None,
    samples: int,
) -> tuple[Float64Array, float]:
    """All that the reference channel of a record with silence around its sweeps carried.

    Parameters
    ----------
    reference, sample_rate_hz, band_hz, taps, shape
        As of `learn_sweeps`.
    samples : int
        Length of the answer, silence behind the record included.

    Returns
    -------
    tuple of float64 array, shape (samples,), and float
        The reference in DAQ volts on the playback clock, and DAQ rate over playback rate.

    Raises
    ------
    InputError
        As `learn_sweeps`.
    """
    found = _found(reference, sample_rate_hz, band_hz, taps, shape)
    row = np.asarray(reference, dtype=np.float64)[None]
    return _low_passed(resampled(row, 0.0, found.ratio, samples)[0], found.highest), found.ratio


@dataclass(frozen=True, slots=True)
class _Found:
    """Which shape a record has, where its sweeps start, the clocks' ratio, how it was found, the end of the band."""

    shape: RecordShape
    offset: float
    ratio: float
    by_law: bool
    highest: float


def _found(
    reference: Float32Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    taps: int,
    shape: RecordShape | None,
) -> _Found:
    if not np.any(reference):
        raise InputError("the reference channel is silent; the sweeps are needed")
    rows = np.ascontiguousarray(reference[None], dtype=np.float32)
    shortest_s = SHORTEST_SWEEP_S if shape is None else shape.sweep_samples / sample_rate_hz
    highest = highest_cycles(band_hz, shortest_s, sample_rate_hz)
    thinning = Thinning(highest)
    thinned = thinning(rows)
    shapes = [shape] if shape is not None else _shapes(thinned, thinning, sample_rate_hz, taps)
    for tried in shapes:
        clock = _clock(rows, thinned, thinning, sample_rate_hz, band_hz, tried)
        if clock is not None:
            return _Found(tried, *clock, highest)
    more = "state averages, sweep_s and decay_s" if shape is None else "check averages, sweep_s, decay_s and band_hz"
    raise InputError(
        f"the reference tells no clock ratio: no sweep through band_hz and no repeats were found in it; {more}"
    )


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
    shape: RecordShape,
) -> tuple[float, float, bool] | None:
    """Where the first sweep starts (about, unless by its law), the clocks' ratio, and whether by the sweep's law."""
    samples = rows.shape[1]
    if shape.averages > 1:
        # Compared where all of its repeats are, so that what is compared repeats throughout.
        length = min(shape.averages * shape.period_samples, samples)
        energy = np.concatenate([[0.0], np.cumsum(np.square(rows[0], dtype=np.float64))])
        within = energy[length:] - energy[:-length]
        last = int(np.flatnonzero(within > (1 - END_ENERGY) * within.max())[-1])
        first = max(last - (shape.period_samples - shape.sweep_samples) // 4, 0)
        cut = thinning(np.ascontiguousarray(rows[:, first : first + length]))
        fit = fit_repeats(cut, thinning, shape.period_samples, length, MAX_PPM)
        if fit is not None and fit.sigma_ppm < SURE_PPM and fit.misfit < REPEATING:
            return float(first), fit.ratio, False
    ring = scipy.fft.next_fast_len(max(samples, shape.averages * shape.period_samples) + shape.sweep_samples, real=True)
    starts = [repeat * shape.period_samples for repeat in range(shape.averages)]
    law = fit_sweep_law(thinned, thinning, sample_rate_hz, band_hz, ring, starts, shape.sweep_samples, MAX_PPM)
    return None if law is None else (law.offset_samples, law.ratio, True)


def _shapes(thinned: Thinned, thinning: Thinning, sample_rate_hz: float, taps: int) -> list[RecordShape]:
    """Shapes that a record may have, by its energy and its repeats, the roundest first."""
    values = thinned.values[0].astype(np.float64)
    length = scipy.fft.next_fast_len(2 * values.size, real=True)
    correlation = scipy.fft.irfft(np.abs(scipy.fft.rfft(values, length)) ** 2, length)[: values.size]
    shortest = math.ceil(taps / thinning.step)
    lag, share = 0, 0.0
    if shortest < values.size:
        lag = shortest + int(np.argmax(correlation[shortest:]))
        share = float(correlation[lag] / correlation[0])
    energy = np.cumsum(np.square(values))
    ends = np.searchsorted(energy / energy[-1], [END_ENERGY, 1 - END_ENERGY]) * thinning.step
    if share > REPEAT_SHARE:
        averages = round(1 / (1 - share))
        period = roundest(lag * thinning.step, sample_rate_hz, thinning.step / (lag * thinning.step))
        sweep = round((1 + MARGIN_SHARE) * (ends[1] - ends[0] - (averages - 1) * period))
        return [RecordShape(min(max(sweep, 1), max(period - taps, 1)), period, averages)]
    about = (ends[1] - ends[0]) / (1 - 2 * END_ENERGY)
    lengths: list[int] = []
    for unit_s in ROUND_S:
        unit = unit_s * sample_rate_hz
        for count in range(math.ceil((1 - SHORTER_SHARE) * about / unit), int((1 + LONGER_SHARE) * about / unit) + 1):
            if count and abs(count * unit - round(count * unit)) < 1e-6 and round(count * unit) not in lengths:
                lengths.append(round(count * unit))
    return [RecordShape(sweep, sweep + taps, 1) for sweep in lengths[:MOST_LENGTHS]]


def roundest(samples: float, sample_rate_hz: float, uncertainty: float) -> int:
    """The whole number of samples near a measured one that makes the roundest duration.

    Parameters
    ----------
    samples : float
        As measured on another clock.
    sample_rate_hz : float
        Rate in Hz.
    uncertainty : float
        Relative uncertainty besides that of the clocks.

    Returns
    -------
    int
    """
    allowed = samples * (1e-6 * LIKELY_PPM + uncertainty)
    for unit_s in ROUND_S:
        near = round(samples / (unit_s * sample_rate_hz)) * unit_s * sample_rate_hz
        if near > 0 and abs(near - samples) <= allowed and abs(near - round(near)) < 1e-6:
            return round(near)
    return round(samples)
