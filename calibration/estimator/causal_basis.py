"""The few directions in which a causal response of L taps shows in a band: the basis of every joint fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.linalg
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

# Bins of the left vectors that are made at once, for little memory.
CHUNK = 512


@dataclass(frozen=True, slots=True, eq=False)
class CausalBasis:
    """Singular triplets of the map from L taps to a weighted spectrum.

    left, complex128 (bins, rank): Spectra; orthonormal when the coefficients are real and real and imaginary parts
        count as two.
    singular, float64 (rank,): Descending.
    right, float64 (rank, taps): Responses, orthonormal.
    """

    left: Complex128Array
    singular: Float64Array
    right: Float64Array


def causal_basis(omega: Float64Array, weight: Float64Array, taps: int, smallest: float) -> CausalBasis:
    """Find the singular triplets above `smallest` of the matrix ``weight_k exp(-j omega_k n)``.

    Its Gram matrix is Toeplitz, so subspace iteration (Halko et al. 2011, algorithm 4.4) needs transforms and
    no matrix: memory for `rank` vectors, not for `taps` squared.

    omega, float64 (bins,): Frequencies in radians per sample, multiples of one spacing, ascending.
    weight, float64 (bins,): Weight of each.
    taps: Length L of the responses.
    smallest: Singular values below this are left out, > 0.

    Returns CausalBasis.
    """
    length = scipy.fft.next_fast_len(2 * taps, real=True)
    kernel = np.zeros(length)
    lags = np.arange(taps)
    for low in range(0, omega.size, CHUNK):
        part = slice(low, low + CHUNK)
        kernel[:taps] += np.square(weight[part]) @ np.cos(np.outer(omega[part], lags))
    kernel[length - taps + 1 :] = kernel[taps - 1 : 0 : -1]
    symbol = scipy.fft.rfft(kernel)

    def gram(responses: Float64Array) -> Float64Array:
        spread = scipy.fft.irfft(scipy.fft.rfft(responses, length) * symbol, length)
        return np.asarray(spread[:, :taps])

    spacing = float(np.diff(omega).min()) if omega.size > 1 else np.pi
    most = min(taps, 2 * omega.size)
    wanted = min(most, int(omega.size * taps * spacing / np.pi) + 48)
    while True:
        found = np.random.default_rng(0).standard_normal((wanted, taps))
        for _ in range(4):
            found = np.linalg.qr(gram(found).T)[0].T
        square, turn = scipy.linalg.eigh(found @ gram(found).T)
        square, turn = square[::-1], turn[:, ::-1]
        if square[-1] < smallest**2 or wanted == most:
            break
        wanted = min(most, wanted + wanted // 2)
    keep = square > smallest**2
    singular = np.sqrt(square[keep])
    right = turn.T[keep] @ found
    left = np.empty((omega.size, singular.size), dtype=np.complex128)
    for low in range(0, omega.size, CHUNK):
        part = slice(low, low + CHUNK)
        steering = weight[part, None] * np.exp(-1j * np.outer(omega[part], lags))
        left[part] = steering @ (right / singular[:, None]).T
    return CausalBasis(left, singular, right)
