"""Least squares for a causal FIR of any length, by conjugate gradients and transforms, without a matrix."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from calibration.clock.czt import fourier_sum, ring_signal
from calibration.estimator.fir_least_squares import CausalSolution

Float64Array = NDArray[np.float64]
Complex64Array = NDArray[np.complex64]

# Conjugate gradients end at this residual relative to the right-hand side, in the preconditioner's norm.
ENOUGH = 1e-7
MOST_STEPS = 400
# The penalty follows the noise (see `ToeplitzFit`), up to this: it costs strong directions 1 % at most.
MOST_RIDGE = 1e-2

Operator = Callable[[Float64Array], Float64Array]


class ToeplitzFit:
    """Solve what `calibration.estimator.fir_least_squares.CausalFit` solves, for matrices too large to hold.

    The normal equations of a causal FIR are Toeplitz, at any ratio of the clocks: transforms multiply by them,
    and a circulant preconditioner (T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988) keeps the conjugate gradients to
    some hundred steps. Memory and time grow as the taps and bins do, but for a logarithm.

    The penalty is the larger of `ridge` and the noise's variance over the mean energy of a tap, which for a white
    response makes the error least. It does to the directions that the sweep hardly excites what the garrote does
    in `CausalFit`.

    omega, power, period, taps, ridge: As of `CausalFit`.
    """

    def __init__(self, omega: Float64Array, power: Float64Array, period: int, taps: int, ridge: float) -> None:
        self._taps, self._ridge = taps, ridge
        self._first = round(float(omega[0]) * period / (2 * np.pi))
        self._turn = 2 * np.pi / period
        self._square = 2 * power / period
        self._weight = np.sqrt(self._square).astype(np.float32)
        self.elements = 2 * omega.size
        # Directions that show in the band: its share of the taps, and a few at each of its edges.
        self.rank = int(min(taps, self.elements * taps / period + 2 * np.log(taps + 1)))

    def solve(self, spectrum: Complex64Array, skew: Float64Array) -> CausalSolution:
        """Fit spectra (records, bins), each at its own clock ratio minus 1 (records,)."""
        whitened = spectrum * self._weight
        left, green = np.empty_like(whitened), np.empty((len(spectrum), self._taps), dtype=np.float32)
        for row, one in enumerate(spectrum):
            left[row], green[row] = self._solved(one.astype(np.complex128), 1 + float(skew[row]))
        unexplained = _energy(left)
        return CausalSolution(
            green=green,
            whole=_energy(whitened),
            left=unexplained,
            variance=unexplained / max(self.elements - self.rank, 1),
            whitened=left,
            missed=(left / self._weight).astype(np.complex64),
        )

    def _solved(self, spectrum: NDArray[np.complex128], ratio: float) -> tuple[Complex64Array, NDArray[np.float32]]:
        turn = self._turn * ratio

        def responses(amplitudes: NDArray[np.complex128]) -> Float64Array:
            return ring_signal(amplitudes, turn, self._first, self._taps)

        kernel = responses(self._square.astype(np.complex128))
        wanted = responses(self._square * spectrum)
        gram = toeplitz_product(kernel)
        green, ridge = np.zeros(self._taps), self._ridge
        for _ in range(2):
            green = conjugate_gradients(gram, wanted, ridge, circulant_inverse(kernel, ridge), green)
            shown = fourier_sum(green, turn, self._first, spectrum.size)
            left = self._weight * (spectrum - shown)
            variance = float(np.vdot(left, left).real) / max(self.elements - self.rank, 1)
            energy = float(green @ green) / self._taps
            likely = min(max(variance / energy, self._ridge), MOST_RIDGE) if energy > 0 else ridge
            if likely <= 2 * ridge:
                break
            ridge = likely
        return left.astype(np.complex64), green.astype(np.float32)


def toeplitz_product(kernel: Float64Array) -> Operator:
    """Multiplication by the symmetric Toeplitz matrix with the first column `kernel` (taps,)."""
    taps = kernel.size
    length = scipy.fft.next_fast_len(2 * taps, real=True)
    ring = np.zeros(length)
    ring[:taps] = kernel
    ring[length - taps + 1 :] = kernel[:0:-1]
    symbol = scipy.fft.rfft(ring)
    return lambda taps_: np.asarray(scipy.fft.irfft(scipy.fft.rfft(taps_, length) * symbol, length)[:taps])


def circulant_inverse(kernel: Float64Array, ridge: float) -> Operator:
    """The inverse of the circulant matrix nearest to a symmetric Toeplitz one, plus `ridge` on its diagonal."""
    taps = kernel.size
    share = np.arange(taps) / taps
    ring = (1 - share) * kernel
    ring[1:] += share[1:] * kernel[:0:-1]
    symbol = np.maximum(scipy.fft.rfft(ring).real, 0) + ridge
    return lambda taps_: np.asarray(scipy.fft.irfft(scipy.fft.rfft(taps_) / symbol, taps))


def conjugate_gradients(
    gram: Operator, wanted: Float64Array, ridge: float, inverse: Operator, start: Float64Array
) -> Float64Array:
    """Solve ``(gram + ridge) x = wanted`` from `start`, preconditioned by `inverse`."""
    goal = ENOUGH**2 * float(np.vdot(wanted, inverse(wanted)))
    found = start.copy()
    left = wanted - gram(found) - ridge * found
    even = inverse(left)
    step, size = even.copy(), float(np.vdot(left, even))
    for _ in range(MOST_STEPS):
        if size <= goal:
            break
        turned = gram(step) + ridge * step
        length = size / max(float(np.vdot(step, turned)), 1e-300)
        found += length * step
        left -= length * turned
        even = inverse(left)
        before, size = size, float(np.vdot(left, even))
        step = even + (size / before) * step
    return found


def _energy(rows: Complex64Array) -> Float64Array:
    return np.asarray(np.square(np.abs(rows)).sum(axis=1, dtype=np.float64))
