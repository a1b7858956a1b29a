"""Raw recordings into Green's functions: what was played, and on which clock, is found once; positions in parallel."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice

import numpy as np
import scipy.fft

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.estimator.estimate import Channels, Estimate, PositionEstimator, Records
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator, period_spectrum, require_coverage
from wavefocus.calibration.estimator.whole_record import WholeRecordEstimator
from wavefocus.calibration.excitation import RecordedExcitation
from wavefocus.calibration.known_signal import MAX_PPM, KnownSignalClock, ReferenceMissingError
from wavefocus.calibration.numerics import fourier_sum
from wavefocus.calibration.resampling import decimate, resampled
from wavefocus.calibration.timing import ClockFitter
from wavefocus.storage.argument_types import Positions, bank_rows, checked
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader
from wavefocus.storage.raw.writer import DamagedError, RawFile, Recordings

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


_Sweeps = tuple[int, int, int, float, float]
"""Sweeps of a sequential record: samples of one, and of one with its silence, on the playback clock; their number; DAQ
sample at which the first one begins; DAQ rate over playback rate."""


def _find_sweeps(reference: Float32Array, header: RawHeader) -> _Sweeps:
    """Find the sweeps of a sequential record: reference channel (samples,) in volts, and what the file says of them.

    Raises InputError: the sweeps are not there, or the file states no law.
    """
    for sweep, period, averages in _shapes(reference, header):
        for base, cycles in _stated_sweeps(header, sweep):
            played = np.tile(np.pad(base, (0, period - sweep)), averages)[: period * (averages - 1) + sweep]
            with suppress(ReferenceMissingError):
                fit = ClockFitter(played).fit(reference, diagnose=False)
                found = _without_fades(reference, cycles, period, averages, fit.offset_samples, fit.ratio)
                if found is not None:
                    return sweep, period, averages, *found
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
    return InputError(f"the reference shows no clock ratio within {MAX_PPM:g} ppm ({law}): {REMEDY}")


def _highest_cycles(header: RawHeader, sweep_s: float) -> float:
    """Upper end of what a sweep through the band has to say, in cycles per sample."""
    low, high = header.band_hz
    return min((high + BEYOND_BAND * math.sqrt((high - low) / sweep_s)) / header.sample_rate_hz, 0.499)


def _learn_sweeps(found: _Sweeps, reference: Float32Array, header: RawHeader) -> RecordedExcitation:
    """The mean of the sweeps of a record that `_find_sweeps` found in it, on the playback clock."""
    sweep, period, averages, offset, ratio = found
    highest, decay = _highest_cycles(header, sweep / header.sample_rate_hz), period - sweep
    starts = offset + ratio * period * np.arange(averages)
    inside = starts[starts + 0.5 * sweep < reference.size]
    low = max(math.floor(inside[0]) - decay // 2, 0)
    sweeps = reference[low : math.floor(inside[-1] + ratio * period) - decay // 2].astype(np.float64)
    # Their sum on the ring of a period.
    bins, turn = math.ceil(highest * period), 2 * np.pi / (period * ratio)
    spectrum = fourier_sum(sweeps, turn, 0, bins) * np.exp(1j * turn * (inside[0] - low) * np.arange(bins))
    base = scipy.fft.irfft(spectrum / ratio, period) / inside.size
    # An abrupt start rings before it, once it is limited to its band.
    base = np.roll(base, min(round(1 / highest), max(decay - header.taps, 0) // 2))
    return RecordedExcitation(base, header.sample_rate_hz, *header.band_hz, decay, averages)


def _learn_base(reference: Float32Array, header: RawHeader) -> tuple[Float64Array, float]:
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
        fits = (KnownSignalClock(scipy.fft.rfft(base)[:bins], period).fit(decimated) for base in bases)
        found = (fit.ratio for fit in fits if fit.explained > FOUND_SHARE and abs(fit.ratio - 1) < 1e-6 * MAX_PPM)
        if (ratio := next(found, 0.0)) == 0.0:
            raise _no_clock(header)
    turn = 2 * np.pi / (period * ratio)
    spectrum = period_spectrum(decimated.spectrum(turn, 0, bins), turn, reference.size)[0] * (period / 2)
    spectrum[0] *= 2
    return scipy.fft.irfft(spectrum, period), ratio


# Positions tried for one whose reference can be identified.
LEARNED_POSITIONS = 16


@dataclass(frozen=True, slots=True)
class PositionResult:
    """One position, estimated.

    position: Row of the file.
    estimate: None where nothing could be estimated.
    fault: Why, else empty.
    """

    position: int
    estimate: Estimate | None
    fault: str


@checked
def estimator_of(raw: RawFile, report: Callable[[str], None] = lambda line: None) -> PositionEstimator:
    """Find out what was played, and make the estimator for it; the same file gives the same estimator.

    Parameters
    ----------
    raw
        The recordings.
    report
        Receives a line about what was found.

    Returns
    -------
    PositionEstimator
        Its ``estimate(reference_v, response_v, range_v=...)`` makes an `Estimate` of the records of a position.

    Raises
    ------
    InputError
        No position's reference shows what was played, or the schedule cannot be estimated.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.open_raw("plate.raw.h5") as raw:
    ...     records = raw.read(0)
    ...     found = wf.estimator(raw).estimate(records.reference_v, records.response_v, range_v=records.range_v)
    >>> found.green.shape, found.snr_db.shape
    ((4, 1000), (4,))
    """
    header = raw.header
    records = records_of(header)
    failure: InputError | None = None
    for first in islice(_recorded(raw), LEARNED_POSITIONS):
        try:
            if (period_s := header.schedule.period_s) > 0:
                base_v, ratio = _learn_base(first.reference_v[0], header)
                report(f"a period of {period_s:g} s; clocks differ by {1e6 * (ratio - 1):.2f} ppm")
                return StaggeredEstimator(base_v, records)
            return _with_silence(header, records, first, report)
        except (InputError, ReferenceMissingError) as error:
            failure = failure or InputError(f"{raw.path}: {error}")
    raise failure or InputError(f"{raw.path} holds no recordings; there is nothing to estimate")


@checked
def estimate_positions(
    raw: RawFile, estimator: PositionEstimator, positions: Positions, workers: int
) -> Iterator[PositionResult]:
    """Estimate positions in several threads, in their order; one position more than workers is in memory.

    Every position is estimated by itself, so that the result does not depend on the workers. They spend their
    time in transforms and linear algebra, which run in parallel; hold BLAS to one thread
    (`wavefocus.calibration.numerics`).

    Parameters
    ----------
    raw
        The recordings.
    estimator
        What `estimator` made of them, or any other.
    positions
        Rows of the file, or a mask of them; those where nothing was recorded are left out.
    workers
        Threads, >= 1.

    Yields
    ------
    PositionResult
        ``position``; its ``estimate``, None where nothing could be estimated; and ``fault``, why.

    Raises
    ------
    InputError
        Recordings hold values that are not finite, or cannot be read.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.open_raw("plate.raw.h5") as raw:
    ...     for result in wf.estimate_positions(raw, wf.estimator(raw), [0, 7], workers=1):
    ...         print(result.position, result.estimate.green.shape)
    0 (4, 1000)
    7 (4, 1000)
    """
    pending: deque[Future[PositionResult]] = deque()
    with ThreadPoolExecutor(max_workers=workers, thread_name_prefix="estimate") as pool:
        try:
            for position in bank_rows(positions, raw.header.positions).tolist():
                try:
                    recordings = raw.read(position)
                except DamagedError as damaged:
                    pending.append(pool.submit(PositionResult, position, None, str(damaged)))
                    continue
                if recordings is None:
                    continue
                pending.append(pool.submit(_estimated, estimator, position, recordings, str(raw.path)))
                del recordings
                if len(pending) > workers:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for left in pending:
                left.cancel()


def _estimated(estimator: PositionEstimator, position: int, recordings: Recordings, path: str) -> PositionResult:
    try:
        estimate = estimator.estimate(recordings.reference_v, recordings.response_v, range_v=recordings.range_v)
    except ReferenceMissingError as missing:
        return PositionResult(position, None, str(missing))
    except InputError as error:
        raise InputError(f"{path}: position {position}: {error}") from error
    return PositionResult(position, estimate, "")


def _recorded(raw: RawFile) -> Iterator[Recordings]:
    """Positions with recordings that are sound and not silent."""
    for position in range(raw.header.positions):
        with suppress(DamagedError):
            recordings = raw.read(position)
            if recordings is not None and recordings.reference_v.any():
                yield recordings


def _with_silence(
    header: RawHeader, records: Records, first: Recordings, report: Callable[[str], None]
) -> PositionEstimator:
    """Each record begins and ends by itself."""
    if header.same_clock:
        report("same_clock: whole records, each with its own reference")
        return WholeRecordEstimator(records)
    reference, taps = first.reference_v[0], header.taps
    found = _find_sweeps(reference, header)
    sweep, period, averages, _, ratio = found
    report(
        f"{averages} sweeps of {sweep / header.sample_rate_hz:g} s, {header.law}; "
        f"clocks differ by {1e6 * (ratio - 1):.2f} ppm"
    )
    is_whole = header.averages is not None or period <= header.samples
    if header.schedule.is_sequential and taps <= period - sweep and is_whole:
        sweeps = _learn_sweeps(found, reference, header)
        return SequentialEstimator(sweeps, taps, records.channels, schedule=header.schedule)

    def clock(reference_v: Float32Array) -> tuple[float, float]:
        try:
            *_, offset, ratio = _find_sweeps(reference_v, header)
        except InputError as error:
            raise ReferenceMissingError(str(error), advised=True) from error
        return ratio, offset

    return WholeRecordEstimator(records, clock_ratio=clock)


def records_of(header: RawHeader) -> Records:
    """The records of a position, as a raw file describes them."""
    channels = Channels(header.reference_gain, header.response_per_volt, header.inter_channel_delay_s)
    return Records(header.sample_rate_hz, header.band_hz, header.taps, header.schedule, channels)


# Transforms of one record in complex128, those under way at a time, seen to be twelve.
TRANSFORM_BYTES = 16 * 12
# Both channels as they lie in the file and in float32.
CHANNEL_BYTES = 16
# What the interpreter and its libraries take.
BASE_BYTES = 200 << 20


def affordable_workers(header: RawHeader, workers: int, what: str, *, present: int | None = None) -> int:
    """Number of positions, up to `workers`, that may be estimated at a time.

    header: What is estimated.
    workers: As many as are wanted, >= 1.
    what: Name of the file for the message.
    present: Bytes of memory; by default those of the computer.

    Raises InputError: when a single position needs more memory than there is.
    """
    total = _physical_bytes() if present is None else present
    if total is None:
        return workers
    # Bytes that one position takes while it is estimated, roughly and rather too many.
    together = header.records if header.same_clock else 1
    needed = header.records * header.samples * CHANNEL_BYTES + header.actuators * header.taps * 64
    needed += (header.samples + header.taps) * (TRANSFORM_BYTES + 16 * 3 * (together - 1))
    if needed + BASE_BYTES > total:
        raise InputError(
            f"{what}: a position of {header.records} records of {header.samples} samples and {header.taps} taps needs "
            f"about {needed / 2**30:.1f} GiB of memory, of which there are {total / 2**30:.1f} GiB; cut the records, "
            "or estimate on a larger computer"
        )
    return max(min(workers, (total - BASE_BYTES) // (2 * needed)), 1)


def _physical_bytes() -> int | None:
    """Memory of this computer in bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return None
