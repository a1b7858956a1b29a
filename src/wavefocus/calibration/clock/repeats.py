"""Where each sweep lies in a record, and its spectrum, from only the reference channel."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.clock.known_signal import filled_bins
from wavefocus.calibration.clock.missing_reference import ReferenceMissingError
from wavefocus.calibration.clock.timing import ClockFit, ClockFitter
from wavefocus.calibration.excitation import Excitation
from wavefocus.storage.errors import InputError

# Bins whose nominal energy is below this share of the median in band carry noise only.
MIN_POWER = 1e-3
FLOOR_POWER = 1e-12
GUARD_SAMPLES = 8
# Sweeps that give the clock of a record of more, and the samples around them that are looked at.
FEW_SWEEPS, FIRST_MARGIN = 3, 200
# A sweep has one frequency at a time: the mean delay rises, or falls, over so many parts of the band.
DELAY_PARTS = 8


@dataclass(frozen=True, slots=True)
class Repeats:
    """The sweeps of a batch of records.

    starts, int64 (records, averages): First sample of each sweep's segment of one period.
    spectra, complex64 (records, averages, bins): Spectra of the reference's segments in the bins of the band.
    offset_samples, ratio, residual_db, float64 (records,): As in `wavefocus.calibration.clock.timing.ClockFit`.
    """

    starts: Int64Array
    spectra: Complex64Array
    offset_samples: Float64Array
    ratio: Float64Array
    residual_db: Float64Array


class SweepCutter:
    """Cuts records into repeats of one nominal sweep, where the clock fitted to the whole record says they are.

    excitation: What was played.
    room_samples: Silence to spare after a response of L taps.
    max_ppm: Largest clock skew in parts per million.
    """

    def __init__(self, excitation: Excitation, room_samples: int, max_ppm: float) -> None:
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
        self._clock = ClockFitter(played[: self._least], max_ppm=max_ppm)
        # Blocks of many repeats are alike: the first sweeps give the clock, near enough for the whole record.
        few = played[: FEW_SWEEPS * base.size]
        self._first_sweeps = ClockFitter(few, max_ppm=max_ppm) if self.averages > FEW_SWEEPS else None

    def cut(self, reference: Float32Array, first_record: int = 0) -> Repeats:
        """Find the sweeps in reference recordings (records, samples) in volts; `first_record` counts in messages.

        Sweeps that one clock did not play, as where the player slipped between two, are refused like a signal that is
        absent, too noisy, or not entirely inside.

        Raises ReferenceMissingError: which record, and why.
        """
        samples = reference.shape[1]
        if samples < max(self._least, self.period):
            raise InputError(
                f"records have {samples} samples; allowed is at least {max(self._least, self.period)}, "
                f"{self.averages} sweeps with their responses"
            )
        names = [f"the reference of record {first_record + record}" for record in range(len(reference))]
        if self._first_sweeps is None:
            fits = self._clock.fit_all(reference, names)
        else:
            fits = [
                self._fit_long(recording, self._first_sweeps, name)
                for recording, name in zip(reference, names, strict=True)
            ]
        offset, ratio = np.array([(fit.offset_samples, fit.ratio) for fit in fits]).T
        place = offset[:, None] + ratio[:, None] * self.period * np.arange(self.averages)
        starts = np.clip(np.floor(place).astype(np.int64) - self._guard, 0, samples - self.period)
        residual_db = np.array([fit.residual_db for fit in fits])
        return Repeats(starts, self.spectra(reference, starts), offset, ratio, residual_db)

    def _fit_long(self, recording: Float32Array, first_sweeps: ClockFitter, name: str) -> ClockFit:
        """Fit a record of many sweeps, near the clock of its first ones."""
        near = None
        if np.isfinite(recording).all() and recording.any():
            length = scipy.fft.next_fast_len(recording.size, real=True)
            place = self._clock.search.top(scipy.fft.rfft(recording, length), length)
            low = max(round(place) - FIRST_MARGIN, 0)
            part = recording[low : low + FEW_SWEEPS * self.period + 2 * FIRST_MARGIN]
            with suppress(ReferenceMissingError):
                found = first_sweeps.fit(part, diagnose=False)
                near = low + found.offset_samples, found.ratio
        return self._clock.fit(recording, name=name, near=near)

    def spectra(self, recording: Float32Array, starts: Int64Array) -> Complex64Array:
        """Spectra (records, averages, bins) of the segments of one period at `starts` (records, averages)."""
        windows = np.lib.stride_tricks.sliding_window_view(recording, self.period, axis=1)
        segments = windows[np.arange(len(recording))[:, None], starts]
        return np.ascontiguousarray(scipy.fft.rfft(segments)[..., self.bins])
