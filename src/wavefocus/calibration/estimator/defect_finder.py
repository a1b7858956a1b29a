"""What is wrong with a record, in figures: flat tops, one harmonic, what its fit leaves, how its sweeps agree."""

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.calibration import Complex64Array, Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.evidence import CLEAR_DB, MOST, SIGMAS
from wavefocus.storage.errors import InputError

# Gain errors of converters: 0.04 to 0.2 % of the range (MCC USB-1608FS, USB-1208FS).
CLIP_SHARE = 0.999
# A flat top: this many samples within 0.1 % of the recording's own peak, and a quarter of all within 3 %.
# A sine has 18 % of them there, noise and sweeps over resonances 5 %.
MIN_FLAT = 8
# Where a sweep is cut off, it is cut off many times running: this much on both sides of the peak shows it.
AROUND_SAMPLES = 4096
BELOW_SHARE = 0.97
# With fewer converter steps up to a recording's peak, the top 0.1 % are half a step, and every top is flat.
MIN_STEPS = 0.5 / (1 - CLIP_SHARE)


@dataclass(frozen=True, slots=True)
class _Levels:
    """Peaks of records, and what of them is clipped.

    reference_v, response_v, float32 (records,): Largest magnitudes in volts.
    loudest, int64 (records,): Sample of the response's.
    clip_count, int32 (records,): Clipped samples of both channels.
    """

    reference_v: Float32Array
    response_v: Float32Array
    loudest: Int64Array
    clip_count: NDArray[np.int32]


def measure_levels(
    reference_v: Float32Array, response_v: Float32Array, range_v: tuple[float, float], name: str = "a recording"
) -> _Levels:
    """Measure records (records, samples) on converters that end at `range_v` on (reference, response).

    Raises InputError: values that are not finite.
    """
    (reference_peak, reference_place), (peak, place) = _peaks(reference_v), _peaks(response_v)
    if not (np.isfinite(reference_peak).all() and np.isfinite(peak).all()):
        raise InputError(f"{name} holds values that are not finite; allowed are volts")
    clipped = _count_clipped(reference_v, reference_peak, reference_place, range_v[0])
    return _Levels(reference_peak, peak, place, clipped + _count_clipped(response_v, peak, place, range_v[1]))


def _peaks(channel: Float32Array) -> tuple[Float32Array, Int64Array]:
    rows = np.arange(channel.shape[0])
    highest = np.array([recording.argmax() for recording in channel])
    lowest = np.array([recording.argmin() for recording in channel])
    up, down = channel[rows, highest], -channel[rows, lowest]
    return np.maximum(up, down), np.where(up >= down, highest, lowest)


def _count_clipped(channel: Float32Array, peak_v: Float32Array, place: Int64Array, range_v: float) -> NDArray[np.int32]:
    """Count samples at 0.999 of the range or beyond, or else those of a flat top below it.

    A flat top blurred by noise that was added after it is not seen; the fit's residual shows it then.
    """
    count = np.zeros(channel.shape[0], dtype=np.int32)
    for record, peak in enumerate(peak_v):
        level = range_v
        if peak < CLIP_SHARE * range_v:
            level = float(peak)
            around = channel[record, max(0, place[record] - AROUND_SAMPLES) : place[record] + AROUND_SAMPLES]
            top = _beyond(around, CLIP_SHARE * level)
            if top < MIN_FLAT or 4 * top <= _beyond(around, BELOW_SHARE * level):
                continue
            if _converter_steps(around) < MIN_STEPS:
                continue
        count[record] = _beyond(channel[record], CLIP_SHARE * level)
    return count


def _converter_steps(recording: Float32Array) -> float:
    """How many steps of its converter a recording in volts reaches; 0 for silence, infinite where it has no steps."""
    levels = np.unique(recording)
    if levels.size < 2:
        return 0.0
    return float(np.abs(levels).max() / np.diff(levels).min())


def _beyond(recording: Float32Array, level_v: float) -> int:
    """Samples of this magnitude or more; two comparisons cost a fifth of one array of magnitudes."""
    level = np.float32(level_v)
    return int(np.count_nonzero(recording >= level) + np.count_nonzero(recording <= -level))


# Long enough for a few periods, short enough for a sweep to stay on one frequency.
WINDOW_S = 0.0256
# In bins of the window: below, the fundamental's skirt reaches the third harmonic.
MIN_BIN = 3
# The harmonic must stand this far above the noise, which is taken from the upper half of the spectrum.
OVER_FLOOR = 16.0
# Between these a second look decides.
UNSURE_DB = -72.0
SURE_DB = -36.0
FLOOR = 1e-30


