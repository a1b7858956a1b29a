"""From sequential records, sweeps with silence after each, to Green's functions and figures of their quality."""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.estimator.causal_fit import RIDGE, CausalFit, ToeplitzFit
from wavefocus.calibration.estimator.defect_finder import DefectFinder, energy, measure_levels
from wavefocus.calibration.estimator.estimate import DIRECT, EDGE, FLOOR, Channels, Estimate, decibel
from wavefocus.calibration.excitation import Excitation
from wavefocus.calibration.known_signal import MAX_PPM, ClockFit, ReferenceMissingError, filled_bins
from wavefocus.calibration.timing import ClockFitter
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import Schedule

# Bins whose nominal energy is below this share of the median in band carry noise only.
MIN_POWER = 1e-3
FLOOR_POWER = 1e-12
GUARD_SAMPLES = 8
# Sweeps that give the clock of a record of more.
FEW_SWEEPS = 3
# A sweep has one frequency at a time: the mean delay rises, or falls, over so many parts of the band.
DELAY_PARTS = 8


class _SweepCutter:
    """Cuts records into repeats of one nominal sweep, where the clock fitted to the whole record says they are.

    excitation: What was played.
    room_samples: Silence to spare after a response of L taps.
    """

    def __init__(self, excitation: Excitation, room_samples: int) -> None:
        base = excitation.base_v()
        self.period, self.averages = base.size, excitation.averages
        self._guard = min(GUARD_SAMPLES, room_samples // 2)
        nominal = scipy.fft.rfft(base)
        power = np.abs(nominal) ** 2
        band_hz = excitation.start_hz, excitation.stop_hz
        self.bins, self.median_power = filled_bins(power, base.size, band_hz, excitation.sample_rate_hz, MIN_POWER)
        self.omega = 2 * np.pi * np.arange(nominal.size)[self.bins] / base.size
        # Bins without any of the excitation, as those between the lines of a multisine may be, weigh nothing.
        self.power = np.maximum(power[self.bins], FLOOR_POWER * self.median_power)
        late = np.real(scipy.fft.rfft(np.arange(base.size) * base)[self.bins] * nominal[self.bins].conj()) / self.power
        delays = np.diff([part.mean() for part in np.array_split(late, DELAY_PARTS)])
        self.is_swept = bool(np.all(delays > 0) or np.all(delays < 0))
        played = np.tile(base, self.averages)
        # The end of the last silence may lie behind the record's: nothing sounds there.
        self._least = played.size - room_samples - GUARD_SAMPLES
        self._clock = ClockFitter(played[: self._least])
        # Blocks of many repeats are alike: the first sweeps give the clock, near enough for the whole record.
        few = played[: FEW_SWEEPS * base.size]
        self._first_sweeps = ClockFitter(few) if self.averages > FEW_SWEEPS else None

    def cut(
        self, reference: Float32Array, first_record: int
    ) -> tuple[Int64Array, Float64Array, Float64Array, Float64Array]:
        """Find the sweeps in reference recordings (records, samples) in volts; `first_record` counts in messages.

        Sweeps that one clock did not play, as where the player slipped between two, are refused like a signal that is
        absent, too noisy, or not entirely inside.

        Returns int64 (records, averages): first sample of each sweep's segment of one period; offset in samples, clock
        ratio and residual in dB, float64 (records,), as `wavefocus.calibration.known_signal.ClockFit` has them.
        Raises ReferenceMissingError: which record, and why.
        """
        samples = reference.shape[1]
        if samples < (least := max(self._least, self.period)):
            raise InputError(
                f"records have {samples} samples; allowed is at least {least}, {self.averages} sweeps with responses"
            )
        names = [f"the reference of record {first_record + record}" for record in range(len(reference))]
        if (few := self._first_sweeps) is None:
            fits = self._clock.fit_all(reference, names)
        else:
            fits = [self._fit_long(row, few, name) for row, name in zip(reference, names, strict=True)]
        offset, ratio, residual_db = np.array([(fit.offset_samples, fit.ratio, fit.residual_db) for fit in fits]).T
        place = offset[:, None] + ratio[:, None] * self.period * np.arange(self.averages)
        starts = np.clip(np.floor(place).astype(np.int64) - self._guard, 0, samples - self.period)
        return starts, offset, ratio, residual_db

    def _fit_long(self, recording: Float32Array, first_sweeps: ClockFitter, name: str) -> ClockFit:
        """Fit a record of many sweeps, near the clock of its first ones."""
        near = None
        if np.isfinite(recording).all() and recording.any():
            # Without the part where only the later sweeps can be, however the clocks differ.
            later = math.floor((self._least - FEW_SWEEPS * self.period) * (1 - 1e-6 * MAX_PPM))
            part = recording[: recording.size - later]
            with suppress(ReferenceMissingError):
                found = first_sweeps.fit(part, diagnose=False)
                near = found.offset_samples, found.ratio
                # A record with a period to spare holds more sweeps there: one period earlier may be the first.
                while (earlier := near[0] - near[1] * self.period) >= -1:
                    found = first_sweeps.fit(part, diagnose=False, near=(earlier, near[1]))
                    near = found.offset_samples, found.ratio
        return self._clock.fit(recording, name=name, near=near)

    def spectra(self, recording: Float32Array, starts: Int64Array) -> Complex64Array:
        """Spectra (records, averages, bins) of the segments of one period at `starts` (records, averages)."""
        windows = np.lib.stride_tricks.sliding_window_view(recording, self.period, axis=1)
        segments = windows[np.arange(len(recording))[:, None], starts]
        return np.ascontiguousarray(scipy.fft.rfft(segments)[..., self.bins])


# Bounds memory to about 20 MB however many records are given, and to a tenth of a GB however long they are.
BATCH_RECORDS = 32
BATCH_VALUES = 1 << 19
# Elements of a matrix that is decomposed and kept: 64 MiB in float64. What is larger is solved without one.
DENSE_ELEMENTS = 1 << 23


class SequentialEstimator:
    """Averaged H1 from the recorded reference, then least squares for a causal FIR of L taps.

    Everything that is computed once depends only on the configuration, so that the same recordings give the
    same bytes in whatever order they come. Safe to call from several threads.

    excitation: What each record plays.
    taps: Length L of the FIRs, 1 to the excitation's silence.
    channels: How the channels see it.
    schedule: Which actuator in which record, sequential; without it record k is that of actuator k.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self,
        excitation: Excitation,
        taps: int,
        channels: Channels = DIRECT,
        *,
        schedule: Schedule | None = None,
    ) -> None:
        if not 1 <= taps <= excitation.decay_samples:
            raise InputError(
                f"taps is {taps}; allowed is 1 to the silence after each sweep, {excitation.decay_samples} samples"
            )
        if abs(channels.inter_channel_delay_s) * excitation.sample_rate_hz > excitation.decay_samples:
            raise InputError(
                f"inter_channel_delay_s is {channels.inter_channel_delay_s:g}; allowed is at most decay_s either way"
            )
        self.excitation, self.taps = excitation, taps
        self._schedule = schedule
        self._cutter = _SweepCutter(excitation, excitation.decay_samples - taps)
        omega, period = self._cutter.omega, self._cutter.period
        relative = self._cutter.power / self._cutter.median_power
        self._fit = (
            CausalFit(omega, relative, period, taps, RIDGE)
            if 2 * omega.size * taps <= DENSE_ELEMENTS
            else ToeplitzFit(omega, relative, period, taps, RIDGE)
        )
        self._batch = int(min(max(BATCH_VALUES // (excitation.averages * omega.size), 1), BATCH_RECORDS))
        # The sweep's fades reach beyond its band; what hums there does the Green's function no harm.
        hertz = omega * excitation.sample_rate_hz / (2 * np.pi)
        low, high = np.searchsorted(hertz, [excitation.start_hz * (1 - EDGE), excitation.stop_hz * (1 + EDGE)])
        self._in_band = slice(int(low), int(high)) if high - low > hertz.size // 2 else slice(0, hertz.size)
        self._share = (self._in_band.stop - self._in_band.start) / hertz.size
        self._defects = DefectFinder(
            self._in_band, self._cutter.bins.start, period, excitation.averages, excitation.sample_rate_hz, taps,
            freedom=1 - self._fit.rank / self._fit.elements, is_swept=self._cutter.is_swept,
        )  # fmt: skip
        late = channels.inter_channel_delay_s * excitation.sample_rate_hz
        self._in_time = np.exp(-1j * omega * late).astype(np.complex64)
        self._scale = channels.reference_gain * channels.response_per_volt
        self._reference_power = excitation.averages * channels.reference_gain**2

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `wavefocus.calibration.estimator.estimate.PositionEstimator`; if no schedule, any number of records."""
        reference = np.ascontiguousarray(reference_v, dtype=np.float32)
        response = np.ascontiguousarray(response_v, dtype=np.float32)
        records = len(reference) if self._schedule is None else self._schedule.records
        if reference.ndim != 2 or reference.shape != response.shape or len(reference) != records or not records:
            raise InputError(
                f"reference and response have shapes {reference.shape} and {response.shape}; "
                f"allowed is ({records if self._schedule else 'records'}, samples) for both"
            )
        if not all(np.isfinite(end) and end > 0 for end in range_v):
            raise InputError(f"range_v is {range_v}; allowed are two finite numbers above 0")
        loudest = int(np.maximum(response.max(axis=1), -response.min(axis=1)).argmax())
        parts = [
            self._estimate(reference[low : low + self._batch], response[low : low + self._batch], range_v, low, loudest)
            for low in range(0, records, self._batch)
        ]
        found = parts[0] if len(parts) == 1 else Estimate.joined(parts)
        if self._schedule is None:
            return found
        slots = [self._schedule.slots(record) for record in range(records)]
        gain = np.array([slot[2][0] for slot in slots], dtype=np.float32)
        return replace(found, green=found.green / gain[:, None]).by_actuator(
            np.concatenate([slot[0] for slot in slots]), gain
        )

    def _estimate(
        self, reference: Float32Array, response: Float32Array, range_v: tuple[float, float], first: int, loudest: int
    ) -> Estimate:
        levels = measure_levels(reference, response, range_v)
        starts, offset, ratio, slip_db = self._cutter.cut(reference, first)
        x, y = self._cutter.spectra(reference, starts), self._cutter.spectra(response, starts)
        reference_power = energy(x).sum(axis=1)
        transfer = (x.conj() * y).sum(axis=1) / np.maximum(reference_power, np.float32(FLOOR))
        green, whitened = self._fit.solve(transfer * self._in_time, ratio - 1)
        here = self._in_band
        answered = energy(y[..., here]).sum(axis=(1, 2), dtype=np.float64)
        # What one relation to the reference leaves of each sweep.
        differing = y - transfer[:, None] * x
        coherence = np.full(answered.shape, np.nan, np.float32)
        if self.excitation.averages > 1:
            apart = energy(differing[..., here]).sum(axis=(1, 2), dtype=np.float64)
            coherence = (1 - (apart + FLOOR) / (answered + FLOOR)).astype(np.float32)
        whole = energy(transfer[:, here] * self._fit.weight[here]).sum(axis=1, dtype=np.float64)
        left = energy(whitened[:, here]).sum(axis=1, dtype=np.float64)
        variance = left / max(self._share * (self._fit.elements - self._fit.rank), 1.0)
        noise = variance * self._share * self._fit.elements
        gain = reference_power.sum(axis=1, dtype=np.float64) / self._cutter.power.sum()
        missed = whitened / self._fit.weight * self._in_time.conj()
        defects = self._defects.find(response, levels, loudest - first, answered, x, differing, missed)
        defects["slip_db"] = slip_db
        return Estimate(
            green=green * np.float32(self._scale),
            snr_db=decibel(np.maximum(whole - noise, 0), noise),
            residual_db=decibel(left, whole),
            coherence=coherence,
            peak_v=levels.response_v,
            noise_v=np.sqrt(variance * gain * self._cutter.median_power).astype(np.float32),
            clip_count=levels.clip_count,
            offset_samples=offset,
            clock_ratio=ratio,
            defects=defects,
            reference_db=decibel(gain, self._reference_power),
        )
