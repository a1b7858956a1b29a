"""Spectra of periodic signals in a low band, and signals from them."""

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.numerics import fourier_sum
from wavefocus.storage.errors import InputError


def periodic_signal(spectrum: Complex128Array, turn: float, first: int, samples: int) -> Float64Array:
    """Real signals made of evenly spaced frequencies: what `fourier_sum` is the adjoint of.

    ``real part of sum over m of spectrum[..., m] * exp(j * n * turn * (first + m))`` for n = 0 ... samples - 1.

    spectrum, complex128 (..., bins): Their amplitudes.
    turn: Spacing of the frequencies in radians per sample.
    first: The first frequency is ``first * turn``.
    samples: How many samples.

    Returns float64 (..., samples).
    """
    summed = fourier_sum(spectrum.conj(), turn, 0, samples)
    return np.asarray((summed * np.exp(-1j * turn * first * np.arange(samples))).real)


# What of a period lies outside the record may last so many periods of the highest frequency: what sounds
# there is still determined by what sounds around it.
MAX_MISSING = 1.3
# Relative residual at which the conjugate gradients end, and how many steps they may take.
CG_TOLERANCE = 1e-5
MAX_STEPS = 100


def require_coverage(samples: int, period: float, highest: float, what: str) -> None:
    """Refuse a record too short for a period.

    samples: Its samples.
    period: The period in samples of the record.
    highest: Upper end of the band in cycles per sample.
    what: Name of the record for the message.

    Raises InputError: more of the period is missing than its band allows.
    """
    if (period - samples) * highest > MAX_MISSING:
        raise InputError(
            f"{what} has {samples} samples, less than the period of {period:.0f}; record one period or more"
        )


def period_spectrum(sums: Complex128Array, turn: float, samples: int) -> Complex128Array:
    """Amplitudes of the ring's frequencies by least squares, from the Fourier sums of recordings at them.

    Over whole periods these would be proportional; over any other length the frequencies leak into each
    other, by a kernel that depends only on the difference of two, so the system is Toeplitz.

    sums, complex128 (records, bins): Sums over n = 0 ... samples - 1 of ``recording[n] * exp(-j n m turn)`` for m = 0
        ... bins - 1.
    turn: Spacing of the frequencies in radians per sample.
    samples: Length of the recordings; a period or more, but for what `require_coverage` allows.

    Returns complex128 (records, bins): A such that ``recording[n] = real part of sum over m of A[m] * exp(j n m
    turn)``; A[0] is real.
    """
    bins = sums.shape[1]
    length = scipy.fft.next_fast_len(4 * bins)
    kernel = np.zeros(length, dtype=np.complex128)
    differences = np.arange(1 - 2 * bins, 2 * bins)
    kernel[differences % length] = _dirichlet(turn, samples, differences)
    kernel = scipy.fft.fft(kernel)

    def both_sides(half: Complex128Array) -> Complex128Array:
        return np.concatenate([half[:, :0:-1].conj(), half], axis=1)

    def leaked(half: Complex128Array) -> Complex128Array:
        spread = scipy.fft.ifft(scipy.fft.fft(both_sides(half), length) * kernel)
        return np.asarray(spread[:, bins - 1 : 2 * bins - 1])

    wanted = sums.copy()
    wanted[:, 0] = wanted[:, 0].real
    found = wanted / samples
    left = wanted - leaked(found)
    step = left.copy()
    power = _dot(left, left)
    goal = CG_TOLERANCE**2 * _dot(wanted, wanted)
    for _ in range(MAX_STEPS):
        if (power <= goal).all():
            break
        turned = leaked(step)
        length_of_step = power / np.maximum(_dot(step, turned), 1e-300)
        found += length_of_step * step
        left -= length_of_step * turned
        before, power = power, _dot(left, left)
        step = left + power / np.maximum(before, 1e-300) * step
    found[:, 1:] *= 2
    return np.asarray(found)


def _dot(first: Complex128Array, other: Complex128Array) -> Float64Array:
    """Inner products of two-sided spectra that are given by their one side, shape (records, 1)."""
    products = (first.conj() * other).real
    return np.asarray(2 * products[:, 1:].sum(axis=1, keepdims=True) + products[:, :1])


def _dirichlet(turn: float, samples: int, differences: Int64Array) -> Complex128Array:
    """Sums over n = 0 ... samples - 1 of ``exp(-j n turn difference)``."""
    half = 0.5 * turn * differences
    sine = np.sin(half)
    whole = np.abs(sine) < 1e-12
    ratio = np.where(whole, samples, np.sin(samples * half) / np.where(whole, 1.0, sine))
    return np.asarray(ratio * np.exp(-1j * (samples - 1) * half))
