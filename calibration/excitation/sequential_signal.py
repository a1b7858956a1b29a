"""What one actuator played in a sequential record, and on which clock, from the reference channel alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.known_signal import Thinned, Thinning, resampled
from calibration.clock.periodic_clock import fit_repeats
from calibration.estimator.estimate import MAX_PPM
from calibration.excitation.base_signal import REPEATING, SURE_PPM, highest_cycles
from calibration.excitation.sweep_laws import fit_sweep_law, roundest
from storage.errors import InputError
from storage.raw.header import LAWS, Law

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

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
    """The sweeps of a sequential record as its reference channel carried them: `calibration.excitation.sweeps.Sweeps`.

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
