"""Defects of a record in figures: each says how strong one is beyond chance in what a fit leaves unexplained."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import gammainccinv

from wavefocus.calibration import BoolArray, Complex64Array, Float32Array, Float64Array
from wavefocus.calibration.estimator.clipping import AROUND_SAMPLES, MIN_STEPS, Levels, ThirdHarmonic, converter_steps

_FIGURES = """
burst_db burst_s cut_db cut_s slip_db slip_samples line_db line_hz tail_db step_db step_level_db unsteady_db
harmonic_db steps dead
"""
DEFECTS = np.dtype([(name, np.float32) for name in _FIGURES.split()])
"""Defects of a record; energies are in dB of the response's in band, -inf where chance explains what is there,
NaN where nothing was looked at.

burst_db
    Residual within 5 ms, of the sweep where it is strongest.
burst_s
    When that is, in seconds from the start of the first sweep.
cut_db, cut_s
    Residual within 5 ms that every sweep leaves at the same place, all sweeps together, and when that is, in seconds
    from the start of a sweep: what is cut off in each the same way. NaN for a single sweep. The fit bends to it, so
    that the error of the Green's function is some 15 dB above.
slip_db
    What a jump of the delay between the two channels, from one sweep or part of a sweep to the next, explains
    of the differences between the sweeps.
slip_samples
    That jump, in samples; positive where the response gets later.
line_db, line_hz
    Strongest steady tone in the residual, and its frequency in Hz.
tail_db
    Response after the last of the L taps.
step_db, step_level_db
    Differences between the sweeps that are differences of their level, and the level of the sweep that is farthest from
    the others, in dB. NaN for a single sweep.
unsteady_db
    Differences between the sweeps that noise does not explain: the fit of their mean leaves less than noise of that
    strength would. NaN for a single sweep.
harmonic_db
    Third harmonic over the fundamental at the response's loudest moment.
steps
    Converter steps up to the peak, where there are few and the response's noise is too low to blur them; NaN elsewhere.
dead
    1 where the response channel is constant, else 0.
"""


def not_looked_at(records: int) -> NDArray[np.void]:
    """Figures of records that were not examined: all NaN, shape (records,)."""
    defects = np.zeros(records, DEFECTS)
    for name in _FIGURES.split():
        defects[name] = np.nan
    return defects


def worst_of(defects: NDArray[np.void]) -> np.void:
    """One row of figures for several records of one actuator: each figure's largest, NaN only where all are."""
    worst: np.void = not_looked_at(1)[0]
    for name in _FIGURES.split():
        known = defects[name][~np.isnan(defects[name])]
        if known.size:
            worst[name] = known[np.argmax(np.abs(known))] if name == "slip_samples" else known.max()
    return worst