def _third_harmonic_db(
    response_v: Float32Array, loudest: Int64Array, which: Int64Array, sample_rate_hz: float, period: int
) -> Float32Array:
    """Level of the third harmonic around a recording's loudest moment, for the recordings `which` of a batch.

    A peak cut off at 0.95 of its height has it at -38 dB, at 0.9 at -30 dB; in-band figures hardly see that, for
    a response of L taps can be bent to explain a resonance that is a little too low.

    response_v, float32 (records, samples): Recordings in volts.
    loudest, int64 (records,): Sample of their largest magnitude.
    period: Samples of a sweep with its silence; in the next one the same is as loud again.

    Returns float32 (which,): in dB of the fundamental; -inf where it does not stand out from the noise, NaN
    where the fundamental is too low to measure or its third harmonic too high to be sampled.
    """
    samples, length = response_v.shape[1], 1 << max(5, round(np.log2(WINDOW_S * sample_rate_hz)))
    if samples < length or not which.size:
        return np.full(which.size, np.nan, np.float32)
    window = np.hanning(length + 1)[:-1].astype(np.float32)
    figure = _harmonic_level(response_v, which, loudest[which], window)
    # The first sample of a cut stretch is as large as all others, and its window half before it.
    after = np.minimum(loudest[which, None] + np.arange(2 * length), samples - 1)
    level_v = np.abs(response_v[which, loudest[which]])[:, None]
    flat = np.count_nonzero(np.abs(response_v[which[:, None], after]) >= np.float32(CLIP_SHARE) * level_v, axis=1)
    unsure = np.flatnonzero(((figure > UNSURE_DB) | (flat >= MIN_FLAT)) & ~(figure > SURE_DB))
    if unsure.size:
        middle = np.array([_middle(response_v[record], int(loudest[record]), period) for record in which[unsure]])
        figure[unsure] = np.fmax(figure[unsure], _harmonic_level(response_v, which[unsure], middle, window))
    return figure


