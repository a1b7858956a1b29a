"""The clock from a sweep that somebody else played: its law is known, its phase and its fades are not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.ring_clock import RingClock
from calibration.thinning import Thinned, Thinning

Float64Array = NDArray[np.float64]

# Fades, and where an abrupt end rings, are left out of the fit: this share of the sweep at either end.
ENDS_SHARE = 0.12
# A law that explains so much of the rest is the one that was played.
LAW_SHARE = 0.97
# Phases that are tried first: the fit finds its way from an eighth of a turn.
PHASES = np.pi / 4 * np.array([0, 2, 1, 3])
TURNS = 3


@dataclass(frozen=True, slots=True)
class SweepFit:
    """Where sweeps of one law lie in a recording.

    Parameters
    ----------
    offset_samples : float
        DAQ sample at which the ring begins.
    ratio : float
        DAQ rate over playback rate.
    explained : float
        Share of the recording's energy in band, at the places that count, that the law explains.
    """

    offset_samples: float
    ratio: float
    explained: float


def fit_sweep_law(
    thinned: Thinned,
    thinning: Thinning,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    ring: int,
    starts: Sequence[int],
    sweep_samples: int,
    max_ppm: float,
) -> SweepFit | None:
    """Find linear or exponential sweeps through a band, up or down, of any phase and fades.

    Parameters
    ----------
    thinned : Thinned
        One recording.
    thinning : Thinning
        How it was thinned.
    sample_rate_hz : float
        Rate in Hz.
    band_hz : tuple of float
        Where the sweeps begin and end in Hz.
    ring : int
        Samples of the ring on which the sweeps lie: their period, or longer than the recording.
    starts : sequence of int
        Playback samples of the ring at which sweeps begin.
    sweep_samples : int
        Length of each.
    max_ppm : float
        Largest clock skew in parts per million.

    Returns
    -------
    SweepFit or None
        None where no such sweeps are there.
    """
    bins = min(int(np.ceil(0.5 * ring / thinning.step)), (ring + 1) // 2)
    bins = min(bins, int(np.ceil(thinning.highest * ring)))
    counted = np.zeros(ring, dtype=np.bool_)
    left_out = round(ENDS_SHARE * sweep_samples)
    for start in starts:
        counted[(start + np.arange(left_out, sweep_samples - left_out)) % ring] = True
    best: SweepFit | None = None
    for cycles in _laws(sample_rate_hz, band_hz, sweep_samples):
        for first_phase in PHASES:
            phase, ratio = float(first_phase), 1.0
            fit = None
            for _ in range(TURNS):
                base = np.zeros(ring)
                for start in starts:
                    base[(start + np.arange(sweep_samples)) % ring] += np.sin(2 * np.pi * cycles + phase)
                spectrum = scipy.fft.rfft(base)[:bins]
                clock = RingClock(spectrum, ring, max_ppm, any_phase=True, counted=counted)
                fit = clock.fit(thinned, thinning, ratio)
                if fit.explained < LAW_SHARE:
                    break
                # Fitted well only where what is a quarter turn late is small.
                phase, ratio = phase - float(np.arctan2(fit.coupling[-1], fit.gain)), fit.ratio
            assert fit is not None
            if best is None or fit.explained > best.explained:
                best = SweepFit(fit.offset_samples, fit.ratio, fit.explained)
            if best.explained > LAW_SHARE:
                return best
    return None


def _laws(sample_rate_hz: float, band_hz: tuple[float, float], samples: int) -> Iterator[Float64Array]:
    """Cycles (samples,) that sweeps have done at each sample, the likeliest first."""
    low, high = band_hz
    share = np.arange(samples) / samples
    span_s = samples / sample_rate_hz
    for first, last in ((low, high), (high, low)):
        yield span_s * (first * share + 0.5 * (last - first) * share**2)
        growth = np.log(last / first)
        yield span_s * first / growth * np.expm1(growth * share)