# Speckle takes the signal away for milliseconds.
BURST_S = 0.005
# Among some 1e9 windows and bins of a campaign none is this far above the floor by chance.
CHANCE = 1e-12
# Clean records of the virtual rig stay 3 dB below the limit that chance alone would set; so do these.
SPARE_DB = 3.0
# A jump of the delay must explain this many times its share of the differences between sweeps; by chance (chi
# squared, one degree of freedom) it is 18 at most in 40,000 records.
SLIP_SIGNIFICANCE = 60.0
# So must a change of level. The noise that is not white raises what chance explains.
STEP_SIGNIFICANCE = 100.0
# Parts of a sweep in each of which the delay between the channels is fitted.
SLIP_PARTS = 8
# Samples are lost one by one, so a jump is a whole number of them, but for one within a part.
SLIP_TOLERANCE = 0.3
# Mean of the residual just after L taps over its floor much later.
TAIL_OVER_FLOOR_DB = 5.0
# So much of what is unexplained must lie there, and be so much more than what differs between the sweeps.
TAIL_SHARE = 0.3
TAIL_OVER_NOISE = 3.0
# Delays at the end of the ring belong to what comes too early, and to the window's leakage.
RING_SHARE = 0.95
# A gap common to all sweeps has the same energy in each, within this.
REPEATED_GAP_SPREAD_DB = 6.0
# A channel is constant when its energy in band is this small against its largest sample's.
DEAD_SHARE = 1e-6
# What raises a record's residual by a quarter gets a closer look: in a clean one of the default run it is 13 % at
# most. With fewer than `MIN_RECORDS` records all are examined: there is no reference.
SUSPICIOUS = 1.25
MIN_RECORDS = 3
# Sweeps that differ by so many times what the fit of their mean leaves differ by more than noise, whatever the other
# records are like: what drifts from sweep to sweep has a mean that the fit explains. Noise alone stays below 1.3 with
# this many free bins.
UNSTEADY = 3.0
MIN_FREE = 64.0
# A tone below this share of the residual raises it by less than 1 dB.
LINE_SHARE = 0.1
# Harmonics are looked for where the response is 28 dB above what its sweeps differ by.
MIN_OVER_NOISE = 10**2.8
# A tone beyond the band that is so many times all that is left in it is what leaks into it.
LEAKS = 3.0
# Steps of a converter are blurred by noise of more than this share of one. Rounding alone has 0.29 of one, and where
# nothing blurs it, it is the same in all sweeps, so that it counts for more in their mean.
BLURS = 0.36
# With 500 steps rounding is at -64 dB of the response.
STEPS_MATTER_DB = -64.0
# Residuals below -75 dB of the response are ignored.
MIN_RESIDUAL_SHARE = 10**-7.5
FLOOR = 1e-30


@dataclass(frozen=True, slots=True)
class Residuals:
    """Spectra of a batch of records in the sweep's band, and what a fit leaves of them.

    response_v, float32 (records, samples): Response channel in volts.
    levels: Its peaks.
    reference, complex64 (records, averages, bins): Spectra of the sweeps on the reference channel.
    reference_power, float32 (records, bins): Their energy, all sweeps together.
    answered_energy, float64 (records,): Energy of the sweeps on the response channel, in the same bins.
    differing, complex64 (records, averages, bins): What one mean transfer function leaves of the response; None for a
        single sweep.
    differing_power, float32 (records, bins): Its energy, all sweeps together.
    transfer, missed, complex64 (records, bins): That mean transfer function, and what of it the FIR of L taps leaves
        unexplained.
    whitened, complex64 (records, bins): `missed` as the fit sees it: white noise is even in it.
    outside, float32 (records, more bins): What is left of the sweeps beyond the band, 0 in it.
    first_outside: Number of the first of these bins.
    """

    response_v: Float32Array
    levels: Levels
    reference: Complex64Array
    reference_power: Float32Array
    answered_energy: Float64Array
    differing: Complex64Array | None
    differing_power: Float32Array | None
    transfer: Complex64Array
    missed: Complex64Array
    whitened: Complex64Array
    outside: Float32Array
    first_outside: int


