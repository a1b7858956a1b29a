"""What a trial of schedules at one position says: how wrong each of them is, and which of them to take."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from acquisition.durations import hours
from calibration.estimator.expected_error import degrees_of_freedom
from calibration.estimator.sequential import Estimate

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# Measurements differ by more than their noise when their difference has so many times its energy.
DISTINCT = 1.3
# A schedule that errs by so much less at half the drive distorts; noise that is always there would err more.
DISTORTS_DB = 3.0
# Noise that is always there doubles with half the drive, 6 dB; less than half of that is noise of the signal's own.
GROWS_DB = 3.0


@dataclass(frozen=True, slots=True)
class Candidate:
    """A schedule, tried.

    Parameters
    ----------
    name : str
        What it is called.
    groups : int
        Records of a position in which several actuators sound; 0 where they sound one after the other.
    level_db : float
        Its drive over the one that was asked for.
    campaign_s : float
        Seconds that the whole campaign would take.
    error_db : float
        Relative L2 error in band of the median actuator; inf where an input's range was left.
    """

    name: str
    groups: int
    level_db: float
    campaign_s: float
    error_db: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Which candidate is taken, and why."""

    chosen: Candidate
    reason: str


class Band:
    """Relative energies of Green's functions in a band.

    Parameters
    ----------
    band_hz : tuple of float
        Lowest and highest frequency in Hz.
    sample_rate_hz : float
        Rate in Hz.
    taps : int
        Length L of the FIRs.
    """

    def __init__(self, band_hz: tuple[float, float], sample_rate_hz: float, taps: int) -> None:
        self.length = scipy.fft.next_fast_len(2 * taps, real=True)
        hertz = np.arange(self.length // 2 + 1) * sample_rate_hz / self.length
        self._inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
        self.freedom = degrees_of_freedom(band_hz, taps / sample_rate_hz)
        self.width_hz = band_hz[1] - band_hz[0]

    def spectra(self, green: NDArray[np.floating]) -> Complex128Array:
        """Spectra (actuators, bins) of FIRs (actuators, taps)."""
        return np.asarray(scipy.fft.rfft(green.astype(np.float64), self.length)[:, self._inside])

    def own_noise(self, estimate: Estimate, window_s: float) -> Float64Array:
        """Share of energy (actuators,) that noise has in the FIRs, as their residuals tell.

        Parameters
        ----------
        estimate : Estimate
            Of sequential records.
        window_s : float
            A sweep and its silence in seconds, on which the noise is seen.
        """
        seen = 2 * self.width_hz * window_s
        return np.asarray(10 ** (-0.1 * estimate.snr_db.astype(np.float64)) * min(self.freedom / seen, 1.0))


def relative(one: Complex128Array, other: Complex128Array, whole: Complex128Array) -> Float64Array:
    """Energy (actuators,) of a difference over that of the whole."""
    energy = np.square(np.abs(whole)).sum(axis=1)
    return np.asarray(np.square(np.abs(one - other)).sum(axis=1) / np.maximum(energy, 1e-300))


def sequential_errors(
    full: Complex128Array, half: Complex128Array, noise_full: Float64Array, noise_half: Float64Array
) -> tuple[tuple[float, float], Complex128Array, Float64Array]:
    """Errors of sequential capture at full and half drive, and the best guess at the linear plate.

    A cubic term changes a response by the square of its level, so that what differs at half the drive is three
    quarters of what is wrong at full drive.

    Parameters
    ----------
    full, half : complex128 array, shape (actuators, bins)
        Spectra measured at the two levels.
    noise_full, noise_half : float64 array, shape (actuators,)
        Share of energy that their own noise has.

    Returns
    -------
    tuple
        Median errors in dB at (full, half) drive; the reference spectra; the share of energy that noise has in
        them.
    """
    apart = relative(full, half, full)
    noise = noise_full + noise_half
    distinct = float(np.median(apart)) > DISTINCT * float(np.median(noise))
    wrong = (4 / 3) ** 2 * np.maximum(apart - noise, 0) if distinct else np.zeros_like(noise)
    errors = decibel_of_median(noise_full + wrong), decibel_of_median(noise_half + wrong / 16)
    if not distinct:
        return errors, full, noise_full
    return errors, (4 * half - full) / 3, (16 * noise_half + noise_full) / 9


def repeated_error(takes: list[Complex128Array], reference: Complex128Array, noise: Float64Array) -> float:
    """Error of one take of a schedule, from several of them and a reference that is known to be right.

    Noise is what the two takes that agree best do not have in common: a moment of speckle in another one does
    not count. To it comes what both have in common and the reference has not.

    Parameters
    ----------
    takes : list of complex128 array, shape (actuators, bins)
        Spectra of two takes or more.
    reference : complex128 array, shape (actuators, bins)
        Spectra measured otherwise.
    noise : float64 array, shape (actuators,)
        Share of energy that noise has in the reference.

    Returns
    -------
    float
        Median over the actuators, in dB.
    """
    pairs = itertools.combinations(takes, 2)
    one, other = min(pairs, key=lambda pair: float(np.median(relative(pair[0], pair[1], reference))))
    own = relative(one, other, reference) / 2
    expected = noise + own / 2
    apart = relative((one + other) / 2, reference, reference)
    if np.median(apart) > DISTINCT * np.median(expected):
        own = own + np.maximum(apart - expected, 0)
    return decibel_of_median(own)


def decibel_of_median(share: Float64Array) -> float:
    """Median of shares of energy in dB."""
    return 10 * math.log10(max(float(np.median(share)), 1e-30))


def choose(candidates: list[Candidate], allowed_loss_db: float) -> Verdict:
    """Take the quickest schedule that errs little more than sequential capture.

    Parameters
    ----------
    candidates : list of Candidate
        The one that was asked for first, those with groups 0 among them.
    allowed_loss_db : float
        How much more it may err than sequential capture at the better of its levels, in dB.
    """
    asked = candidates[0]
    sequential = min((one for one in candidates if not one.groups), key=lambda one: (one.error_db, one.campaign_s))
    good = [one for one in candidates if one.error_db <= sequential.error_db + allowed_loss_db]
    chosen = min(good or [sequential], key=lambda one: (one.campaign_s, one.error_db))
    against = f"{chosen.error_db:.1f} dB in {hours(chosen.campaign_s)}"
    if chosen is not sequential:
        against += f", where {sequential.name} leaves {sequential.error_db:.1f} dB in {hours(sequential.campaign_s)}"
    if chosen is asked:
        return Verdict(chosen, f"{chosen.name} pays: it leaves {against}")
    return Verdict(chosen, f"{asked.name} does not pay: {_why(asked, candidates)}; {chosen.name} leaves {against}")


def _why(asked: Candidate, candidates: list[Candidate]) -> str:
    if not math.isfinite(asked.error_db):
        return "it leaves the range of an input"
    leaves = f"it leaves {asked.error_db:.1f} dB"
    same = (one for one in candidates[1:] if one.groups == asked.groups and one.level_db < asked.level_db)
    lower = next((one for one in same if math.isfinite(one.error_db)), None)
    if lower is None:
        return leaves
    gain_db = asked.error_db - lower.error_db
    if gain_db > DISTORTS_DB:
        return f"{leaves} and {lower.error_db:.1f} dB at {lower.level_db - asked.level_db:g} dB, the plate distorts"
    if gain_db > -GROWS_DB:
        return f"{leaves} at either level, its noise grows with the signal"
    return f"{leaves}, noise is too loud for it"
