"""Scanning: a drive played on the rig once per position, its responses brought to the playback clock and recorded."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.acquisition.attempt import Attempt
from wavefocus.acquisition.engine.recovery import Recovery
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.setup import Setup, point_at, take_record
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.calibration.resampling import resampled
from wavefocus.calibration.timing import ClockFitter
from wavefocus.config.messages.campaign import State, Subscriber
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.field.prediction import field_unit, predict
from wavefocus.rendering.greens.source import usable
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.errors import InputError
from wavefocus.storage.scan_journal import ScanJournal, ScannedPosition

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

_MARKER_START_HZ = 20.0
# Shortest silence from which noise is measured, and the part before the drive that is not used, in samples.
_MIN_SILENCE_SAMPLES = 50
_SILENCE_GUARD_SAMPLES = 8


def _scan_signals(setup: Setup, drive: Drive, samples: int) -> dict[int, Float64Array]:
    """Put the drive on the actuators' channels and a marker sweep over the whole record on the loopback channel.

    Raises InputError: the rig cannot play the drive.
    """
    actuators, drive_samples = drive.drive_v.shape
    if actuators != len(setup.actuator_channels):
        there = len(setup.actuator_channels)
        raise InputError(f"the drive is for {actuators} actuators; the rig has {there}")
    full_scale_v = setup.player.full_scale_v
    peak_v = np.max(np.abs(drive.drive_v), axis=1, initial=0.0)
    loudest = int(np.argmax(peak_v))
    if not peak_v[loudest] <= full_scale_v:
        raise InputError(
            f"the drive of actuator {loudest} reaches {peak_v[loudest]:.3g} V; "
            f"at most {full_scale_v:.3g} V, the player's full scale: set limit_v in the scene's [output]"
        )
    padded_v = np.pad(drive.drive_v, ((0, 0), (0, samples - drive_samples)))
    marker = marker_v(setup, samples, drive.sample_rate_hz)
    return dict(zip(setup.actuator_channels, padded_v, strict=True)) | {setup.loopback_channel: marker}


def marker_v(setup: Setup, samples: int, rate_hz: float) -> Float64Array:
    """A sweep for the loopback channel, in volts, by which a fit finds the start of a play in its record.

    It runs from 20 Hz to 1 kHz, or to 0.4 of the rate where that is lower, at half of full scale or 0.7 of the
    reference input's range, faded at both ends.
    """
    amplitude_v = min(0.5 * setup.player.full_scale_v, 0.7 * setup.range_v[0] / setup.reference_gain)
    time_s = np.arange(samples) / rate_hz
    stop_hz = min(0.4 * rate_hz, 1000.0)
    slope = (stop_hz - _MARKER_START_HZ) / (samples / rate_hz)
    sweep = np.sin(2.0 * np.pi * (_MARKER_START_HZ + 0.5 * slope * time_s) * time_s)
    fade = np.sin(0.5 * np.pi * np.clip(np.minimum(time_s, time_s[::-1]) / 0.02, 0.0, 1.0)) ** 2
    return np.asarray(amplitude_v * fade * sweep)


# Share of a response's energy above the frequency from which it is taken to be only noise.
_QUIET_SHARE = 1e-5
# A window is lost when it holds more than this many times the noise, and more than this share of the loudest
# window of the response, both as rms.
_NOISE_FACTOR = 6.0
_RESPONSE_SHARE = 0.02


def _dropout_filter(rate_hz: float, quiet_hz: float) -> Float32Array:
    """What shows bursts of noise above a frequency in windows of a response, (window, bins); no bins: it cannot."""
    # A dropout lasts some milliseconds (speckle crossing the spot); windows of 3.2 ms overlap by half.
    half = max(round(0.0032 * rate_hz / 2), 1)
    shape = np.kaiser(2 * half, 6.0)  # keeps all that lies more than two of its bins away below -60 dB
    bins = np.arange(int(quiet_hz * 2 * half / rate_hz) + 1 + 2, half)
    turn = np.exp(-1j * np.pi * np.outer(np.arange(2 * half), bins) / half)
    outside = shape[:, None] * turn / np.sqrt(max(bins.size, 1) * np.square(shape).sum())
    return np.concatenate([outside.real, outside.imag], axis=1).astype(np.float32)


def _signal_lost(response_v: Float32Array, dropout_filter: Float32Array) -> bool:
    """The vibrometer lost the signal during a record."""
    window = len(dropout_filter)
    windows = np.lib.stride_tricks.sliding_window_view(response_v, window)[:: window // 2]
    if not dropout_filter.size or len(windows) < 8:
        return False
    windows = np.ascontiguousarray(windows)
    loudest = float(_norm(windows).max()) / np.sqrt(window)
    outside = _norm(windows @ dropout_filter)
    return bool(outside.max() > max(_NOISE_FACTOR * float(np.median(outside)), _RESPONSE_SHARE * loudest))


def _norm(rows: Float32Array) -> Float32Array:
    """Root of the sum of the squares of each row."""
    return np.asarray(np.sqrt(np.einsum("rs,rs->r", rows, rows)))


_GIVE_UP_POSITIONS = 5
"""So many positions given up one after the other mean that the rig, and not a position, is at fault."""


@dataclass(frozen=True, slots=True)
class Scan:
    """A measured field, and the quality of its records; arrays have one element or row per position.

    field, float32 (positions, drive samples + taps - 1): Response on the playback clock; rows of failed positions are
        zero.
    position_index, int64 array: Bank rows, ascending.
    status, uint8 array: Status bits as in the bank: valid, over-range, poor signal (the vibrometer lost it) or failed.
    attempts, int64 array: Records taken.
    noise_rms, float64 array: Rms of the response while nothing played, in response units; NaN where unknown.
    clock_ratio, playback_gain, float64 array: DAQ rate over playback rate, and measured over requested voltage of the
        loopback.
    """

    field: Float32Array
    position_index: Int64Array
    sample_rate_hz: float
    start_s: float
    response_unit: str
    status: NDArray[np.uint8]
    attempts: Int64Array
    noise_rms: Float64Array
    clock_ratio: Float64Array
    playback_gain: Float64Array

    def as_field(self) -> Field:
        """The positions that have a record without a dropout, as a field for `write_field`."""
        from wavefocus.storage.field_file import Field

        there = (self.status & (Status.FAILED | Status.POOR_SIGNAL)) == 0
        return Field(
            field=self.field[there],
            position_index=self.position_index[there],
            sample_rate_hz=self.sample_rate_hz,
            start_s=self.start_s,
            response_unit=self.response_unit,
        )


_Pending = tuple[Attempt, Future[tuple[ScannedPosition, bool]]]
"""A record that is being aligned."""


def scan(
    position: Sequence[int],
    setup: Setup,
    drive: Drive,
    bank: GreenSource,
    *,
    attempts: int = 3,
    purpose: str = "scan",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    publish: Subscriber = lambda event: None,
    journal: ScanJournal | None = None,
) -> Scan:
    """Play a drive on the rig and record its field at some positions.

    A marker sweep plays on the loopback channel with the drive; from it follow the start of the drive in each record
    and the ratio of the two clocks. While a record is taken, one worker thread brings the previous one to the playback
    clock. A lost instrument is waited for, as in a campaign. The caller closes `setup`, which mutes the player and
    parks the mirror.

    A record that reached the end of the input range is repeated once: more of the same drive would clip again. A record
    in which the vibrometer lost the signal is repeated, and the last one kept as poor.

    position: Bank rows in the order in which they are visited, none twice.
    attempts: Records at each before it is given up, >= 1.
    purpose: Name in the instruments' logs.
    on_progress: Called with the positions done and the positions there are.
    publish: Receives the events of faults and of waiting for a lost instrument.
    journal: Keeps each position once it has a record, whatever happens then; those that it holds are not scanned again.

    Raises InputError: a drive that the rig cannot play. InstrumentError, ReferenceMissingError: an instrument failed,
    or was gone, for good, or five positions in a row had to be given up.

    Returns the field on the samples of ``predict(drive, bank)``.
    """
    session = Session(setup.clock, publish, StopRequest())
    session.enter(State.RUNNING, f"{len(position)} positions to scan")
    run = _ScanRun(position, setup, drive, bank, Recovery(setup, session), attempts, purpose, on_progress, journal)
    return run.run()


class _ScanRun:
    """One scan: positions still to visit, and results."""

    def __init__(
        self,
        position: Sequence[int],
        setup: Setup,
        drive: Drive,
        bank: GreenSource,
        recovery: Recovery,
        attempts: int,
        purpose: str,
        on_progress: Callable[[int, int], None],
        journal: ScanJournal | None,
    ) -> None:
        self._journal = journal
        self._setup, self._bank, self._on_progress = setup, bank, on_progress
        self._recovery, self._attempts, self._purpose = recovery, attempts, purpose
        rows = np.unique(np.asarray(position, np.int64))
        samples = drive.drive_v.shape[1] + bank.taps - 1
        self._signals_v = _scan_signals(setup, drive, samples)
        quiet_hz = _quiet_above_hz(drive, bank, rows[usable(bank)[rows]])
        self._dropout_filter = _dropout_filter(drive.sample_rate_hz, quiet_hz)
        self._clock = ClockFitter(self._signals_v[setup.loopback_channel])
        # The response channel is sampled later, so its samples of an instant come earlier in the record.
        self._delay_samples = -setup.response_delay_s * drive.sample_rate_hz
        self._place = {int(row): index for index, row in enumerate(rows)}
        self._scan = Scan(
            field=np.zeros((rows.size, samples), np.float32),
            position_index=rows,
            sample_rate_hz=drive.sample_rate_hz,
            start_s=drive.start_s,
            response_unit=field_unit(bank),
            status=np.full(rows.size, Status.FAILED, np.uint8),
            attempts=np.zeros(rows.size, np.int64),
            noise_rms=np.full(rows.size, np.nan),
            clock_ratio=np.full(rows.size, np.nan),
            playback_gain=np.full(rows.size, np.nan),
        )
        self._clipped: set[int] = set()
        self._given_up_in_a_row = 0
        self._done = 0
        kept: set[int] = set()
        for scanned in journal.entries() if journal is not None else ():
            if scanned.row in self._place:
                self._take(scanned)
                kept.add(scanned.row)
        self._visits = deque(Attempt(int(row), 1, 1) for row in position if row not in kept)

    def run(self) -> Scan:
        with one_blas_thread(), ThreadPoolExecutor(max_workers=1, thread_name_prefix="scan") as worker:
            pending: _Pending | None = None
            while self._visits or pending is not None:
                previous, pending = pending, None
                if self._visits:
                    pending = self._record_and_align(self._visits.popleft(), worker)
                if previous is not None:
                    self._collect(previous)
        return self._scan

    def _record_and_align(self, attempt: Attempt, worker: ThreadPoolExecutor) -> _Pending | None:
        try:
            recording = self._recovery.retry_after_reconnect(lambda: self._record(attempt), attempt)
        except TransientInstrumentError as failure:
            self._recovery.renew_if_repeated(failure)
            self._try_again(attempt, failure)
            return None
        clipped, clipped_before = any(recording.over_range), attempt.position in self._clipped
        if clipped:
            self._clipped.add(attempt.position)
            if not clipped_before and self._repeated(attempt):
                return None
        status = Status.OVER_RANGE if clipped else Status.VALID
        return attempt, worker.submit(self._align, recording, attempt, status)

    def _record(self, attempt: Attempt) -> Recording:
        x_mm, y_mm = (float(value) for value in self._bank.position_mm[attempt.position])
        point_at(self._setup, x_mm, y_mm)
        label = RecordLabel(attempt.position, attempt.number, 0, self._purpose)
        return take_record(self._setup, self._signals_v, self._scan.sample_rate_hz, label)

    def _align(self, recording: Recording, attempt: Attempt, status: Status) -> tuple[ScannedPosition, bool]:
        """One recorded response on the playback clock, and whether the vibrometer lost the signal in it.

        Runs in the worker; the result depends only on the recording.

        Raises ReferenceMissingError: the marker is not on the reference channel.
        """
        reference, response = recording.volts
        fit = self._clock.fit(reference)
        samples = self._scan.field.shape[1]
        on_clock = resampled(response[None], fit.offset_samples + self._delay_samples, fit.ratio, samples)[0]
        start = int(fit.offset_samples + self._delay_samples) - _SILENCE_GUARD_SAMPLES
        end = int(fit.offset_samples + fit.ratio * samples) + _SILENCE_GUARD_SAMPLES
        lead_in, tail = response[: max(start, 0)], response[end:]
        silence = lead_in if lead_in.size >= _MIN_SILENCE_SAMPLES else tail
        noise_v = float(np.std(silence)) if silence.size >= _MIN_SILENCE_SAMPLES else float("nan")
        unit = self._setup.response_per_volt
        scanned = ScannedPosition(
            attempt.position, int(status), attempt.number, noise_v * abs(unit), fit.ratio,
            fit.gain / self._setup.reference_gain, (on_clock * unit).astype(np.float32),
        )  # fmt: skip
        return scanned, _signal_lost(response, self._dropout_filter)

    def _collect(self, pending: _Pending) -> None:
        attempt, future = pending
        try:
            scanned, signal_lost = future.result()
        except ReferenceMissingError as missing:
            self._try_again(attempt, missing)
            return
        # Clipping, too, makes noise where nothing plays; such a record is marked already.
        if signal_lost and scanned.status == Status.VALID:
            if self._repeated(attempt):
                return
            scanned = replace(scanned, status=int(Status.POOR_SIGNAL))
        self._given_up_in_a_row = 0
        if self._journal is not None:
            self._journal.append(scanned)
        self._take(scanned)

    def _repeated(self, attempt: Attempt) -> bool:
        """Have a position recorded next once more; False where it had all its records."""
        if attempt.number >= self._attempts:
            return False
        self._visits.appendleft(attempt.next())
        return True

    def _try_again(self, attempt: Attempt, failure: Exception) -> None:
        if self._repeated(attempt):
            return
        self._given_up_in_a_row += 1
        if self._given_up_in_a_row >= _GIVE_UP_POSITIONS:
            raise failure
        self._scan.attempts[self._place[attempt.position]] = attempt.number
        self._count()

    def _take(self, scanned: ScannedPosition) -> None:
        index = self._place[scanned.row]
        self._scan.field[index] = scanned.response
        for name in ("status", "attempts", "noise_rms", "clock_ratio", "playback_gain"):
            getattr(self._scan, name)[index] = getattr(scanned, name)
        self._count()

    def _count(self) -> None:
        self._done += 1
        self._on_progress(self._done, len(self._place))


def _quiet_above_hz(drive: Drive, bank: GreenSource, rows: Int64Array) -> float:
    """Frequency above which the responses expected at these rows have no energy; half the rate where there are none.

    Frequencies up to twice the bank's band belong to the signal in any case.
    """
    if not rows.size:
        return drive.sample_rate_hz / 2
    # Positions whose predicted responses say from which frequency on a scan is quiet.
    some = rows[evenly_spread(rows.size, 16)]
    expected = predict(drive, bank, some.tolist(), dtype=np.float32).field
    power = np.square(np.abs(scipy.fft.rfft(expected, axis=1))).sum(axis=0)
    above = np.cumsum(power[::-1])[::-1]
    quiet_hz = float(np.count_nonzero(above > _QUIET_SHARE * above[0]) * drive.sample_rate_hz / expected.shape[1])
    return quiet_hz if bank.band_hz is None else max(quiet_hz, 2 * bank.band_hz[1])