class DefectFinder:
    """Finds bursts, slips, lines, tails and harmonics in the residuals of sequential records.

    The residual of each sweep is its spectrum minus what the fitted response makes of its reference. White noise
    leaves it even in time and in frequency, and makes it the same in no two sweeps; each defect breaks one of
    these, in a way of its own.

    omega, float64 (bins,): Frequencies in radians per sample, of adjacent bins.
    first_bin: Number of the first of them.
    period: Samples of a sweep with its silence.
    averages: Sweeps in a record.
    sample_rate_hz: Rate in Hz, > 0.
    taps: Length L of the response.
    freedom: Share of white noise that the fit leaves unexplained, 0 to 1.
    delay_rises: Whether the sweep goes upwards, so that higher bins come later.
    is_swept: Whether each moment has one frequency, so that its harmonics are not played.
    """

    def __init__(
        self,
        omega: Float64Array,
        first_bin: int,
        period: int,
        averages: int,
        sample_rate_hz: float,
        taps: int,
        *,
        freedom: float,
        delay_rises: bool,
        is_swept: bool,
    ) -> None:
        self._freedom = freedom
        self._omega = omega.astype(np.float32)
        self._averages = averages
        self._rate_hz = sample_rate_hz
        self._bin_hz = sample_rate_hz / period
        self._first_bin = first_bin
        self._length = scipy.fft.next_fast_len(omega.size)
        self._cell = period / self._length  # samples per cell of the residual's envelope
        self._window = min(max(1, round(BURST_S * sample_rate_hz / self._cell)), self._length)
        # Over the median of a sum of so many exponentially distributed energies; what the mean transfer takes
        # from the residual makes the true limit lower.
        self._burst_limit = _chance_limit(self._window)
        self._cut_limit = _chance_limit(self._window * averages)
        self._line_limit = _chance_limit(averages)
        self._parts = np.linspace(0, omega.size, (SLIP_PARTS if delay_rises else 1) + 1).astype(int)[:-1]
        self._jumps = _jumps(averages, self._parts.size)
        self._is_swept = is_swept
        self._harmonic = ThirdHarmonic(sample_rate_hz, period)
        after = int(np.ceil(taps / self._cell)) + 1
        third = (int(RING_SHARE * self._length) - after) // 3
        self._tail = slice(after, after + third)
        self._late = slice(after + 2 * third, after + 3 * third)

    def find(self, spectra: Residuals) -> NDArray[np.void]:
        """Look through a batch of records: structured array (records,), as `DEFECTS`."""
        missed, reference, transfer = spectra.missed, spectra.reference, spectra.transfer
        differing, differing_power = spectra.differing, spectra.differing_power
        whole = np.maximum(spectra.answered_energy, FLOOR)
        defects = np.zeros(len(missed), DEFECTS)
        defects["steps"] = np.nan
        for name in ("burst_db", "cut_db", "slip_db", "line_db", "tail_db", "step_db", "unsteady_db", "harmonic_db"):
            defects[name] = -np.inf
        defects["dead"] = spectra.answered_energy <= DEAD_SHARE * np.square(spectra.levels.response_v, dtype=np.float64)
        unexplained = energy(missed) * spectra.reference_power
        power = unexplained if differing_power is None else unexplained + differing_power
        self._lines(power, whole, defects)
        # Clipping during a long loud stretch is absorbed by the fit, so the third harmonic is checked by itself.
        left = unexplained if differing_power is None else differing_power
        loud = np.flatnonzero(self._is_swept & (whole > MIN_OVER_NOISE * left.sum(axis=1, dtype=np.float64)))
        defects["harmonic_db"] = np.nan
        defects["harmonic_db"][loud] = self._harmonic(spectra.response_v, spectra.levels.loudest, loud)
        look = np.flatnonzero(self._suspicious(unexplained, differing_power, whole))
        if not look.size:
            return defects
        hums = self._hum_beyond(spectra.outside, spectra.first_outside, power, whole, defects)
        look = look[~hums[look]]
        if not look.size:
            return defects
        closer = defects[look]
        residual = missed[look, None] * reference[look]
        if differing is not None:
            residual += differing[look]
            self._slips(differing[look], reference[look], transfer[look], whole[look], closer)
            self._steps(differing[look], reference[look], transfer[look], whole[look], closer)
        else:
            closer["slip_db"] = closer["cut_db"] = closer["step_db"] = closer["unsteady_db"] = np.nan
        self._bursts(residual, whole[look], closer)
        noise = None
        if differing_power is not None:
            noise = differing_power[look].sum(axis=1, dtype=np.float64) / (self._averages - 1)
            beyond = self._beyond_noise(unexplained[look].sum(axis=1, dtype=np.float64), noise)
            closer["unsteady_db"] = np.where(beyond > 0, _db(self._averages * beyond, whole[look]), -np.inf)
        self._tails(spectra.whitened[look], unexplained[look], noise, whole[look], closer)
        defects[look] = closer
        return defects

    def _suspicious(
        self, unexplained: Float32Array, differing_power: Float32Array | None, whole: Float64Array
    ) -> BoolArray:
        """Which records are worth a closer look.

        In all others the fit leaves no more than the sweeps differ by, and they differ by no more than in the
        quietest record: whatever is wrong there is less than a third of the noise. Or else it is too little
        against the response to matter.
        """
        left = unexplained.sum(axis=1, dtype=np.float64)
        if differing_power is None:
            return np.asarray(left > MIN_RESIDUAL_SHARE * whole)
        differing = differing_power.sum(axis=1, dtype=np.float64)
        matters = left + differing > MIN_RESIDUAL_SHARE * whole
        if len(whole) < MIN_RECORDS:
            return np.asarray(matters)
        noise = differing / (self._averages - 1)
        unsteady = self._beyond_noise(left, noise) > 0
        measurable = noise[noise > FLOOR]
        quietest = measurable.min() if measurable.size else 0.0
        return np.asarray(
            matters & (unsteady | (left > SUSPICIOUS * self._freedom * noise) | (noise > SUSPICIOUS * quietest))
        )

    def _beyond_noise(self, left: Float64Array, differing: Float64Array) -> Float64Array:
        """Energy per sweep that differs and is not noise; 0 where noise explains it.

        left, differing, float64 (records,): What the fit leaves of the mean, and what the sweeps differ by, per sweep.
        """
        if 2 * self._omega.size * self._freedom < MIN_FREE:
            return np.zeros_like(differing)
        noise = left / self._freedom
        return np.where(differing > UNSTEADY * noise, differing - noise, 0.0)

    def _bursts(self, residual: Complex64Array, whole: Float64Array, defects: NDArray[np.void]) -> None:
        """Where in time the residual stands out, in one sweep or in all of them alike."""
        envelope = energy(scipy.fft.ifft(residual, self._length, axis=-1))
        within = _moving_sum(envelope, self._window)
        rows = np.arange(len(residual))
        # In energy of the residual's spectrum, as `whole` is.
        scale = float(self._length)
        cut = np.zeros(within.shape[::2], dtype=bool)
        if self._averages > 1:
            together = within.sum(axis=1)
            place = together.argmax(axis=1)
            each = within[rows, :, place]
            strongest = together[rows, place]
            found = strongest > self._cut_limit * _median(together[:, :: 3 * self._window])
            found &= each.min(axis=1) > 10 ** (-0.1 * REPEATED_GAP_SPREAD_DB) * each.max(axis=1)
            defects["cut_db"] = np.where(found, _db(strongest * scale, whole), -np.inf)
            defects["cut_s"] = (place + 0.5 * self._window) * self._cell / self._rate_hz
            cut = found[:, None] & (np.abs(np.arange(within.shape[2]) - place[:, None]) <= 2 * self._window)
        floor = _median(within[..., :: 3 * self._window])
        within = np.where(cut[:, None], np.float32(0), within)
        place = within.argmax(axis=-1)
        height = np.take_along_axis(within, place[..., None], -1)[..., 0]
        sweep = height.argmax(axis=1)
        strongest, at = height[rows, sweep], place[rows, sweep]
        found = strongest > self._burst_limit * floor
        defects["burst_db"] = np.where(found, _db(strongest * scale, whole), -np.inf)
        defects["burst_s"] = (sweep * self._length + at + 0.5 * self._window) * self._cell / self._rate_hz

    def _lines(self, power: Float32Array, whole: Float64Array, defects: NDArray[np.void]) -> None:
        """Where in frequency the residual stands out; `power` is that of all sweeps together."""
        floor = _median(power[:, ::3])
        total = power.sum(axis=1)
        highest_power = power.max(axis=1)
        for record in np.flatnonzero((highest_power > self._line_limit * floor) & (highest_power > LINE_SHARE * total)):
            highest = int(power[record].argmax())
            # A tone between two bins shows in both.
            around = power[record, max(highest - 1, 0) : highest + 2].sum(dtype=np.float64)
            defects["line_db"][record] = _db(around, whole[record])
            defects["line_hz"][record] = (self._first_bin + highest) * self._bin_hz

    def _hum_beyond(
        self,
        outside: Float32Array,
        first_outside: int,
        power: Float32Array,
        whole: Float64Array,
        defects: NDArray[np.void],
    ) -> BoolArray:
        """Which records hum beyond the band so loudly that this explains what is left in it: a tone leaks there."""
        rows = np.arange(len(outside))
        left = power.sum(axis=1, dtype=np.float64)
        highest = outside.argmax(axis=1)
        leaks = outside[rows, highest] > LEAKS * left
        defects["line_db"][leaks] = _db(left[leaks], whole[leaks])
        defects["line_hz"][leaks] = (first_outside + highest[leaks]) * self._bin_hz
        return np.asarray(leaks)

    def _slips(
        self,
        differing: Complex64Array,
        reference: Complex64Array,
        transfer: Complex64Array,
        whole: Float64Array,
        defects: NDArray[np.void],
    ) -> None:
        """Whether the differences between the sweeps are those of a delay that jumps once."""
        records = len(differing)
        later = (np.complex64(-1j) * self._omega * transfer)[:, None] * reference  # what one sample of delay adds
        strength = np.add.reduceat(energy(later), self._parts, axis=-1).reshape(records, -1).astype(np.float64)
        np.conjugate(later, out=later)
        later *= differing
        matched = np.add.reduceat(later.real, self._parts, axis=-1).reshape(records, -1).astype(np.float64)
        projected = matched @ self._jumps.T
        norm = np.maximum(strength @ np.square(self._jumps).T, FLOOR)
        explained = np.square(projected) / norm
        best = explained.argmax(axis=1)
        rows = np.arange(records)
        gained, jump = explained[rows, best], projected[rows, best] / norm[rows, best]
        spread = np.maximum(energy(differing).sum(axis=(1, 2), dtype=np.float64), FLOOR)
        freedom = 2 * self._omega.size * (self._averages - 1)
        whole_samples = np.rint(jump)
        found = gained * freedom > SLIP_SIGNIFICANCE * spread
        found &= (whole_samples != 0) & (np.abs(jump - whole_samples) < SLIP_TOLERANCE * np.abs(whole_samples))
        defects["slip_db"] = np.where(found, _db(gained, whole), -np.inf)
        defects["slip_samples"] = jump

    def _steps(
        self,
        differing: Complex64Array,
        reference: Complex64Array,
        transfer: Complex64Array,
        whole: Float64Array,
        defects: NDArray[np.void],
    ) -> None:
        """Whether the differences between the sweeps are those of their level."""
        mean = transfer[:, None] * reference
        strength = np.maximum(energy(mean).sum(axis=-1).astype(np.float64), FLOOR)
        over = (mean.conj() * differing).real.sum(axis=-1).astype(np.float64) / strength
        gained = np.square(over) * strength
        spread = np.maximum(energy(differing).sum(axis=-1).astype(np.float64) - gained, FLOOR)
        freedom = 2 * self._omega.size
        # Something that happens in one sweep is not its level: then the others differ less.
        found = gained.max(axis=1) * freedom > STEP_SIGNIFICANCE * spread.max(axis=1)
        defects["step_db"] = np.where(found, _db(gained.sum(axis=1), whole), -np.inf)
        farthest = np.abs(over).argmax(axis=1)[:, None]
        level = np.take_along_axis(over, farthest, 1)[:, 0]
        others = (over.sum(axis=1) - level) / max(self._averages - 1, 1)
        defects["step_level_db"] = 20 * np.log10(np.maximum(1 + level, 1e-3) / np.maximum(1 + others, 1e-3))

    def _tails(
        self,
        whitened: Complex64Array,
        unexplained: Float32Array,
        noise: Float64Array | None,
        whole: Float64Array,
        defects: NDArray[np.void],
    ) -> None:
        """Whether there is more response just after L taps than much later."""
        if self._late.stop - self._late.start < 8:
            return
        delays = energy(scipy.fft.ifft(whitened, self._length, axis=-1))
        floor = _median(delays[:, self._late]) / np.log(2)
        over = delays[:, self._tail].mean(axis=1) / np.maximum(floor, FLOOR)
        total = np.maximum(delays.sum(axis=1), FLOOR)
        share = np.maximum(delays[:, self._tail].sum(axis=1) - floor * (self._tail.stop - self._tail.start), 0) / total
        found = (over > 10 ** (0.1 * TAIL_OVER_FLOOR_DB)) & (share > TAIL_SHARE)
        if noise is not None:
            # A passing event also spreads over all delays, but differs from sweep to sweep as much.
            found &= unexplained.sum(axis=1, dtype=np.float64) > TAIL_OVER_NOISE * self._freedom * noise
        defects["tail_db"] = np.where(found, _db(share * unexplained.sum(axis=1, dtype=np.float64), whole), -np.inf)


