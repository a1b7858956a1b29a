"""Where each sweep lies in a record, and its spectrum, from only the reference channel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.clock.known_signal import CORNERS, REFERENCE_LIMIT, filled_bins, require_found
from wavefocus.calibration.clock.period_spectrum import BandSpectrum
from wavefocus.calibration.clock.timing import check_inside
from wavefocus.calibration.excitation import Excitation
from wavefocus.calibration.numerics import fourier_sum, parabola_vertex
from wavefocus.storage.errors import InputError

# Bins whose nominal energy is below this share of the median in band carry noise only.
MIN_POWER = 1e-3
FLOOR_POWER = 1e-12
# Repeats that are not evenly spaced mean that the player slipped; then each sweep's own stretch counts. Two
# are always even, and are held against their own stretch instead.
SLIP_SAMPLES = 0.05
SLIP_PPM = 25.0
# A segment may begin this many samples off its sweep before it is cut anew.
MISPLACED_SAMPLES = 4.0
GUARD_SAMPLES = 8
# The clock is known far better than needed, so that every eighth bin is enough for it.
BIN_STEP = 8
# Excitation go upwards when the mean delay rises over so many parts of the band.
DELAY_PARTS = 8
# Where a clock skew turns the ends of the band by more than this against its middle, in radians, phases wrap and the
# skew is searched for in such steps.
WRAP_TURN = 1.5
# A reference that the linear curves do not explain is compared with the stretched excitation, so many times at most.
# The stretch comes from the repeats' distances and from their own phases in turn. Phases of noise and of multisines
# bend far from those curves.
REFINEMENTS = 5
# A stretch that turns phases by less than this beyond any delay, in radians (rms) per unit, does not show in one
# repeat.
MIN_BEND = 40.0
# A segment begins near its sweep, so fewer bins are enough for the distance: modulo the period over this.
SEGMENT_BIN_STEP = 8
# The first guess of the start may be wrong by samples; it is taken from a recording decimated this close to aliasing.
GUESS_BANDS = 2.2


@dataclass(frozen=True, slots=True)
class Repeats:
    """The sweeps of a batch of records.

    starts, int64 (records, averages): First sample of each sweep's segment of one period.
    spectra, complex64 (records, averages, bins): Spectra of the reference's segments in the bins of the band.
    offset_samples, ratio, float64 (records,): As in `wavefocus.calibration.clock.timing.ClockFit`.
    """

    starts: Int64Array
    spectra: Complex64Array
    offset_samples: Float64Array
    ratio: Float64Array


class RepeatFinder:
    """Cut records into repeats of one nominal sweep and fit the clocks' ratio to their phases.

    The phase of segment over nominal spectrum is a sum of known curves: the frequency (delay), the frequency times the
    nominal group delay (stretch by the clock ratio), and what coupling capacitors turn. Any excitation that is repeated
    will do; where all its energy comes at once, only the repeats' distances show the clocks' ratio.

    excitation: What was played.
    room_samples: Silence to spare after a response of L taps.
    max_ppm: Largest clock skew in parts per million.
    """

    def __init__(self, excitation: Excitation, room_samples: int, max_ppm: float) -> None:
        base = excitation.base_v()
        self.period = base.size
        self.averages = excitation.averages
        self.max_ppm = max_ppm
        self._guard = min(GUARD_SAMPLES, room_samples // 2)
        # The end of the last silence may lie behind the record's: nothing sounds there.
        self._least = self.averages * base.size - room_samples - GUARD_SAMPLES
        self._base = base
        nominal = scipy.fft.rfft(base)
        slope = -1j * scipy.fft.rfft(np.arange(base.size) * base)
        power = np.abs(nominal) ** 2
        band_hz = excitation.start_hz, excitation.stop_hz
        self.bins, self.median_power = filled_bins(power, base.size, band_hz, excitation.sample_rate_hz, MIN_POWER)
        self._spectrum = BandSpectrum(base.size, self.bins)
        most = max(1, int(base.size / (GUESS_BANDS * self.bins.stop)))
        self._guess_decimation = max(step for step in range(1, most + 1) if base.size % step == 0)
        self.omega = 2 * np.pi * np.arange(nominal.size)[self.bins] / base.size
        self._nominal = nominal[self.bins].astype(np.complex64)
        self._omega32 = self.omega[::BIN_STEP].astype(np.float32)
        # Bins without any of the excitation, as those between the lines of a multisine may be, weigh nothing.
        self.power = np.maximum(power[self.bins], FLOOR_POWER * self.median_power)
        stretch = self.omega * np.imag(slope[self.bins] * nominal[self.bins].conj() / self.power)
        # Whether higher frequencies come later, eighth of the band by eighth: so that bins stand for times.
        delays = [part.mean() for part in np.array_split(-stretch / self.omega, DELAY_PARTS)]
        self.delay_rises = bool(np.all(np.diff(delays) > 0))
        self.is_swept = self.delay_rises or bool(np.all(np.diff(delays) < 0))
        # Coupling capacitors turn low frequencies; unmodelled, a corner of 2 Hz passes for 20 ppm.
        lowest = 2 * np.pi * excitation.start_hz / excitation.sample_rate_hz
        turns = [np.arctan(share * lowest / self.omega) for share in CORNERS]
        # How far a stretch bends the phases beyond any delay. All sounds within the period, so that no bin's energy is
        # further than that from the others'; a group delay that is lies in a gap of the spectrum and means nothing.
        line = np.polyfit(self.omega, stretch, 1, w=np.sqrt(self.power))
        furthest = self.omega * base.size
        bent = np.clip(stretch - np.polyval(line, self.omega), -furthest, furthest)
        bend = float(np.ptp(bent)) + 1e-30
        self._shows_stretch = float(np.average(np.square(bent), weights=self.power)) > MIN_BEND**2
        curves = np.stack([-self.omega, stretch, *turns])[:, ::BIN_STEP]
        weighted = curves * self.power[::BIN_STEP]
        self._curves = curves.astype(np.float32)
        steps = math.floor(1e-6 * max_ppm * bend / WRAP_TURN)
        self._tried = WRAP_TURN / bend * np.array(sorted(range(-steps, steps + 1), key=abs))
        fitted = np.array([True, self._shows_stretch, *(True for _ in CORNERS)])
        self._solve = np.zeros(weighted.T.shape)
        self._solve[:, fitted] = np.linalg.solve(weighted[fitted] @ curves[fitted].T, weighted[fitted]).T

    def find(self, reference: Float32Array, first_record: int = 0) -> Repeats:
        """Find the repeats in reference recordings.

        reference, float32 (records, samples): Reference channel in volts.
        first_record: Number of the first record, for messages.

        Returns Repeats. Raises ReferenceMissingError: a record in which the signal is absent, too noisy, or not
        entirely inside.
        """
        records, samples = reference.shape
        if samples < max(self._least, self.period):
            raise InputError(
                f"records have {samples} samples; allowed is at least {max(self._least, self.period)}, "
                f"{self.averages} sweeps with their responses"
            )
        first = np.floor(self._first_guess(reference)).astype(np.int64) - self._guard
        starts = self._limited(first[:, None] + self.period * np.arange(self.averages), samples)
        spectra = self.segment_spectra(reference, starts)
        near = np.zeros(records)
        delay, stretch, explained = self._phase_fit(spectra, near)
        unexplained = np.flatnonzero(~(explained > 1 - REFERENCE_LIMIT))
        if unexplained.size and self._tried.size > 1:
            near[unexplained] = self._searched_stretch(spectra[unexplained, 0])
        for refinement in range(REFINEMENTS):
            if not unexplained.size:
                break
            begin = np.floor(starts + delay)[unexplained, :1] - self._guard
            apart = self.period * (1 + near[unexplained, None]) * np.arange(self.averages)
            cut = self._limited(np.rint(begin + apart).astype(np.int64), samples)
            segments = self.segment_spectra(reference[unexplained], cut)
            late, slower, share = self._phase_fit(segments, near[unexplained])
            better = share > explained[unexplained]
            which = unexplained[better]
            starts[which], spectra[which], explained[which] = cut[better], segments[better], share[better]
            delay[which], stretch[which] = late[better], slower[better]
            unexplained = unexplained[~(explained[unexplained] > 1 - REFERENCE_LIMIT)]
            near[unexplained] = self._likely_stretch(starts + delay, stretch, by_distance=refinement % 2 == 0)[
                unexplained
            ]
        misplaced = np.abs(delay - self._guard).max(axis=1) > MISPLACED_SAMPLES
        misplaced &= explained > 1 - REFERENCE_LIMIT
        if misplaced.any():
            place = np.floor(starts + delay).astype(np.int64)[misplaced] - self._guard
            starts[misplaced] = self._limited(place, samples)
            spectra[misplaced] = self.segment_spectra(reference[misplaced], starts[misplaced])
            delay[misplaced], stretch[misplaced], explained[misplaced] = self._phase_fit(
                spectra[misplaced], near[misplaced]
            )
        offset, ratio = self._clock(starts + delay, stretch)
        for record in range(records):
            name = f"the reference of record {first_record + record}"
            require_found(explained[record], ratio[record], reference[record], self._base, name, self.max_ppm)
            check_inside(offset[record], ratio[record], self._least, samples, name)
        return Repeats(starts, spectra, offset, ratio)

    def segment_spectra(self, recording: Float32Array, starts: Int64Array) -> Complex64Array:
        """Spectra (records, averages, bins) of the segments of one period at `starts` (records, averages)."""
        return self._spectrum(recording, starts)

    def _first_guess(self, reference: Float32Array) -> Float64Array:
        records, samples = reference.shape
        folded = np.zeros((records, self.period // self._guess_decimation), dtype=np.float32)
        for begin in range(0, samples, self.period):
            piece = reference[:, begin : begin + self.period : self._guess_decimation]
            folded[:, : piece.shape[1]] += piece
        guess = self._coarse_delay(scipy.fft.rfft(folded, overwrite_x=True)[:, self.bins])
        length = self._least
        # The fold shows the start but for whole periods; the one with most energy inside is meant.
        for record in range(records):
            starts = np.arange(guess[record] - self.period, samples - length + self.period / 2, self.period)
            inside = starts[(starts > -GUARD_SAMPLES) & (starts + length < samples + GUARD_SAMPLES)]
            if inside.size > 1:
                energy = [np.square(reference[record, max(int(s), 0) : int(s) + length]).sum() for s in inside]
                guess[record] = inside[int(np.argmax(energy))]
            elif inside.size == 1:
                guess[record] = inside[0]
        return guess

    def _limited(self, starts: Int64Array, samples: int) -> Int64Array:
        return np.clip(starts, 0, samples - self.period)

    def _coarse_delay(
        self, spectra: Complex64Array, bin_step: int = 1, nominal: Complex64Array | None = None
    ) -> Float64Array:
        """Delay in samples, 0 to the period over `bin_step`, from the envelope of the cross-correlation."""
        length = scipy.fft.next_fast_len(2 * -(-self.omega.size // bin_step))
        cross = spectra[..., ::bin_step] * (self._nominal if nominal is None else nominal)[..., ::bin_step].conj()
        correlation = scipy.fft.ifft(cross, length, overwrite_x=True)
        # The square has its top where the envelope has it, at a tenth of the cost.
        envelope = np.square(correlation.real) + np.square(correlation.imag)
        top = np.argmax(envelope, axis=-1)[..., None]
        around = [
            np.take_along_axis(envelope, (top + step) % length, -1)[..., 0].astype(np.float64) for step in (-1, 0, 1)
        ]
        return np.asarray((top[..., 0] + parabola_vertex(*around)) % length * (self.period / (bin_step * length)))

    def _searched_stretch(self, spectra: Complex64Array) -> Float64Array:
        """The stretch, of those tried, at which each segment (records, bins) correlates best with its sweep."""
        cross = spectra[:, ::BIN_STEP] * self._nominal[::BIN_STEP].conj()
        length = scipy.fft.next_fast_len(2 * cross.shape[1])
        best, highest = np.zeros(len(spectra)), np.zeros(len(spectra))
        for tried in self._tried.tolist():
            turned = scipy.fft.ifft(cross * np.exp(np.float32(-tried) * 1j * self._curves[1]), length, overwrite_x=True)
            top = np.abs(turned).max(axis=1)
            better = top > highest
            best[better], highest[better] = tried, top[better]
        return best

    def _phase_fit(
        self, spectra: Complex64Array, near: Float64Array
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Delay in samples and stretch of each segment, and the share of a record's energy they explain.

        `near` (records,) is a stretch of each record, with which its segments are compared.
        """
        nominal = self._nominal
        if near.any():
            nominal = np.stack([self._stretched(skew) for skew in near.tolist()])[:, None]
        coarse = self._coarse_delay(spectra, SEGMENT_BIN_STEP, nominal)
        span = self.period / SEGMENT_BIN_STEP
        coarse = np.where(coarse > span / 2, coarse - span, coarse)
        decimated = spectra[..., ::BIN_STEP]
        cross = decimated * nominal[..., ::BIN_STEP].conj()
        cross *= np.exp(1j * self._omega32 * coarse[..., None].astype(np.float32))
        # Crossed wires turn every phase by half a turn.
        cross *= np.where(cross.real.sum(axis=-1, keepdims=True) < 0, -1, 1).astype(np.float32)
        fitted = np.angle(cross) @ self._solve
        turn = np.exp(-1j * (fitted.astype(np.float32) @ self._curves))
        matched = (cross * turn).real.sum(axis=-1).astype(np.float64)
        energy = (np.square(decimated.real) + np.square(decimated.imag)).sum(axis=-1).astype(np.float64)
        share = matched**2 / np.maximum(energy * self.power[::BIN_STEP].sum(), 1e-300)
        return coarse + fitted[..., 0], fitted[..., 1] + near[:, None], share.min(axis=-1)

    def _stretched(self, stretch: float) -> Complex64Array:
        """Spectrum (bins,) of the excitation played by a clock that is slower by this share."""
        turn = 2 * np.pi / self.period * (1 + stretch)
        return fourier_sum(self._base, turn, self.bins.start, self.omega.size).astype(np.complex64)

    def _likely_stretch(self, place: Float64Array, stretch: Float64Array, *, by_distance: bool) -> Float64Array:
        """Stretch (records,) by the distances of the repeats, where there are several, or by their own phases."""
        found = stretch.mean(axis=1)
        if by_distance and self.averages > 1:
            found = (place[:, -1] - place[:, 0]) / (self.period * (self.averages - 1)) - 1
        return np.asarray(np.clip(found, -1e-6 * self.max_ppm, 1e-6 * self.max_ppm))

    def _clock(self, place: Float64Array, stretch: Float64Array) -> tuple[Float64Array, Float64Array]:
        own = 1 + stretch.mean(axis=1)
        if self.averages == 1:
            return place[:, 0], own
        nominal = self.period * np.arange(self.averages)
        lever = nominal - nominal.mean()
        spaced = place @ lever / (lever @ lever)
        late = place - spaced[:, None] * nominal
        start = late.mean(axis=1)
        if not self._shows_stretch:
            return start, spaced
        if self.averages == 2:
            slipped = np.abs(spaced - own) > 1e-6 * SLIP_PPM
        else:
            slipped = np.abs(late - start[:, None]).max(axis=1) > SLIP_SAMPLES
        return np.where(slipped, place[:, 0], start), np.where(slipped, own, spaced)
