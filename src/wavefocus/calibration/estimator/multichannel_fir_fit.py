"""Least squares for the causal FIRs of all actuators that play in one record, each with its own delay."""

import math

import numpy as np
import scipy.fft
import scipy.linalg

from wavefocus.calibration import Complex64Array, Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.calibration.estimator.causal_fit import toeplitz_product
from wavefocus.calibration.numerics import fourier_sum
from wavefocus.storage.errors import InputError

# Left vectors that are made at once, for little memory.
CHUNK = 16


def _causal_basis(
    bins: Int64Array, weight: Float64Array, period: int, taps: int, smallest: float
) -> tuple[Complex128Array, Float64Array, Float64Array]:
    """Find the singular triplets above `smallest` of the matrix ``weight_k exp(-j w_k n)``, ``w_k = 2 pi k / period``.

    Its Gram matrix is Toeplitz, so subspace iteration (Halko et al. 2011, algorithm 4.4) needs transforms and
    no matrix: memory for `rank` vectors, not for `taps` squared.

    bins, int64 (bins,): Numbers k of the frequencies, ascending, 0 to half the period.
    weight, float64 (bins,): Weight of each.
    period: Samples of the period, at least `taps`.
    taps: Length L of the responses.
    smallest: Singular values below this are left out, > 0.

    Returns left, complex128 (bins, rank): spectra, orthonormal when the coefficients are real and real and imaginary
    parts count as two; singular values, float64 (rank,), descending; right, float64 (rank, taps): responses,
    orthonormal.
    """
    power = np.zeros(period)
    power[bins] = np.square(weight)
    gram = toeplitz_product(period * scipy.fft.ifft(power)[:taps].real)
    most = min(taps, 2 * bins.size)
    wanted = min(most, int(2 * bins.size * taps / period) + 48)
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
    left = np.empty((bins.size, singular.size), dtype=np.complex128)
    for low in range(0, singular.size, CHUNK):
        part = slice(low, low + CHUNK)
        spectra = fourier_sum(right[part] / singular[part, None], 2 * np.pi / period, 0, int(bins[-1]) + 1)[:, bins]
        left[:, part] = (weight * spectra).T
    return left, singular, right


# Directions weaker than this share of the ridge would be damped to 1 % of themselves: left out.
CUT = 1e-2
# Directions weaker than this, in amplitude, are left at zero where noise alone explains them, as in `causal_fit`:
# noise of so many times its variance.
WEAK = 0.1
GARROTE = 3.0
# A joint fit keeps its directions in memory: this much, and no more.
MAX_JOINT_BYTES = 1 << 30


