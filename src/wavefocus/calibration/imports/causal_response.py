"""Frequency responses as causal FIRs."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.estimator.causal_fit import MAX_RIDGE, RIDGE, ToeplitzFit
from wavefocus.storage.errors import InputError

_ComplexArray = NDArray[np.complexfloating[Any, Any]]

_MAX_DENSE_TAPS = 4096
"""FIRs up to this length are solved for with a matrix, of 128 MiB."""
EARLY, LATE = 1e-2, 10**-2.5
"""Energy before zero, and in the last tenth of a period, relative to all of it, from which on frequency responses are
not those of a causal system that dies away."""
_MIRRORED = 1e-3
"""Asymmetry of a spectrum, relative to its largest value, up to which its upper half mirrors the lower one."""


@dataclass(frozen=True, slots=True, eq=False)
class _FrequencyAxis:
    """Where the values of a frequency response lie.

    step_hz: Distance of two frequencies.
    take, int64 (bins,): Indices of the values at 0 or above, in order of frequency.
    bins, int64 (bins,): Their frequencies in steps.
    mirror, int64 (bins,) or None: Indices of the values at the negative frequencies of the same size.
    period: Steps that the whole axis spans, if it is two-sided; else None.
    """

    step_hz: float
    take: NDArray[np.int64]
    bins: NDArray[np.int64]
    mirror: NDArray[np.int64] | None
    period: int | None

    def one_sided(self, values: _ComplexArray) -> _ComplexArray:
        """Values (..., frequencies) at the frequencies from 0 on, averaged with those that mirror them."""
        found = values[..., self.take]
        return found if self.mirror is None else (found + np.conj(values[..., self.mirror])) / 2


def frequency_axis(frequency_hz: Float64Array, sample: _ComplexArray) -> _FrequencyAxis:
    """Understand an axis: from 0 or above, with negative frequencies before or after, or to the sample rate.

    frequency_hz, float64 (frequencies,): In Hz.
    sample, complex (..., frequencies): Some values, which show whether the upper half mirrors the lower one.

    Raises InputError: the frequencies are not evenly spaced, or no multiples of their step.
    """
    count = len(frequency_hz)
    order = np.argsort(frequency_hz, kind="stable")
    ascending = frequency_hz[order]
    if count < 3 or not np.isfinite(frequency_hz).all():
        raise InputError(f"the frequency axis has {count} values; 3 finite ones or more are needed")
    step_hz = float(ascending[-1] - ascending[0]) / (count - 1)
    if not step_hz > 0:
        raise InputError("the frequency axis does not ascend; evenly spaced frequencies are needed")
    index = ascending / step_hz
    bins = np.rint(index)
    if np.abs(np.diff(index) - 1).max() > 0.02:
        worst = int(np.argmax(np.abs(np.diff(index) - 1)))
        raise InputError(
            f"the frequency axis is not evenly spaced: {ascending[worst]:.9g} Hz is followed by"
            f" {ascending[worst + 1]:.9g} Hz, and the mean step is {step_hz:.6g} Hz; interpolate it to one step first"
        )
    if np.abs(index - bins).max() > 0.05 or np.abs(bins).max() > 2**31:
        raise InputError(
            f"the frequencies are no multiples of their step: the first is {ascending[0]:.9g} Hz, the step"
            f" {step_hz:.9g} Hz; interpolate them to multiples first"
        )
    number = bins.astype(np.int64)
    if number[0] < 0:
        kept = number[number >= 0]
        if len(kept) < 2:
            raise InputError("the frequency axis has hardly any frequencies of 0 Hz or above; those are needed")
        last = int(kept[-1])
        if number[0] not in (-last, -last - 1) or kept[0] != 0:
            return _FrequencyAxis(step_hz, order[number >= 0], kept, None, None)
        if number[0] == -last - 1:  # half the rate stands only at its negative place
            kept = np.append(kept, last + 1)
        at = dict(zip(number.tolist(), order.tolist(), strict=True))
        take = np.array([at.get(step, at[-step]) for step in kept.tolist()], np.int64)
        return _FrequencyAxis(step_hz, take, kept, np.array([at[-step] for step in kept.tolist()], np.int64), count)
    half = sample[..., 1 : (count + 1) // 2]
    upper = np.conj(sample[..., : count // 2 : -1])[..., : half.shape[-1]]
    largest = float(np.abs(sample).max(initial=0.0))
    if number[0] == 0 and count > 4 and largest > 0 and np.abs(half - upper).max() <= _MIRRORED * largest:
        kept = np.arange(count // 2 + 1, dtype=np.int64)
        mirror = (-kept) % count
        return _FrequencyAxis(step_hz, order[kept], kept, order[mirror], count)
    return _FrequencyAxis(step_hz, order, number, None, None)


class CausalConverter:
    """Turns frequency responses into causal FIRs, by least squares with a small penalty.

    Where the frequencies reach from 0 to half the rate without a gap, the first taps of the inverse transform are that
    fit; where they do not, and there are as many taps as the period has samples, what is missing is zero. The penalty
    follows the noise of the first responses, as in `wavefocus.calibration.estimator.causal_fit.ToeplitzFit`, which
    solves for FIRs that are too long for a matrix.

    bins, int64 (bins,): Frequencies in steps, ascending.
    period: Samples of a period: the rate over the step of the frequencies.
    taps: Length of the FIRs, 1 to the period.
    """

    def __init__(self, bins: NDArray[np.int64], period: int, taps: int) -> None:
        self._bins, self._period, self.taps = bins, period, taps
        self._is_exact = len(bins) == period // 2 + 1 or taps == period
        self._inverse: Float64Array | None = None
        self.whole = self.left = 0.0
        self.energy = TimeOfEnergy(bins, period)

    def convert(self, spectra: _ComplexArray) -> tuple[Float32Array, Float64Array]:
        """FIRs (n, taps) of spectra (n, bins), and the share of the energy of each that they leave unexplained."""
        values = np.asarray(spectra, np.complex128)
        self.energy.add(values)
        ring = np.zeros((len(values), self._period // 2 + 1), complex)
        ring[:, self._bins] = values
        whole_ring = scipy.fft.irfft(ring, self._period)
        green = whole_ring[:, : self.taps]
        if self._is_exact:
            whole, left = _energy(whole_ring), _energy(whole_ring[:, self.taps :])
        else:
            green = self._fitted(values, green)
            whole, left = _energy(np.abs(values)), self._left(values, green)
        self.whole += float(whole.sum())
        self.left += float(left.sum())
        return green.astype(np.float32), left / np.where(whole > 0, whole, 1.0)

    def _fitted(self, values: _ComplexArray, wanted: Float64Array) -> Float64Array:
        if self.taps > _MAX_DENSE_TAPS:
            turn = 2 * np.pi * self._bins / self._period
            fit = ToeplitzFit(turn, np.ones(len(turn)), self._period, self.taps, RIDGE)
            largest = np.abs(values).max(axis=1, keepdims=True)
            scale = np.where(largest > 0, largest, 1.0)  # single precision is not the limit
            return np.asarray(fit.solve((values / scale).astype(np.complex64), np.zeros(len(values)))[0] * scale)
        if self._inverse is None:
            self._inverse = self._inverted(RIDGE)
            green = wanted @ self._inverse
            elements = 2 * len(self._bins)
            freedom = elements - min(self.taps, elements * self.taps / self._period + 2 * np.log(self.taps + 1))
            variance = 2 / self._period * self._left(values, green) / max(freedom, 1.0)
            energy = _energy(green) / self.taps
            likely = float(np.median(variance / np.where(energy > 0, energy, np.inf)))
            if likely > 2 * RIDGE:
                self._inverse = self._inverted(min(likely, MAX_RIDGE))
        return wanted @ self._inverse

    def _inverted(self, ridge: float) -> Float64Array:
        """The inverse of the normal equations' matrix, which is 1 where all frequencies are there."""
        there = np.zeros(self._period // 2 + 1)
        there[self._bins] = 1.0
        gram = scipy.linalg.toeplitz(scipy.fft.irfft(there, self._period)[: self.taps])
        gram[np.diag_indices_from(gram)] += ridge
        return np.asarray(scipy.linalg.inv(gram, overwrite_a=True, check_finite=False))

    def _left(self, values: _ComplexArray, green: Float64Array) -> Float64Array:
        return _energy(np.abs(values - scipy.fft.rfft(green, self._period)[:, self._bins]))


class TimeOfEnergy:
    """Where in a period the energy of frequency responses lies: after zero, before it, or all over.

    The frequencies are weighted by a cosine-squared (Hann) window, so that a response of a limited band does not ring
    beyond `guard` samples around its true time. Sums are kept for each actuator.

    bins, int64 (bins,): Frequencies in steps, ascending.
    period: Samples of a period.
    """

    def __init__(self, bins: NDArray[np.int64], period: int) -> None:
        self._bins, self._period = bins, period
        low, high = int(bins[0]), int(bins[-1])
        is_low_pass = low <= 1  # the window reaches over the negative frequencies, too
        middle, half_width = (0.0, high) if is_low_pass else ((low + high) / 2, (high - low) / 2)
        self._window = np.cos(np.pi / 2 * (bins - middle) / (half_width + 1)) ** 2
        self._guard = math.ceil(period / half_width)  # half the width of the window's main lobe in time
        self._energy: Float64Array | None = None

    def add(self, values: _ComplexArray) -> None:
        """Add responses (actuators, bins)."""
        ring = np.zeros((len(values), self._period // 2 + 1), np.complex128)
        ring[:, self._bins] = values * self._window
        energy = np.square(scipy.fft.irfft(ring, self._period))
        self._energy = energy if self._energy is None else self._energy + energy

    def words(self) -> tuple[list[str], list[str]]:
        """Sentences about the energy, and warnings by name; none where the band is too narrow to tell."""
        period, guard = self._period, self._guard
        if self._energy is None or 8 * guard > period:
            return [], []
        actuators = np.flatnonzero(self._energy.any(axis=1))
        if not len(actuators):
            return [], []
        energy = self._energy[actuators]
        whole = energy.sum(axis=1)
        half, quarter = period // 2, period // 4
        middle = energy[:, half : half + quarter].sum(axis=1)
        before = energy[:, period - quarter : period - guard].sum(axis=1)
        last = energy[:, period - guard - period // 10 : period - guard].sum(axis=1)
        level = [10 * math.log10(max(float(part.sum() / whole.sum()), 1e-16)) for part in (last, before)]
        said = [f"energy in the last tenth of the period {level[0]:.1f} dB, before zero {level[1]:.1f} dB"]
        early = (before > EARLY * whole) & (before > 2 * middle)
        warnings = []
        for found, share, where, words in (
            (early, before, "before zero", "conjugated (of the time convention exp(-i omega t)), reversed in time, or"
             " leading, as where the response was recorded earlier than the drive; conjugate them, or delay them by the"
             " lead"),
            (~early & (last > LATE * whole), last, "in the last tenth of the period", "aliased in time: they do not die"
             " away within a period, or are noisy; measure at a finer step of frequency"),
        ):  # fmt: skip
            if found.any():
                which = "" if found.all() else (
                    f" of {int(found.sum())} of {len(found)} actuators (the first is {actuators[np.argmax(found)]})"
                )  # fmt: skip
                share_db = 10 * math.log10(float(share[found].sum() / whole[found].sum()))
                warnings.append(
                    f"the frequency responses{which} look {words} ({share_db:.1f} dB of their energy {where})"
                )
        return said, warnings


def _energy(rows: Float64Array) -> Float64Array:
    return np.asarray(np.square(rows).sum(axis=1))