def _harmonic_level(
    response_v: Float32Array, which: Int64Array, centre: Int64Array, window: Float32Array
) -> Float32Array:
    length = window.size
    first = np.clip(centre - length // 2, 0, response_v.shape[1] - length)
    pieces = response_v[which[:, None], first[:, None] + np.arange(length)]
    spectra = scipy.fft.rfft(pieces * window, axis=1)
    power = np.square(spectra.real) + np.square(spectra.imag)
    rows = np.arange(which.size)
    fundamental = power[:, 1:].argmax(axis=1) + 1
    audible = (fundamental >= MIN_BIN) & (3 * fundamental + 2 <= length // 2)
    fundamental = np.where(audible, fundamental, MIN_BIN)
    near = np.arange(-1, 2)
    whole = power[rows[:, None], fundamental[:, None] + near].sum(axis=1)
    level = power[rows[:, None], 3 * fundamental[:, None] + near].sum(axis=1)
    noise = np.partition(power[:, length // 4 :], length // 8, axis=1)[:, length // 8]
    stands_out = level > 3 * OVER_FLOOR * noise
    figure = np.where(stands_out, 10 * np.log10(np.maximum(level, FLOOR) / np.maximum(whole, FLOOR)), -np.inf)
    return np.where(audible, figure, np.nan).astype(np.float32)


def _middle(recording: Float32Array, loudest: int, period: int) -> int:
    """The middle of the stretch that is nearly as loud as the loudest sample."""
    around = slice(max(0, loudest - period // 2), loudest + period // 2)
    high = np.flatnonzero(np.abs(recording[around]) >= np.float32(BELOW_SHARE) * np.abs(recording[loudest]))
    return around.start + int(high[high.size // 2])


_FIGURES = "burst_db burst_s line_db line_hz tail_db misfit_db unsteady_db harmonic_db slip_db dead"
DEFECTS = np.dtype([(name, np.float32) for name in _FIGURES.split()])
"""What is wrong with a record; energies in dB of the response's in band, -inf where nothing is, NaN if not looked at.

burst_db, burst_s, line_db, line_hz
    What the fit leaves, where most of it lies in one moment (seconds from the start of the first sweep), or in a tone.
misfit_db, tail_db
    What the fit leaves of the mean of the sweeps, where it is more than they differ by; most of it after the last tap.
unsteady_db
    By how much the sweeps differ from each other, where it is more than the fit of their mean leaves.
harmonic_db
    Third harmonic over the fundamental at the response's loudest moment.
slip_db
    What the played signal, on one clock, leaves of the reference channel, in dB of the reference.
dead
    1 where the response channel is constant, else 0.
"""

DIFFER = 2.0
"""Two energies that noise makes alike differ where one is so many times the other."""
MIN_FREE = (2 * SIGMAS / np.log(DIFFER)) ** 2
"""Degrees of freedom from which on chance does so beyond `SIGMAS` only: the logarithm of F has a variance of 4 over
them."""
BURST_S = 0.005
"""Speckle, knocks and lost samples last milliseconds."""
EDGE_SHARE = 0.1
"""A tone beyond the band leaks into the nearest part of it."""
DEAD_SHARE = 1e-6
"""A constant channel has so little of its largest sample's energy in band: the rounding of 10 bits."""


def not_looked_at(records: int) -> NDArray[np.void]:
    """Figures of records that were not examined: all NaN, shape (records,)."""
    defects = np.zeros(records, DEFECTS)
    for name in DEFECTS.names or ():
        defects[name] = np.nan
    return defects


def worst_of(defects: NDArray[np.void]) -> np.void:
    """One row of figures for several records of one actuator: each figure's largest, NaN only where all are."""
    worst: np.void = not_looked_at(1)[0]
    for name in DEFECTS.names or ():
        known = defects[name][~np.isnan(defects[name])]
        worst[name] = known.max() if known.size else np.nan
    return worst


@dataclass(frozen=True, slots=True)
class DefectFinder:
    """Looks at sequential records.

    in_band: Bins of the sweep's band among those of the residuals.
    first_bin: Number of the first of all bins.
    period: Samples of a sweep with its silence.
    averages: Sweeps in a record.
    sample_rate_hz: Rate in Hz, > 0.
    taps: Length L of the response.
    freedom: Share of white noise that the fit leaves unexplained, 0 to 1.
    is_swept: Whether each moment has one frequency, so that its harmonics are not played.
    """

    in_band: slice
    first_bin: int
    period: int
    averages: int
    sample_rate_hz: float
    taps: int
    freedom: float
    is_swept: bool

    def find(
        self,
        response_v: Float32Array,
        levels: _Levels,
        loudest: int,
        answered_energy: Float64Array,
        reference: Complex64Array,
        differing: Complex64Array,
        missed: Complex64Array,
    ) -> NDArray[np.void]:
        """Look through a batch of records, their spectra in all bins that the sweep fills.

        response_v, float32 (records, samples): Response channel in volts; `levels` are its peaks.
        loudest: The record with the largest peak of its position, counted from the batch's first, inside or outside it.
        answered_energy, float64 (records,): Energy of the sweeps on the response channel in the sweep's band.
        reference, complex64 (records, averages, bins): Spectra of the sweeps on the reference channel.
        differing, complex64 (records, averages, bins): What one mean transfer function leaves of the response: zeros
            for a single sweep.
        missed, complex64 (records, bins): What of that function the FIR of L taps leaves unexplained.

        Returns a structured array (records,), as `DEFECTS`; `slip_db` is not looked at.
        """
        here, whole = self.in_band, np.maximum(answered_energy, FLOOR)
        defects = np.zeros(len(whole), DEFECTS)
        for name in ("burst_db", "line_db", "tail_db", "misfit_db", "unsteady_db"):
            defects[name] = -np.inf
        defects["harmonic_db"] = defects["slip_db"] = np.nan
        defects["dead"] = answered_energy <= DEAD_SHARE * np.square(levels.response_v, dtype=np.float64)
        missed_power = energy(missed) * energy(reference).sum(axis=1)
        power = missed_power + energy(differing).sum(axis=1)
        left = missed_power[:, here].sum(axis=1, dtype=np.float64)
        noise, apart = left / max(self.freedom, FLOOR), left / self.averages
        if self.averages == 1:
            defects["unsteady_db"] = defects["misfit_db"] = defects["tail_db"] = np.nan
        else:
            apart = (power - missed_power)[:, here].sum(axis=1, dtype=np.float64) / (self.averages - 1)
            if 2 * (here.stop - here.start) * self.freedom > MIN_FREE:
                self._compare(noise, apart, missed[:, here], left, whole, defects)
                self._excuse_rounding(response_v, levels, loudest, defects)
        loud = np.flatnonzero(self.is_swept & (whole > 10 ** (CLEAR_DB / 10) * np.minimum(apart, noise)))
        harmonic_db = _third_harmonic_db(response_v, levels.loudest, loud, self.sample_rate_hz, self.period)
        defects["harmonic_db"][loud] = harmonic_db
        residual = (missed[:, None] * reference + differing)[..., here]
        self._concentrated(residual, power, whole, defects)
        return defects

    def _compare(
        self,
        noise: Float64Array,
        differing: Float64Array,
        missed: Complex64Array,
        left: Float64Array,
        whole: Float64Array,
        defects: NDArray[np.void],
    ) -> None:
        """What the fit leaves against what the sweeps differ by: noise makes them alike."""
        apart = differing > DIFFER * noise
        defects["unsteady_db"][apart] = _db(self.averages * differing[apart], whole[apart])
        missing = noise > DIFFER * differing
        defects["misfit_db"][missing] = _db(left[missing], whole[missing])
        delays = energy(scipy.fft.ifft(missed[missing], axis=1))
        cell = self.period / missed.shape[1]  # samples of delay
        # A quarter of the delays beyond the taps: a tone has a quarter of its energy there, a tail nearly all.
        after = slice(int(self.taps / cell), int((0.75 * self.taps + 0.25 * self.period) / cell) + 1)
        late = np.zeros_like(missing)
        late[missing] = delays[:, after].sum(axis=1) > MOST * delays.sum(axis=1)
        defects["tail_db"][late] = defects["misfit_db"][late]

    def _excuse_rounding(
        self, response_v: Float32Array, levels: _Levels, loudest: int, defects: NDArray[np.void]
    ) -> None:
        """Faint records have few steps of a range that is right for the loudest: the same rounding in all sweeps."""
        for record in np.flatnonzero(defects["misfit_db"] > -np.inf).tolist():
            middle = int(levels.loudest[record])
            around = response_v[record, max(0, middle - AROUND_SAMPLES) : middle + AROUND_SAMPLES]
            if record != loudest and 0 < _converter_steps(around) < MIN_STEPS:
                defects["misfit_db"][record] = defects["tail_db"][record] = -np.inf

    def _concentrated(
        self, residual: Complex64Array, power: Float32Array, whole: Float64Array, defects: NDArray[np.void]
    ) -> None:
        """Whether most of what is left is a tone, or lies in one moment."""
        here = self.in_band
        left = power[:, here].sum(axis=1, dtype=np.float64)
        share, _, highest = find_tone(power, here)
        is_tone = share > MOST
        defects["line_hz"] = (self.first_bin + highest) * self.sample_rate_hz / self.period
        defects["line_db"][is_tone] = _db(left[is_tone], whole[is_tone])
        # At the band's edge what leaks looks like a long response.
        beyond = (highest < here.start) | (highest >= here.stop)
        defects["tail_db"][is_tone & beyond & (power.max(axis=1) > left)] = -np.inf
        length = residual.shape[-1]
        moments = energy(scipy.fft.ifft(residual, axis=-1)).reshape(len(left), -1)
        step = self.period / length / self.sample_rate_hz
        share, _, defects["burst_s"] = find_moment(moments, step)
        is_burst = ~is_tone & (share > MOST)
        defects["burst_db"][is_burst] = _db(left[is_burst], whole[is_burst])


def find_tone(power: NDArray[np.floating], in_band: slice) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Share of a tone in what is left in band, or of what leaks into it, the same over the median bin, and its bin.

    power, float (records, bins): Energy of what is left in all bins that the sweep fills.
    in_band: The bins that count.

    Returns share, over median : float64 (records,); bin : int64 (records,).
    """
    inside = power[:, in_band]
    total, rows = np.maximum(inside.sum(axis=1, dtype=np.float64), FLOOR), np.arange(len(power))
    highest = power.argmax(axis=1)
    # A tone between two bins shows in both.
    around = np.clip(highest[:, None] + np.arange(-1, 2), 0, power.shape[1] - 1)
    tone = power[rows[:, None], around].sum(axis=1)
    edge = max(int(EDGE_SHARE * inside.shape[1]), 1)
    below, above = highest < in_band.start, highest >= in_band.stop
    tone = np.where(below, inside[:, :edge].sum(axis=1), np.where(above, inside[:, -edge:].sum(axis=1), tone))
    return tone / total, tone / np.maximum(np.median(inside, axis=1), FLOOR), highest


def find_moment(energies: NDArray[np.floating], step_s: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Share of the loudest `BURST_S` seconds in what is left, over that of the median ones, and when they are, in s.

    energies, float (records, moments): Energy of what is left, every `step_s` seconds.

    Returns share, over median, seconds : float64 (records,).
    """
    window = max(1, round(BURST_S / 2 / step_s))
    within = np.diff(np.cumsum(energies, axis=1, dtype=np.float64)[:, ::window], axis=1)
    within = within[:, :-1] + within[:, 1:]
    place = within.argmax(axis=1)
    loudest = within[np.arange(len(within)), place]
    share = loudest / np.maximum(energies.sum(axis=1, dtype=np.float64), FLOOR)
    return share, loudest / np.maximum(np.median(within, axis=1), FLOOR), (place + 1) * window * step_s


def energy(values: Complex64Array | Complex128Array) -> Float32Array:
    """Squared magnitudes."""
    return np.asarray(np.square(values.real) + np.square(values.imag))


def _db(part: NDArray[np.floating], whole: Float64Array) -> Float64Array:
    return np.asarray(10 * np.log10(np.maximum(part, FLOOR) / whole))
