"""Least squares for a causal FIR of L taps from a response spectrum in a band, with a matrix or without."""

from collections.abc import Callable

import numpy as np
import scipy.fft
import scipy.linalg

from wavefocus.calibration import Complex64Array, Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.known_signal import MAX_PPM
from wavefocus.calibration.numerics import fourier_sum, periodic_signal

Operator = Callable[[Float64Array], Float64Array]

RIDGE = 1e-6
"""Penalty on a response's energy relative to the excitation's median power in band."""
# Clock ratios at which the solution is exact; between them a polynomial, good to -110 dB for 0.2 s of 500 Hz.
NODES = 5
# Directions weaker than this share of the ridge would be damped to 1 % of themselves: left out.
CUT = 1e-2
# Directions that magnify noise more than threefold, and how much above it (in energy) they must stand.
WEAK = 0.3
GARROTE = 5.0


class CausalFit:
    """Solve ``min_g sum_k power_k |H_k - sum_n g_n exp(-j ratio w_k n)|^2 + ridge |g|^2`` for many H at once.

    With power the nominal drive's, this is the maximum-likelihood fit for white noise on the response. The
    matrix has about 2 * band * response length directions; an SVD keeps those. H lives on the DAQ clock, g on
    the playback clock: `ratio` between them enters the matrix, whose solution is made at a few ratios and
    interpolated, so that every record is fitted at its own.

    omega, float64 (bins,): Frequencies in radians per DAQ sample, ascending, spaced by ``2 pi / period``.
    power, float64 (bins,): Squared magnitude of the nominal drive's spectrum, relative to its median in band.
    period: Samples of the period.
    taps: Length L of the FIR.
    ridge: Penalty relative to the median power in band.

    weight, float32 (bins,): What whitens a spectrum.
    """

    def __init__(self, omega: Float64Array, power: Float64Array, period: int, taps: int, ridge: float) -> None:
        weight = np.sqrt(2 * power / period)
        delay = np.arange(taps)
        matrix = _stacked(weight[:, None] * np.exp(-1j * omega[:, None] * delay))
        left, singular, right = _dominant_svd(matrix, period, np.sqrt(CUT * ridge))
        self.rank = singular.size
        self._weak = np.flatnonzero(singular < WEAK)
        self.elements = matrix.shape[0]
        self.weight = weight.astype(np.float32)
        self._left = left.astype(np.float32)
        self._right = np.ascontiguousarray(right.astype(np.float32))
        self._nodes = 1e-6 * MAX_PPM * np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
        solutions = []
        for skew in self._nodes:
            skewed = _stacked(weight[:, None] * np.exp(-1j * (1 + skew) * omega[:, None] * delay)) @ right.T
            gram = skewed.T @ skewed
            gram[np.diag_indices_from(gram)] += ridge
            solutions.append(scipy.linalg.solve(gram, skewed.T @ left, assume_a="pos").T)
        self._solutions = np.concatenate(solutions).astype(np.float32)

    def solve(self, spectrum: Complex64Array, skew: Float64Array) -> tuple[Float32Array, Complex64Array]:
        """Fit spectra (records, bins), each at its own clock ratio minus 1 (records,).

        Returns float32 (records, taps): FIRs on the playback clock; complex64 (records, bins): what they leave of the
        spectra times `weight`.

        A direction that the sweep hardly excites, at the band's very edge, gives its noise back magnified by
        the inverse of its singular value. Where noise alone explains it, it is better left at zero: the
        non-negative garrote (Breiman 1995). Strong directions pass untouched, so the fit stays linear there.
        """
        weighted = spectrum * self.weight
        data = np.concatenate([weighted.real, weighted.imag], axis=1)
        coefficients = data @ self._left
        # Explicitly, since the difference of the two energies cancels to nothing in float32.
        unexplained = data - coefficients @ self._left.T
        # The FIR's own freedom swallows its share of the noise.
        variance = np.square(unexplained).sum(axis=1, dtype=np.float64) / max(self.elements - self.rank, 1)
        noise = (GARROTE * variance).astype(np.float32)[:, None]
        squared = np.maximum(np.square(coefficients[:, self._weak]), np.float32(1e-30))
        coefficients[:, self._weak] *= np.maximum(1 - noise / squared, 0)
        bins = self.weight.size
        whitened = np.empty((len(data), bins), dtype=np.complex64)
        whitened.real, whitened.imag = unexplained[:, :bins], unexplained[:, bins:]
        return self._taps(coefficients, skew), whitened

    def _taps(self, coefficients: Float32Array, skew: Float64Array) -> Float32Array:
        """FIRs (records, L) on the playback clock; `skew` (records,) is each record's clock ratio minus 1."""
        difference = skew[:, None] - self._nodes
        lagrange = np.ones_like(difference)
        for i, node in enumerate(self._nodes):
            for j, other in enumerate(self._nodes):
                if i != j:
                    lagrange[:, i] *= difference[:, j] / (node - other)
        spread = (lagrange.astype(np.float32)[:, :, None] * coefficients[:, None, :]).reshape(len(coefficients), -1)
        return np.asarray((spread @ self._solutions) @ self._right)


