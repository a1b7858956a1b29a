"""Windows of some blocks times rows of the bank, and back to time: what one thread does at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.omission import TRANSFORM, Economy
from rendering.overlap_add import FullRate, LowRate, OverlapAdd
from rendering.row_pages import RowsView
from rendering.upsampling import Upsampling, energies
from rendering.window_spectra import WindowSpectra, window_spectra
from rendering.windows import Windows

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Part:
    """Drives of some consecutive blocks, or of some windows of one block.

    Parameters
    ----------
    first : int
        First block.
    done : int
        So many blocks are now complete: nothing more comes for them.
    samples : float array, shape (blocks, actuators, samples)
        Over 2**exponent of the blocks; none where nothing is emitted.
    errors : float64 array, shape (blocks,)
        Bounds on the norms of their errors, over sqrt(2 / fft_samples).
    pairs : int
        Windows that were multiplied with rows.
    quiet : int
        Windows that were left out because they hardly emit anything.
    band_energy, energy : float
        Energy of the windows within the band asked about, and in all.
    """

    first: int
    done: int
    samples: NDArray[Any]
    errors: Float64Array
    pairs: int
    quiet: int
    band_energy: float
    energy: float


@dataclass(frozen=True, slots=True)
class BlockShape:
    """What all blocks of one emission have in common.

    Parameters
    ----------
    fft_samples, hop : int
        Transform length, and samples from one block to the next.
    actuators : int64 array, shape (kept,)
        Actuators that are computed.
    economy : Economy
        Precision, and bins to compute.
    band : slice
        Bins whose energy is counted.
    peak_ratio : float
        By how much the spectrum of a window may rise between the bins.
    upsampling : Upsampling, optional
        Interpolates, where blocks are made at a fraction of the rate.
    bounded : bool
        Whether errors are bounded.
    sigma : callable
        Saturation factors (kept,) of a row.
    """

    fft_samples: int
    hop: int
    actuators: Int64Array
    economy: Economy
    band: slice
    peak_ratio: float
    upsampling: Upsampling | None
    bounded: bool
    sigma: Callable[[int], Float64Array]

    @property
    def samples(self) -> int:
        """Samples of a block at the rate at which blocks are made."""
        return self.fft_samples // (self.upsampling.factor if self.upsampling else 1)

    @property
    def overlap(self) -> int:
        """Most blocks that one sample of the drives lies in."""
        return self.upsampling.overlap if self.upsampling else -(-self.fft_samples // self.hop)

    def overlap_add(self) -> OverlapAdd:
        """What adds up the parts' samples."""
        if self.upsampling:
            return LowRate(len(self.actuators), self.fft_samples, self.hop, self.upsampling)
        return FullRate(len(self.actuators), self.fft_samples, self.hop)

    def in_time(self, spectra: NDArray[Any]) -> tuple[NDArray[Any], Float64Array]:
        """Transform blocks back, (blocks, actuators, samples), and bound what comes of that."""
        samples: NDArray[Any] = scipy_fft.irfft(spectra, self.samples, axis=2, overwrite_x=True)
        if not self.bounded:
            return samples, np.zeros(len(samples))
        norms = np.sqrt(energies(samples) * self.samples / self.fft_samples)
        errors = TRANSFORM * np.log2(self.fft_samples) * self.economy.roundoff * norms
        if self.upsampling:
            errors += self.upsampling.errors(samples, norms)
        return samples, errors / np.sqrt(2.0 / self.fft_samples)


@dataclass(frozen=True, slots=True)
class BlockTask:
    """Some windows of some planned blocks, on their way to become a part."""

    shape: BlockShape
    windows: Windows
    begin: int
    end: int
    part: range
    planned_from: int
    done: int
    rows: RowsView

    def evaluate(self) -> Part:
        """Make the drives of the part."""
        shape, economy, first = self.shape, self.shape.economy, self.planned_from + self.part.start
        actuators = len(shape.actuators)
        bounds = np.searchsorted(
            self.windows.block[self.begin : self.end], np.arange(self.part.start, self.part.stop + 1)
        )
        errors = self.windows.quiet_errors[self.part.start : self.part.stop].copy()
        quiet = int(self.windows.quiet[self.part.start : self.part.stop].sum())
        if self.begin > 0 and self.windows.block[self.begin - 1] == self.part.start:
            # Another part of this block has told of that.
            errors[0] = 0.0
            quiet -= int(self.windows.quiet[self.part.start])
        if self.end == self.begin:
            nothing = np.empty((0, actuators, 0))
            return Part(first, self.done, nothing, errors, 0, quiet, 0.0, 0.0)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            found = window_spectra(self.windows, self.begin, self.end, shape.fft_samples, economy, shape.band)
            spectra = np.zeros((len(self.part), actuators, shape.samples // 2 + 1), dtype=economy.complex)
            self._add_up(found.kept, bounds, spectra[:, :, economy.low : economy.high])
            if shape.bounded:
                errors += self._errors(found, bounds)
            samples, further = shape.in_time(spectra)
            errors += further
        return Part(first, self.done, samples, errors, self.end - self.begin, quiet, found.band_energy, found.energy)

    def _add_up(self, windows: NDArray[Any], bounds: Int64Array, spectra: NDArray[Any]) -> None:
        """Add windows times their rows to each block's spectra, (blocks, actuators, kept bins)."""
        by = self.windows.regularised_by[self.begin : self.end] + 1
        span = int(by.max()) + 1
        block = np.repeat(np.arange(len(self.part)), np.diff(bounds))
        for group, product in self.rows.sums(windows, block * span + by):
            place, one = divmod(group, span)
            if span == 1:
                spectra[place] = product.T
            else:
                spectra[place] += (product * self._sigma_of(one - 1).astype(windows.real.dtype)).T

    def _sigma_of(self, one: int) -> Float64Array:
        return np.ones(len(self.shape.actuators)) if one < 0 else self.shape.sigma(one)

    def _errors(self, found: WindowSpectra, bounds: Int64Array) -> Float64Array:
        shape, norms = self.shape, self.rows.norms()
        by = self.windows.regularised_by[self.begin : self.end]
        for one in np.unique(by[by >= 0]).tolist():
            some = np.flatnonzero(by == one)
            norms[some] = self.rows.weighted_norms(some, shape.sigma(one))
        used = np.flatnonzero(np.diff(bounds))
        # What is cut off a row may meet the largest value of a window anywhere; saturation only lessens it.
        cut_off = self.rows.cut_off() * found.largest[:, -1] * shape.peak_ratio * np.sqrt(shape.fft_samples / 2.0)
        further = np.add.reduceat(norms[:, -1] * found.errors + cut_off, bounds[used])
        coherent = np.add.reduceat(norms * found.largest, bounds[used], axis=0)
        errors = np.zeros(len(self.part))
        errors[used] = shape.economy.block_errors(coherent, shape.fft_samples, np.diff(bounds)[used]) + further
        return errors
