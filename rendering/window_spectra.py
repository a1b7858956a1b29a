"""Spectra of windows as an economy has them: the bins it keeps, and how large the others are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.omission import SQUARES_LOST, SQUARES_SLACK, Economy
from rendering.windows import Windows

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Complex64Array = NDArray[np.complex64]

FRAMES = (32, 64)
"""Windows no longer than one of these are transformed by a matrix product in single precision, which is faster."""
FINENESS = 10
"""Magnitudes of short windows are looked at in so many bins per sample of a window."""


@dataclass(frozen=True, slots=True)
class WindowSpectra:
    """Spectra of some windows.

    Parameters
    ----------
    kept : complex array, shape (windows, kept bins)
        The bins that an economy keeps.
    largest : float64 array, shape (windows, segments + 1)
        `Economy.largest`; no segment where nothing is left out.
    errors : float64 array, shape (windows,)
        Bounds on what rounding makes of any bin, beyond the last digit of the largest.
    band_energy, energy : float
        Squares of magnitudes added up over a band, and over all bins.
    """

    kept: NDArray[Any]
    largest: Float64Array
    errors: Float64Array
    band_energy: float
    energy: float


def window_spectra(
    windows: Windows, first: int, last: int, fft_samples: int, economy: Economy, band: slice
) -> WindowSpectra:
    """Transform windows first to last - 1.

    Parameters
    ----------
    windows : Windows
        Windows of some blocks.
    first, last : int
        Which of them, at least one.
    fft_samples : int
        Transform length.
    economy : Economy
        Precision, and bins to keep.
    band : slice
        Bins whose energy is added up.
    """
    within = band.stop == 0 or (economy.low <= band.start and band.stop <= economy.high)
    if economy.single and within and not windows.of_signals:
        start, stop = windows.spans(first, last)
        lengths = stop - start
        for frame in FRAMES:
            if 2 * np.count_nonzero(lengths <= frame) > last - first and FINENESS * 2 * frame <= fft_samples:
                return _joined(windows, first, start, lengths, frame, fft_samples, economy, band)
    return _long(windows, np.arange(first, last), fft_samples, economy, band)


def rounding_of(windows: Windows, chosen: Int64Array) -> Float64Array:
    """`WindowSpectra.errors` that are to be expected of some windows in single precision."""
    errors = np.zeros(len(chosen))
    if windows.of_signals or not len(chosen):
        return errors
    start, stop = windows.spans(0, len(windows))
    for frame in FRAMES[::-1]:
        short = (stop - start)[chosen] <= frame
        if short.any():
            number = start[chosen[short]] // frame
            values = windows.samples(chosen[short], 2 * frame, shift=number * frame)
            longest = int((stop - start)[chosen[short]].max())
            errors[short] = (longest + 5) * 2.0**-24 * np.abs(values).sum(axis=1)
    return errors


def _long(windows: Windows, chosen: Int64Array, fft_samples: int, economy: Economy, band: slice) -> WindowSpectra:
    whole = windows.spectra(chosen, fft_samples).astype(economy.complex, copy=False)
    squared = economy.squared(whole)
    return WindowSpectra(
        whole[:, economy.low : economy.high],
        np.zeros((len(chosen), 0)) if economy.exact else economy.largest(squared),
        np.zeros(len(chosen)),
        float(squared[:, band].sum(axis=1).sum(dtype=np.float64)),
        float(squared.sum(axis=1).sum(dtype=np.float64)),
    )


def _joined(
    windows: Windows,
    first: int,
    start: Int64Array,
    lengths: Int64Array,
    frame: int,
    fft_samples: int,
    economy: Economy,
    band: slice,
) -> WindowSpectra:
    """Short windows, and the few long ones among them."""
    short = lengths <= frame
    number = np.arange(first, first + len(start))
    longest = int(lengths[short].max())
    found = _short(windows, number[short], start[short] // frame, longest, frame, fft_samples, economy, band)
    if short.all():
        return found
    kept = np.empty((len(start), economy.kept), dtype=np.complex64)
    largest, errors = np.empty((len(start), economy.segments + 1)), np.empty(len(start))
    parts = [(short, found)]
    parts.append((~short, _long(windows, number[~short], fft_samples, economy, band)))
    for where, part in parts:
        kept[where], largest[where], errors[where] = part.kept, part.largest, part.errors
    return WindowSpectra(
        kept, largest, errors, sum(part.band_energy for _, part in parts), sum(part.energy for _, part in parts)
    )


def _short(
    windows: Windows,
    chosen: Int64Array,
    number: Int64Array,
    longest: int,
    frame: int,
    fft_samples: int,
    economy: Economy,
    band: slice,
) -> WindowSpectra:
    """Transform windows of at most `longest` samples from the frame that they begin in, and turn them to their block.

    Each bin is a sum of that many products of a value and a factor of magnitude 1, so errs by no more than the
    magnitudes' sum times the unit roundoff for each of them and for the factor (N. Higham, Accuracy and
    Stability of Numerical Algorithms, 2nd ed., section 3.1). Its square is a trigonometric polynomial of degree
    d < longest; at points h apart it is at most h**2 / 8 times its second derivative short of its largest value
    between them, and that derivative is at most d**2 times its largest value of all (Bernstein), which is at most
    1 / cos(d h / 2) times that at any of the points (Ehlich and Zeller).
    """
    values = windows.samples(chosen, 2 * frame, np.float32, number * frame)
    every = fft_samples // (2 * frame * FINENESS // 2)
    low, high = economy.low, economy.high
    kept = _product(values, _transform(fft_samples, frame, low, high, 1))
    kept *= _turns(fft_samples, frame, low, high)[number]
    coarse = economy.squared(_product(values, _transform(fft_samples, frame, 0, fft_samples // 2 + 1 + every, every)))
    angle = 2.0 * np.pi * every / fft_samples
    rise = (angle * longest) ** 2 / 8.0 / np.cos(longest * angle / 2.0)
    # The points within a segment, and the next one on either side of it.
    begin = economy.starts // every
    end = -(-np.append(economy.starts[1:], economy.bins) // every) + 1
    between = np.stack([begin, end], axis=1).ravel()
    largest = np.maximum.reduceat(np.pad(coarse, ((0, 0), (0, 1))), between, axis=1)[:, ::2].astype(np.float64)
    peak = coarse.max(axis=1)[:, None].astype(np.float64)
    magnitude = np.sqrt(np.concatenate([largest + rise * peak, (1.0 + rise) * peak], axis=1))
    size = np.abs(values).sum(axis=1, dtype=np.float64)
    errors = (longest + 5) * 2.0**-24 * size
    energy = fft_samples / 2 * float(np.einsum("wt,wt->w", values, values).sum(dtype=np.float64))
    in_band = economy.squared(np.ascontiguousarray(kept[:, max(band.start - low, 0) : max(band.stop - low, 0)]))
    largest = magnitude * SQUARES_SLACK + SQUARES_LOST + errors[:, None]
    return WindowSpectra(kept, largest, errors, float(in_band.sum(axis=1).sum(dtype=np.float64)), energy)


def _product(values: NDArray[np.float32], transform: Complex64Array) -> Complex64Array:
    product: Complex64Array = (values @ transform.view(np.float32)).view(np.complex64)
    return product


@lru_cache(maxsize=8)
def _transform(fft_samples: int, frame: int, low: int, high: int, every: int) -> Complex64Array:
    """Matrix of the transform of 2 frame samples to every so many bins, (2 frame, bins)."""
    product = np.arange(2 * frame)[:, None] * np.arange(low, high, every) % fft_samples
    factors: Complex64Array = np.exp(-2j * np.pi / fft_samples * product).astype(np.complex64)
    return factors


@lru_cache(maxsize=4)
def _turns(fft_samples: int, frame: int, low: int, high: int) -> Complex64Array:
    """What a delay by a number of frames does to a bin, (frames, bins)."""
    product = (frame * np.arange(-(-fft_samples // frame)))[:, None] * np.arange(low, high) % fft_samples
    factors: Complex64Array = np.exp(-2j * np.pi / fft_samples * product).astype(np.complex64)
    return factors
