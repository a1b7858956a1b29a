"""The base signal of staggered records and its clock, from their reference channels alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import require_coverage, ring_spectrum
from calibration.clock.known_signal import Thinned, Thinning
from calibration.clock.periodic_clock import RepeatFit, RingClock, RingFit, fit_repeats
from calibration.estimator.estimate import MAX_PPM
from calibration.excitation.sweep_laws import fit_sweep_law
from storage.errors import InputError
from storage.raw.header import LAWS, Law

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# A clock fitted to the signal's own repeats must be as sure as this; 1 ppm would cost 1 dB at -63 dB.
SURE_PPM = 0.3
REPEATING = 0.03
# A record of which this share is explained by another one holds the same signal.
SAME_SHARE = 0.9
# Records cut at places at least this share of a period apart are compared, so many at most, within this of a
# sweep's clock, or at these steps over all ratios.
LEAST_CUT = 0.02
MOST_CUTS = 6
CUT_REACH_PPM = 30.0
SCAN_PPM = 20.0
# A sweep sounds beyond its band by about so many times the root of its rate in Hz per second.
BEYOND_BAND = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class BaseSignal:
    """One period of what the reference channels carry.

    base_v, float64 (period,): In DAQ volts, on the playback clock; its beginning is arbitrary.
    ratio: DAQ rate over playback rate of the first record.
    """

    base_v: Float64Array
    ratio: float


def highest_cycles(band_hz: tuple[float, float], sweep_s: float, sample_rate_hz: float) -> float:
    """Upper end of what a sweep through a band has to say, in cycles per sample."""
    beyond_hz = BEYOND_BAND * math.sqrt((band_hz[1] - band_hz[0]) / sweep_s)
    return min((band_hz[1] + beyond_hz) / sample_rate_hz, 0.499)


def learn_base(
    references: Sequence[Float32Array],
    period: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    sweep_s: float | None = None,
    *,
    laws: Sequence[Law] = LAWS,
    same_clock: bool = False,
) -> BaseSignal:
    """Find the base signal of periodic records as the mean of several, put on one clock.

    The clocks' ratio comes from the signal's own repeats where a record is longer than a period, else from a
    sweep through the band.

    references, sequence of float32 (samples,): Reference channels in volts; more of them give a cleaner base signal.
    period: Period in playback samples.
    sample_rate_hz: Rate in Hz.
    band_hz: Band of the base signal in Hz.
    sweep_s: Length of the sweep in a period in seconds, if it is not all of it.
    laws: Laws of sweeps that are looked for.
    same_clock: Whether one clock played and recorded, so that its ratio is 1 and any base signal will do.

    Returns BaseSignal. Raises InputError: less than one period, silence, or nothing that shows the clocks' ratio.
    """
    bins = math.ceil(highest_cycles(band_hz, sweep_s or period / sample_rate_hz, sample_rate_hz) * period)
    bins = min(bins, (period + 1) // 2)
    thinning = Thinning(bins / period)
    seen = [_Seen(reference, thinning, period) for reference in references if np.any(reference)]
    if not seen:
        raise InputError("the reference channel is silent; a base signal is needed")
    require_coverage(seen[0].samples, period * (1 - 1e-6 * MAX_PPM), bins / period, "the reference")
    if same_clock:
        return _same_clock_base(seen, bins, period)
    # Fitted to its own repeats each record is as good as any; those of one clock are then averaged.
    own = [record.repeats for record in seen]
    sure = [fit is not None and fit.sigma_ppm < SURE_PPM and fit.misfit < REPEATING for fit in own]
    start = next((index for index, is_sure in enumerate(sure) if is_sure), 0)
    fit = own[start]
    if fit is not None and sure[start]:
        ratio = fit.ratio
    else:
        ratio = _ratio_of_cuts(seen, bins, _ratio_of_sweep(seen[0], period, sample_rate_hz, band_hz, sweep_s, laws))
    spectrum = seen[start].spectrum(bins, ratio)
    clock = RingClock(spectrum, period, MAX_PPM)
    fits = [clock.fit(record.thinned, thinning, ratio) for record in seen]
    same = [fit.explained > SAME_SHARE for fit in fits]
    wrong = [
        (fit.ratio / match.ratio - 1, fit.sigma_ppm)
        for fit, match, is_sure, is_same in zip(own, fits, sure, same, strict=True)
        if fit is not None and is_sure and is_same
    ]
    stretch = 1.0
    if wrong:
        weights = np.array([1 / sigma**2 for _, sigma in wrong])
        stretch = 1 + float(np.average([off for off, _ in wrong], weights=weights))
    total, level = np.zeros(bins, dtype=np.complex128), 0.0
    for record, match, is_same in zip(seen, fits, same, strict=True):
        if not is_same:
            continue
        ratio = match.ratio * stretch
        turned = np.exp(2j * np.pi / period * np.arange(bins) * match.offset_samples / match.ratio)
        total += match.gain * record.spectrum(bins, ratio) * turned
        level += match.gain**2
    mean = total / level
    return BaseSignal(scipy.fft.irfft(mean, period), fits[0].ratio * stretch)


def _same_clock_base(seen: Sequence[_Seen], bins: int, period: int) -> BaseSignal:
    """The first record's period, at the clock ratio 1."""
    return BaseSignal(scipy.fft.irfft(seen[0].spectrum(bins, 1.0), period), 1.0)


