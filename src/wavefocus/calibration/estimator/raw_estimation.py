"""Raw recordings into Green's functions: what was played is found out once, positions are estimated in parallel."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from wavefocus.calibration import Float32Array
from wavefocus.calibration.clock.foreign_excitation import find_sweeps, learn_base, learn_sweeps
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.estimator.estimate import Channels, Estimate, PositionEstimator, Records
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.estimator.whole_record import WholeRecordEstimator
from wavefocus.storage.argument_types import Positions, bank_rows, checked
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader
from wavefocus.storage.raw.writer import DamagedError, RawFile, Recordings

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
    for first in _recorded(raw, LEARNED_POSITIONS):
        try:
            if header.schedule.period_s > 0:
                return _periodic(header, records, first, report)
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
    (`wavefocus.calibration.blas`).

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


def _recorded(raw: RawFile, most: int) -> Iterator[Recordings]:
    """The first positions with recordings that are sound and not silent."""
    found = 0
    for position in range(raw.header.positions):
        try:
            recordings = raw.read(position)
        except DamagedError:
            continue
        if recordings is None or not recordings.reference_v.any():
            continue
        yield recordings
        found += 1
        if found == most:
            return


def _periodic(
    header: RawHeader, records: Records, first: Recordings, report: Callable[[str], None]
) -> PositionEstimator:
    """The base signal is already running when a record starts."""
    base_v, ratio = learn_base(first.reference_v[0], header)
    report(f"a period of {header.schedule.period_s:g} s; clocks differ by {1e6 * (ratio - 1):.2f} ppm")
    return StaggeredEstimator(base_v, records)


def _with_silence(
    header: RawHeader, records: Records, first: Recordings, report: Callable[[str], None]
) -> PositionEstimator:
    """Each record begins and ends by itself."""
    if header.same_clock:
        report("same_clock: whole records, each with its own reference")
        return WholeRecordEstimator(records)
    reference, taps = first.reference_v[0], header.taps
    found = find_sweeps(reference, header)
    report(
        f"{found.averages} sweeps of {found.sweep_samples / header.sample_rate_hz:g} s, {header.law}; "
        f"clocks differ by {1e6 * (found.ratio - 1):.2f} ppm"
    )
    is_whole = header.averages is not None or found.period_samples <= header.samples
    if header.schedule.is_sequential and taps <= found.period_samples - found.sweep_samples and is_whole:
        sweeps = learn_sweeps(found, reference, header)
        comparable = header.averages is not None
        return SequentialEstimator(sweeps, taps, records.channels, schedule=header.schedule, comparable=comparable)

    def clock(reference_v: Float32Array) -> tuple[float, float]:
        try:
            here = find_sweeps(reference_v, header)
        except InputError as error:
            raise ReferenceMissingError(str(error), advised=True) from error
        return here.ratio, here.offset

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


def estimation_bytes(header: RawHeader) -> int:
    """Bytes that one position of a raw file takes while it is estimated, roughly and rather too many."""
    longest = header.samples + header.taps
    together = header.records if header.same_clock else 1
    return (
        header.records * header.samples * CHANNEL_BYTES
        + longest * (TRANSFORM_BYTES + 16 * 3 * (together - 1))
        + header.actuators * header.taps * 64
    )


def affordable_workers(header: RawHeader, workers: int, what: str, *, present: int | None = None) -> int:
    """Number of positions, up to `workers`, that may be estimated at a time.

    header: What is estimated.
    workers: As many as are wanted, >= 1.
    what: Name of the file for the message.
    present: Bytes of memory; by default those of the computer.

    Raises InputError: when a single position needs more memory than there is.
    """
    total = physical_bytes() if present is None else present
    if total is None:
        return workers
    needed = estimation_bytes(header)
    if needed + BASE_BYTES > total:
        raise InputError(
            f"{what}: a position of {header.records} records of {header.samples} samples and {header.taps} taps needs "
            f"about {needed / 2**30:.1f} GiB of memory, of which there are {total / 2**30:.1f} GiB; cut the records, "
            "or estimate on a larger computer"
        )
    return max(min(workers, (total - BASE_BYTES) // (2 * needed)), 1)


def physical_bytes() -> int | None:
    """Memory of this computer in bytes; None where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return None
