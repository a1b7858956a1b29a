"""Spectra of windows as an economy has them: the bins it keeps, and how large the others are."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.omission import SQUARES_LOST, SQUARES_SLACK, TRANSFORM, Economy
from rendering.drive.windows import Windows
from rendering.inner_loops import InnerLoops, Runs, WindowTransform, inner_loops, transformable
from rendering.shared_work import shares

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
    errors, blurs : float64 array, shape (windows,)
        Bounds on what rounding makes of any bin beyond the last digit of the largest, and on the norm of that over
        all bins.
    band_energy, energy : float
        Squares of magnitudes added up over a band, and over all bins.
    """

    kept: NDArray[Any]
    largest: Float64Array
    errors: Float64Array
    blurs: Float64Array
    band_energy: float
    energy: float


def window_spectra(
    windows: Windows, first: int, last: int, fft_samples: int, economy: Economy, band: slice, workers: Executor
) -> Callable[[], WindowSpectra]:
    """Begin to transform windows first to last - 1; what is returned waits for the end.

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
    workers : Executor
        Transforms.
    """
    within = band.stop == 0 or (economy.low <= band.start and band.stop <= economy.high)
    if economy.single and within and not windows.of_signals:
        start, stop = windows.spans(first, last)
        lengths = stop - start
        for frame in FRAMES:
            if 2 * np.count_nonzero(lengths <= frame) > last - first and FINENESS * 2 * frame <= fft_samples:
                return _joined(windows, first, start, lengths, frame, fft_samples, economy, band, workers)
    return _long(windows, np.arange(first, last), fft_samples, economy, band, workers)


def magnitudes(windows: Windows, chosen: Int64Array, fft_samples: int, economy: Economy) -> Float64Array:
    """Magnitudes of some windows' spectra in the precision of an economy, (len(chosen), bins)."""
    if windows.of_signals:
        return np.abs(windows.spectra(chosen, fft_samples))
    spectra = scipy_fft.rfft(windows.samples(chosen, fft_samples, economy.real), axis=1)
    return np.abs(spectra).astype(np.float64)


def rounding_of(windows: Windows, chosen: Int64Array, fft_samples: int) -> tuple[Float64Array, Float64Array]:
    """`WindowSpectra.errors` and `.blurs` that are to be expected of some windows in single precision."""
    errors, blurs = np.zeros(len(chosen)), np.zeros(len(chosen))
    if windows.of_signals or not len(chosen):
        return errors, blurs
    start, stop = windows.spans(0, len(windows))
    lengths = (stop - start)[chosen]
    samples = windows.samples(chosen, fft_samples)
    sums, norms = np.abs(samples).sum(axis=1), np.sqrt(np.einsum("ij,ij->i", samples, samples))
    short = lengths <= max(FRAMES)
    errors, blurs = _rounding_of_sums(lengths.max(where=short, initial=0), sums, fft_samples)
    rest = _rounding_of_transforms(norms[~short], fft_samples)
    errors[~short] = blurs[~short] = rest
    return errors, blurs


def _long(
    windows: Windows, chosen: Int64Array, fft_samples: int, economy: Economy, band: slice, workers: Executor
) -> Callable[[], WindowSpectra]:
    loops = inner_loops() if economy.single and transformable(fft_samples) else None
    runs = None if loops is None else windows.runs(chosen)
    if loops is not None and runs is not None:
        return _by_loops(loops, *runs, fft_samples, economy, band, workers)
    blurs = np.zeros(len(chosen))
    if windows.of_signals:
        whole = workers.submit(windows.spectra, chosen, fft_samples)
    else:
        samples = windows.samples(chosen, fft_samples, economy.real)
        whole = workers.submit(scipy_fft.rfft, samples, axis=1)
        if economy.single:
            norms = np.sqrt(np.einsum("ij,ij->i", samples, samples)) * SQUARES_SLACK
            blurs = _rounding_of_transforms(norms + SQUARES_LOST * np.sqrt(fft_samples), fft_samples)

    def end() -> WindowSpectra:
        spectra = whole.result().astype(economy.complex, copy=False)
        squared = economy.squared(spectra)
        return WindowSpectra(
            spectra[:, economy.low : economy.high],
            np.zeros((len(chosen), 0)) if economy.exact else economy.largest(squared),
            blurs,
            blurs,
            float(squared[:, band].sum(axis=1).sum(dtype=np.float64)),
            float(squared.sum(axis=1).sum(dtype=np.float64)),
        )

    return end


