"""Spectra of periodic signals in a low band, and signals from them."""

from __future__ import annotations

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex64Array, Complex128Array, Float32Array, Float64Array, Int64Array
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


# What lies above the kept band is folded onto it at most this strongly.
ALIAS_DB = 70.0
# Blocks of this many samples or fewer keep the matrix product cheaper than the transform it saves.
MAX_BLOCK = 160


class BandSpectrum:
    """Discrete Fourier transform of segments of one period, in only some low bins.

    The segment, taken as periodic, is low-pass filtered and decimated in one matrix product, then transformed.
    A response and its reference go through the same filter; the spectra are corrected for it all the same.

    period: Samples of a segment.
    bins: Bins wanted, of the period // 2 + 1 there are.
    """

    def __init__(self, period: int, bins: slice) -> None:
        self.period = period
        self.bins = bins
        self._decimation, self._block = _cheapest(period, bins.stop / period)
        self._matrix = np.zeros((0, 0), dtype=np.float32)
        self._correction = np.ones(bins.stop - bins.start, dtype=np.complex64)
        if self._decimation > 1:
            self._design()

    def _design(self) -> None:
        decimation, block = self._decimation, self._block
        shift, half = _reach(decimation, block)
        around = np.arange(-half, half + 1)
        transition = 2 * np.pi * (1 / decimation - 2 * self.bins.stop / self.period)
        attenuation = 8 + 2.285 * transition * 2 * half
        filter_ = np.sinc(around / decimation) * np.kaiser(around.size, 0.1102 * (attenuation - 8.7))
        both = np.zeros((2 * block, block // decimation))
        for output in range(block // decimation):
            both[output * decimation + shift + around, output] = filter_
        self._matrix = np.concatenate([both[:block], both[block:]], axis=1).astype(np.float32)
        omega = 2 * np.pi * np.arange(self.bins.start, self.bins.stop) / self.period
        passed = np.cos(omega[:, None] * around) @ filter_
        self._correction = (decimation * np.exp(-1j * omega * shift) / passed).astype(np.complex64)

    def __call__(self, recording: Float32Array, starts: Int64Array) -> Complex64Array:
        """Spectra of segments of recordings.

        recording, float32 (records, samples): Recordings, contiguous.
        starts, int64 (records, segments): First samples; each segment lies inside its recording.

        Returns complex64 (records, segments, bins).
        """
        if self._decimation == 1:
            segments = np.empty((*starts.shape, self.period), dtype=np.float32)
            for record, row in enumerate(starts):
                for segment, start in enumerate(row):
                    segments[record, segment] = recording[record, start : start + self.period]
            return np.ascontiguousarray(scipy.fft.rfft(segments, overwrite_x=True)[..., self.bins])
        blocks, width = self.period // self._block, self._block // self._decimation
        product = np.empty((*starts.shape, blocks, 2 * width), dtype=np.float32)
        for record, row in enumerate(starts):
            for segment, start in enumerate(row):
                piece = recording[record, start : start + self.period].reshape(blocks, self._block)
                np.matmul(piece, self._matrix, out=product[record, segment])
        thin = np.empty((*starts.shape, blocks, width), dtype=np.float32)
        np.add(product[..., :-1, :width], product[..., 1:, width:], out=thin[..., :-1, :])
        np.add(product[..., -1, :width], product[..., 0, width:], out=thin[..., -1, :])
        spectra = scipy.fft.rfft(thin.reshape(*starts.shape, -1), overwrite_x=True)
        return np.asarray(spectra[..., self.bins] * self._correction)


def _reach(decimation: int, block: int) -> tuple[int, int]:
    """Where the first output of a block lies, and how far its filter reaches inside two blocks."""
    shift = (block + decimation) // 2
    return shift, min(shift, block + decimation - 1 - shift)


def _cheapest(period: int, highest: float) -> tuple[int, int]:
    """Thinning and block length that divide the period and cost least; (1, period) if none will do."""
    best, least = (1, period), np.inf
    for decimation in range(2, 33):
        transition = 2 * np.pi * (1 / decimation - 2 * highest)
        if period % (2 * decimation) or transition <= 0:
            continue
        for block in range(2 * decimation, MAX_BLOCK + 1, decimation):
            enough = 8 + 2.285 * transition * 2 * _reach(decimation, block)[1] >= ALIAS_DB
            # Products cost in proportion to the block; 50 is what the transform costs on that scale.
            if period % block == 0 and enough and (block + 50) / decimation < least:
                best, least = (decimation, block), (block + 50) / decimation
    return best