class JointFit:
    """Solve ``min sum_k power_k |H_k - sum_i exp(-j w_k delay_i) sum_n g_i[n] exp(-j w_k n)|^2 + ridge |g|^2``.

    Each FIR lives in the same few directions (`_causal_basis`), turned by its delay. Where the delays are evenly spaced
    on the ring of a period, a DFT over the slots takes the system apart into one small matrix per harmonic; any others
    make one matrix. They are inverted once.

    omega, float64 (bins,): Frequencies in radians per playback sample, multiples of one spacing, ascending.
    power, float64 (bins,): Squared magnitude of the base signal's spectrum, relative to its median in band.
    period: Samples of the ring.
    taps: Length L of the FIRs.
    delays, float64 (slots,): Delay of each slot in playback samples; L or more apart, round the ring.
    ridge: Penalty relative to the median power in band.

    Raises InputError: too much for the memory of a joint fit.
    """

    def __init__(
        self, omega: Float64Array, power: Float64Array, period: int, taps: int, delays: Float64Array, ridge: float
    ) -> None:
        # Singular vectors of the band's share of the taps, in double precision.
        needed = min(taps, 2 * omega.size * taps / period + 48) * (4 * 8 * taps + 2 * 16 * omega.size)
        if needed > MAX_JOINT_BYTES:
            raise InputError(
                f"actuators that play at once, {taps} taps and {omega.size} frequencies need {needed / 2**30:.1f} GiB; "
                f"at most {MAX_JOINT_BYTES / 2**30:g} GiB are taken: shorten the response, narrow the band, or let "
                "one actuator play at a time"
            )
        weight = np.sqrt(2 * power / period)
        bins = np.round(omega * period / (2 * np.pi)).astype(np.int64)
        left, singular, right = _causal_basis(bins, weight, period, taps, math.sqrt(CUT * ridge))
        self.weight = weight.astype(np.float32)
        self.elements = 2 * omega.size
        self._responses = (right / singular[:, None]).astype(np.float32)
        self._weak = np.flatnonzero(singular < WEAK)
        penalty, ring = ridge / singular**2, _ring_slots(delays, period, taps)
        if ring is not None:
            slots, self._chosen = ring
            turn = np.exp(-1j * omega * delays[0])
            self._slots: _EvenSlots | _AnySlots = _EvenSlots(left, bins, turn, slots, penalty)
        else:
            self._chosen = np.arange(delays.size)
            self._slots = _AnySlots(left, np.exp(-1j * np.outer(omega, delays)), penalty)
        self._left_over = max(self.elements - self._slots.freedom, 1.0)
        self.left_share = self._left_over / self.elements
        self._spread = self._slots.spread[self._weak].astype(np.float32)

    def solve(self, data: Complex64Array) -> tuple[Float32Array, Float64Array, Complex64Array]:
        """Fit one record.

        data, complex64 (bins,): Transfer from base signal to response, times `weight`.

        Returns float32 (slots, taps): FIRs, from the base signal to the response; float64 (slots,): energy that each
        explains of the whitened data; complex64 (bins,): what they leave of these.
        """
        found, shown = self._slots.fit(data)
        left = data - shown
        unexplained = float(np.vdot(left, left).real)
        variance = unexplained / self._left_over
        found = found[:, self._chosen]
        # The energy that noise leaves there is not the response's.
        energy = np.square(found).sum(axis=0, dtype=np.float64) - found.shape[0] * variance
        squared = np.maximum(np.square(found[self._weak]), np.float32(1e-30))
        noise = np.float32(GARROTE * variance) * self._spread[:, None]
        found[self._weak] *= np.maximum(1 - noise / squared, 0)
        return found.T @ self._responses, np.maximum(energy, 0), left