def _by_loops(
    loops: InnerLoops,
    runs: Runs,
    bounds: Int64Array,
    fft_samples: int,
    economy: Economy,
    band: slice,
    workers: Executor,
) -> Callable[[], WindowSpectra]:
    count = len(bounds)
    kept = np.empty((count, economy.kept), dtype=np.complex64)
    largest, energies = np.empty((count, economy.segments), dtype=np.float32), np.empty((count, 3))
    transform = WindowTransform(runs, fft_samples, economy.low, economy.high, economy.starts, band)
    under_way = [
        workers.submit(loops.windows, transform, bounds[some], kept[some], largest[some], energies[some])
        for some in shares(count)
    ]

    def end() -> WindowSpectra:
        for future in under_way:
            future.result()
        norms = np.sqrt(energies[:, 0]) * SQUARES_SLACK + SQUARES_LOST * np.sqrt(fft_samples)
        blurs = _rounding_of_transforms(norms, fft_samples)
        _, band_energy, energy = energies.sum(axis=0).tolist()
        return WindowSpectra(kept, economy.largest_of(largest), blurs, blurs, band_energy, energy)

    return end


def _joined(
    windows: Windows,
    first: int,
    start: Int64Array,
    lengths: Int64Array,
    frame: int,
    fft_samples: int,
    economy: Economy,
    band: slice,
    workers: Executor,
) -> Callable[[], WindowSpectra]:
    """Short windows, and the few long ones among them."""
    short = lengths <= frame
    number = np.arange(first, first + len(start))
    longest = int(lengths[short].max())
    of_short = workers.submit(
        _short, windows, number[short], start[short] // frame, longest, frame, fft_samples, economy, band
    )
    if short.all():
        return of_short.result
    of_long = _long(windows, number[~short], fft_samples, economy, band, workers)
    return lambda: _merged(economy, short, of_short.result(), of_long())


def _merged(economy: Economy, short: NDArray[np.bool_], found: WindowSpectra, rest: WindowSpectra) -> WindowSpectra:
    """Short windows and others, as they were."""
    kept = np.empty((len(short), economy.kept), dtype=np.complex64)
    largest = np.empty((len(short), economy.segments + 1))
    errors, blurs = np.empty(len(short)), np.empty(len(short))
    for where, part in ((short, found), (~short, rest)):
        kept[where], largest[where], errors[where], blurs[where] = part.kept, part.largest, part.errors, part.blurs
    energy = found.energy + rest.energy
    return WindowSpectra(kept, largest, errors, blurs, found.band_energy + rest.band_energy, energy)


@np.errstate(over="ignore", under="ignore", invalid="ignore")
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
    errors, blurs = _rounding_of_sums(longest, np.abs(values).sum(axis=1, dtype=np.float64), fft_samples)
    energy = fft_samples / 2 * float(np.einsum("wt,wt->w", values, values).sum(dtype=np.float64))
    in_band = economy.squared(np.ascontiguousarray(kept[:, max(band.start - low, 0) : max(band.stop - low, 0)]))
    largest = magnitude * SQUARES_SLACK + SQUARES_LOST + errors[:, None]
    return WindowSpectra(kept, largest, errors, blurs, float(in_band.sum(axis=1).sum(dtype=np.float64)), energy)


def _rounding_of_sums(longest: int, sums: Float64Array, fft_samples: int) -> tuple[Float64Array, Float64Array]:
    """Bounds on the error of any bin, and of all, of windows of so many samples summed as they are."""
    errors = (longest + 5) * 2.0**-24 * sums
    return errors, errors * np.sqrt(fft_samples / 2.0 + 1.0)


def _rounding_of_transforms(norms: Float64Array, fft_samples: int) -> Float64Array:
    """Bounds on the norm of the error of windows that are rounded and transformed; so large may that of one bin be."""
    blurs: Float64Array = (TRANSFORM * np.log2(fft_samples) + 1.0) * 2.0**-24 * np.sqrt(fft_samples / 2.0) * norms
    return blurs


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