def _stacked(matrix: Complex128Array) -> Float64Array:
    return np.concatenate([matrix.real, matrix.imag])


def _dominant_svd(
    matrix: Float64Array, period: int, smallest: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Singular triplets above `smallest`, by subspace iteration (Halko et al. 2011, algorithm 4.4).

    Singular values of a time- and band-limited matrix fall off a cliff, so two iterations are exact.
    """
    rows, taps = matrix.shape
    most = min(rows, taps)
    wanted = min(most, int(rows * taps / period) + 48)
    while True:
        start = np.random.default_rng(0).standard_normal((taps, wanted))
        basis = np.linalg.qr(matrix @ start)[0]
        for _ in range(2):
            basis = np.linalg.qr(matrix @ (matrix.T @ basis))[0]
        inner, singular, right = scipy.linalg.svd(basis.T @ matrix, full_matrices=False, check_finite=False)
        if singular[-1] < smallest or wanted == most:
            keep = singular >= smallest
            return basis @ inner[:, keep], singular[keep], right[keep]
        wanted = min(most, wanted + wanted // 2)


# Conjugate gradients end at this residual relative to the right-hand side, in the preconditioner's norm.
CG_TOLERANCE = 1e-7
MAX_STEPS = 400
# The penalty follows the noise (see `ToeplitzFit`), up to this: it costs strong directions 1 % at most.
MAX_RIDGE = 1e-2


class ToeplitzFit:
    """Solve what `wavefocus.calibration.estimator.causal_fit.CausalFit` solves, for matrices too large to hold.

    The normal equations of a causal FIR are Toeplitz, at any ratio of the clocks: transforms multiply by them,
    and a circulant preconditioner (T. Chan, SIAM J. Sci. Stat. Comput. 9, 1988) keeps the conjugate gradients to
    some hundred steps. Memory and time grow as the taps and bins do, but for a logarithm.

    The penalty is the larger of `ridge` and the noise's variance over the mean energy of a tap, which for a white
    response makes the error least. It does to the directions that the sweep hardly excites what the garrote does
    in `CausalFit`.

    omega, power, period, taps, ridge; weight: See `CausalFit`.
    """

    def __init__(self, omega: Float64Array, power: Float64Array, period: int, taps: int, ridge: float) -> None:
        self._taps, self._ridge = taps, ridge
        self._first = round(float(omega[0]) * period / (2 * np.pi))
        self._turn = 2 * np.pi / period
        self._square = 2 * power / period
        self.weight = np.sqrt(self._square).astype(np.float32)
        self.elements = 2 * omega.size
        # Directions that show in the band: its share of the taps, and a few at each of its edges.
        self.rank = int(min(taps, self.elements * taps / period + 2 * np.log(taps + 1)))

    def solve(self, spectrum: Complex64Array, skew: Float64Array) -> tuple[Float32Array, Complex64Array]:
        """See `CausalFit`."""
        left = np.empty_like(spectrum)
        green = np.empty((len(spectrum), self._taps), dtype=np.float32)
        for row, values in enumerate(spectrum):
            left[row], green[row] = self._solved(values.astype(np.complex128), 1 + float(skew[row]))
        return green, left

    def _solved(self, spectrum: Complex128Array, ratio: float) -> tuple[Complex64Array, Float32Array]:
        turn = self._turn * ratio

        def responses(amplitudes: Complex128Array) -> Float64Array:
            return periodic_signal(amplitudes, turn, self._first, self._taps)

        kernel = responses(self._square.astype(np.complex128))
        wanted = responses(self._square * spectrum)
        product = toeplitz_product(kernel)
        green, ridge = np.zeros(self._taps), self._ridge
        for _ in range(2):
            green = conjugate_gradients(product, wanted, ridge, circulant_inverse(kernel, ridge), green)
            shown = fourier_sum(green, turn, self._first, spectrum.size)
            left = self.weight * (spectrum - shown)
            variance = float(np.vdot(left, left).real) / max(self.elements - self.rank, 1)
            energy = float(green @ green) / self._taps
            likely = min(max(variance / energy, self._ridge), MAX_RIDGE) if energy > 0 else ridge
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
    return lambda taps_: np.asarray(scipy.fft.irfft(scipy.fft.rfft(taps_, length) * symbol, length)[..., :taps])


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
    """Solve ``(gram + ridge) x = wanted`` from `start`, preconditioned by `inverse`, to a relative residual."""
    goal = CG_TOLERANCE**2 * float(np.vdot(wanted, inverse(wanted)))
    found = start.copy()
    left = wanted - gram(found) - ridge * found
    even = inverse(left)
    step, size = even.copy(), float(np.vdot(left, even))
    for _ in range(MAX_STEPS):
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