class _EvenSlots:
    """Fits slots that are evenly spaced on the ring, one harmonic q of them at a time.

    It shows in the bins q, q + slots, ... and, conjugate, in -q, -q + slots, ...

    left, complex128 (bins, rank): Spectra of the directions.
    bins, int64 (bins,): Numbers of the frequencies.
    turn, complex128 (bins,): Delay of the first slot.
    slots: How many.
    penalty, float64 (rank,): Of each direction.

    freedom: Of the fit.
    spread, float64 (rank,): Variance of the coefficients of each direction.
    """

    def __init__(
        self, left: Complex128Array, bins: Int64Array, turn: Complex128Array, slots: int, penalty: Float64Array
    ) -> None:
        of_harmonic = [np.flatnonzero(bins % slots == harmonic) for harmonic in range(slots)]
        rank, both = left.shape[1], slots // 2 + 1
        inverses = np.empty((both, rank, rank), dtype=np.complex64)
        self.freedom, self.spread = 0.0, np.zeros(rank)
        for harmonic in range(both):
            there, back = left[of_harmonic[harmonic]], left[of_harmonic[-harmonic]]
            gram = 0.5 * slots * (there.conj().T @ there + back.T @ back.conj())
            inverse = scipy.linalg.inv(gram + np.diag(penalty))
            inverses[harmonic] = inverse
            times = 1 if harmonic == 0 or 2 * harmonic == slots else 2
            self.freedom += times * float(np.einsum("ij,ji->", gram, inverse).real)
            self.spread += times / slots * np.diag(inverse).real
        self._inverses = inverses
        # One array for all: harmonics of fewer bins than others have the first bin once more, with nothing in it.
        most = max(of.size for of in of_harmonic)
        self._bins = np.array([np.pad(of, (0, most - of.size)) for of in of_harmonic])
        self._left = np.zeros((slots, most, rank), dtype=np.complex64)
        self._place = np.empty(bins.size, dtype=np.int64)
        for harmonic, of in enumerate(of_harmonic):
            self._left[harmonic, : of.size] = turn[of, None] * left[of]
            self._place[of] = harmonic * most + np.arange(of.size)

    def fit(self, data: Complex64Array) -> tuple[Float32Array, Complex64Array]:
        """Coefficients (rank, slots) of data (bins,), and the data that they make."""
        slots = len(self._left)
        sums = np.matmul(data[self._bins].conj()[:, None], self._left)[:, 0]
        harmonics = 0.5 * slots * (sums.conj() + sums[-np.arange(slots)])
        solved = np.matmul(self._inverses, harmonics[: len(self._inverses), :, None])
        found = np.fft.irfft(solved[:, :, 0], slots, axis=0)
        coefficients = np.fft.fft(found, axis=0).astype(np.complex64)
        shown = np.matmul(self._left, coefficients[:, :, None]).ravel()[self._place]
        return np.ascontiguousarray(found.T, dtype=np.float32), shown


class _AnySlots:
    """Fits slots of any delays, by one matrix.

    left, penalty; freedom, spread: See `_EvenSlots`.
    turns, complex128 (bins, slots): Delay of each slot.

    Raises InputError: it is too large.
    """

    def __init__(self, left: Complex128Array, turns: Complex128Array, penalty: Float64Array) -> None:
        rank, slots = left.shape[1], turns.shape[1]
        needed = 32 * rank * slots * (left.shape[0] + rank * slots)
        if needed > MAX_JOINT_BYTES:
            raise InputError(
                f"{slots} actuators that play at once with uneven delays need {needed / 2**30:.1f} GiB; at most "
                f"{MAX_JOINT_BYTES / 2**30:g} GiB are taken: use delays that are multiples of one part of the period"
            )
        columns = (left[:, :, None] * turns[:, None]).reshape(len(left), rank * slots)
        columns = np.concatenate([columns.real, columns.imag])
        gram, damping = columns.T @ columns, np.repeat(penalty, slots)
        gram.flat[:: len(gram) + 1] += damping
        inverse = np.linalg.inv(gram)
        own = np.diag(inverse)
        # The trace of undamped times inverse is the rank less what the damping takes.
        self.freedom = float(own.size - damping @ own)
        self.spread = own.reshape(rank, slots).mean(axis=1)
        self._inverse, self._left = inverse.astype(np.float32), left.astype(np.complex64)
        self._turns = turns.astype(np.complex64)

    def fit(self, data: Complex64Array) -> tuple[Float32Array, Complex64Array]:
        """See `_EvenSlots`."""
        seen = (self._left.T @ (data[:, None].conj() * self._turns)).real
        found = (self._inverse @ seen.ravel()).reshape(seen.shape)
        return found, np.einsum("bs,bs->b", self._left @ found.astype(np.complex64), self._turns)


def _ring_slots(delays: Float64Array, period: int, taps: int) -> tuple[int, Int64Array] | None:
    """Evenly spaced slots on the ring, `taps` or more apart, that hold all delays: how many; which each is."""
    for slots in range(delays.size, period // taps + 1):
        place = (delays - delays[0]) * (slots / period)
        whole = np.round(place)
        if np.abs(place - whole).max() * period / slots < 1e-6:
            chosen = whole.astype(np.int64) % slots
            if np.unique(chosen).size == delays.size:
                return slots, chosen
    return None