def few_steps(
    response_v: Float32Array, levels: Levels, noise_v: Float64Array, residual_db: Float32Array, averages: int
) -> Float32Array:
    """Converter steps of records that reach few and whose noise does not blur them, (records,); NaN elsewhere.

    noise_v, residual_db, (records,): See `Estimate`.
    """
    steps, blurs = np.full(len(response_v), np.nan, np.float32), BLURS * np.sqrt(averages)
    for record in np.flatnonzero(residual_db > STEPS_MATTER_DB).tolist():
        around = slice(
            max(0, int(levels.loudest[record]) - AROUND_SAMPLES), int(levels.loudest[record]) + AROUND_SAMPLES
        )
        found = converter_steps(response_v[record, around])
        if 0 < found < MIN_STEPS and noise_v[record] * found < blurs * levels.response_v[record]:
            steps[record] = found
    return steps


def _chance_limit(terms: int) -> float:
    """How far the largest sum of `terms` exponentially distributed energies may be above the median one."""
    return float(gammainccinv(terms, CHANCE) / gammainccinv(terms, 0.5)) * 10 ** (0.1 * SPARE_DB)


def _jumps(averages: int, parts: int) -> Float64Array:
    """Each jump between two neighbouring parts, less what the mean over the sweeps takes of it."""
    time = np.arange(averages * parts)
    steps = (time >= np.arange(1, max(2, time.size))[:, None]).astype(np.float64).reshape(-1, averages, parts)
    return np.asarray((steps - steps.mean(axis=1, keepdims=True)).reshape(-1, time.size))


def _moving_sum(values: Float32Array, window: int) -> Float32Array:
    if window <= 8:
        count = values.shape[-1] - window + 1
        total = values[..., :count].copy()
        for shift in range(1, window):
            total += values[..., shift : shift + count]
        return total
    running = np.cumsum(values, axis=-1, dtype=np.float64)
    within = running[..., window - 1 :].copy()
    within[..., 1:] -= running[..., :-window]
    return within.astype(np.float32)


def _median(values: Float32Array) -> Float32Array:
    """Median of each row, all but its first axis taken as one."""
    rows = values.reshape(values.shape[0], -1)
    middle = rows.shape[1] // 2
    return np.asarray(np.partition(rows, middle, axis=1)[:, middle])


def energy(values: Complex64Array) -> Float32Array:
    """Squared magnitudes."""
    return np.square(values.real) + np.square(values.imag)


def _db(part: NDArray[np.floating], whole: Float64Array) -> Float64Array:
    return np.asarray(10 * np.log10(np.maximum(part, FLOOR) / whole))
