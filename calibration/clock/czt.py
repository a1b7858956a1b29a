"""Fourier sums at evenly spaced frequencies of any spacing: exact, so that clocks need no interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, next_fast_len

Complex128Array = NDArray[np.complex128]
Float64Array = NDArray[np.float64]


def fourier_sum(signal: Float64Array | Complex128Array, turn: float, first: int, bins: int) -> Complex128Array:
    """Fourier sum of signals at evenly spaced frequencies, by Bluestein's chirp transform.

    ``sum over n of signal[..., n] * exp(-j * n * turn * (first + m))`` for m = 0 ... bins - 1.

    signal, float64 or complex128 (..., samples): Any signals.
    turn: Spacing of the frequencies in radians per sample.
    first, bins: The first frequency is ``first * turn``; how many there are.

    Returns complex128 (..., bins). Source: Bluestein, "A linear filtering approach to the computation of discrete
    Fourier transform" (1970).
    """
    samples = signal.shape[-1]
    index = np.arange(samples, dtype=np.float64)
    bin_index = np.arange(bins, dtype=np.float64)
    between = np.arange(1 - samples, bins, dtype=np.float64)
    length = next_fast_len(between.size)
    down = signal * np.exp(-1j * turn * index * (first + 0.5 * index))
    up = np.exp(0.5j * turn * between**2)
    product = ifft(fft(down, length) * fft(up, length))[..., samples - 1 : between.size]
    return np.asarray(product * np.exp(-0.5j * turn * bin_index**2), dtype=np.complex128)


def ring_signal(spectrum: Complex128Array, turn: float, first: int, samples: int) -> Float64Array:
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