class _Seen:
    """A reference recording, thinned, and what it says of the clocks by itself."""

    def __init__(self, reference: Float32Array, thinning: Thinning, period: int) -> None:
        self.samples = reference.size
        self.thinned: Thinned = thinning(np.ascontiguousarray(reference[None], dtype=np.float32))
        self.repeats: RepeatFit | None = fit_repeats(self.thinned, thinning, period, reference.size, MAX_PPM)
        self.thinning, self.period = thinning, period

    def spectrum(self, bins: int, ratio: float) -> Complex128Array:
        """Transform of one period, at a clock ratio, beginning with the record."""
        turn = 2 * np.pi / (self.period * ratio)
        sums = self.thinning.spectrum(self.thinned, turn, 0, bins)
        found = ring_spectrum(sums, turn, self.samples)[0] * (self.period / 2)
        found[0] *= 2
        return np.asarray(found)


def _ratio_of_cuts(seen: Sequence[_Seen], bins: int, guess: float | None) -> float:
    """Clock ratio of records that are hardly longer than a period, but cut from it at different places.

    Where one record begins and ends, another one runs on: only at the true ratio do they agree.
    """
    first, *others = seen[:MOST_CUTS]

    def fits(ratio: float, some: Sequence[_Seen]) -> list[RingFit]:
        clock = RingClock(first.spectrum(bins, ratio), first.period, MAX_PPM)
        return [clock.fit(record.thinned, first.thinning, ratio, search=False) for record in some]

    def misfit(ratio: float, some: Sequence[_Seen]) -> float:
        return -sum(fit.explained for fit in fits(ratio, some))

    reach = CUT_REACH_PPM
    if guess is None and others:
        tried = 1 + 1e-6 * SCAN_PPM * np.arange(-round(MAX_PPM / SCAN_PPM), round(MAX_PPM / SCAN_PPM) + 1)
        guess, reach = float(tried[int(np.argmin([misfit(one, others[:2]) for one in tried]))]), SCAN_PPM
    if guess is not None:
        offsets = np.array([fit.offset_samples for fit in fits(guess, others)])
        if np.any(np.abs(offsets) > LEAST_CUT * first.period):
            import scipy.optimize  # slow to load; most records are cut alike and need no search

            ends = guess - 1e-6 * reach, guess + 1e-6 * reach
            best = scipy.optimize.minimize_scalar(
                lambda one: misfit(float(one), others), bounds=ends, method="bounded", options={"xatol": 1e-8}
            )
            return float(best.x)
        if reach == CUT_REACH_PPM:
            return guess
    raise InputError(
        "the reference shows no clock ratio: its records are hardly longer than a period, cut at the same place, and "
        "hold no sweep through band_hz; record at least 1.05 periods"
    )


def _ratio_of_sweep(
    record: _Seen,
    period: int,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    sweep_s: float | None,
    laws: Sequence[Law],
) -> float | None:
    """Clock ratio of a record that hardly repeats, if it holds a sweep; a full period is tried where not said."""
    sweep_samples = period if sweep_s is None else min(round(sweep_s * sample_rate_hz), period)
    fit = fit_sweep_law(
        record.thinned, record.thinning, sample_rate_hz, band_hz, sweep_samples, [0], MAX_PPM, period=period, laws=laws
    )
    return None if fit is None else fit.ratio
