"""Rows of a bank convolved with drives, block by block: a matrix product per frequency bin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.drive_cut import CutDrive
from rendering.drive.omission import TRANSFORM, Economy
from rendering.drive.row_transforms import GROUP_BYTES, RowTransforms, transform_rows
from rendering.drive.upsampling import FRAME, Upsampling, block_energies, row_energies
from rendering.field.product_bounds import SpectrumSizes, drive_units, joint_squares, product_errors
from rendering.greens.source import RowReader
from rendering.inner_loops import InnerLoops, RowTransform, inner_loops, transformable
from rendering.shared_work import share_out
from rendering.threads import WORKERS

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

SPECTRA_BYTES = 128 * 2**20
"""The blocks' spectra are kept up to this size, else made anew for every part of the field."""
BLOCKS_AT_ONCE = 64
LARGEST_NORM = 2.0**8
"""Drives of at most such a norm are of size about 1."""
LANES = 4
"""Transforms in single precision that are made at once."""


@dataclass(frozen=True, slots=True)
class _Spectra:
    """Spectra of some blocks.

    Parameters
    ----------
    pairs : array, shape (bins, 2 actuators, 2 blocks)
        Kept bins as real matrices [[Re, Im], [-Im, Re]]: what a product of complex matrices is, in real parts beside
        imaginary ones, and a third faster than one.
    sizes : SpectrumSizes
        Over all actuators; zeros where no error is bounded.
    """

    pairs: NDArray[Any]
    sizes: SpectrumSizes

    def blocks(self, first: int, last: int) -> _Spectra:
        """Some of the blocks."""
        return _Spectra(self.pairs[:, :, 2 * first : 2 * last], self.sizes.some(slice(first, last)))


class DriveBlocks:
    """Drives, to be convolved with rows; several threads may convolve.

    Parameters
    ----------
    drive : CutDrive
        The drives.
    taps : int
        Length of a Green's function.
    fft_samples : int
        Transform length.
    hop : int
        Samples from one block to the next.
    economy : Economy
        Precision, and which bins to compute.
    fade : int
        Samples over which one block fades into the next, at most fft_samples - hop - taps + 1.
    factor : int
        By how much the rate of blocks is below that of the drives.
    bounded : bool
        Whether to bound errors.
    double : bool
        Whether to transform the drives in double precision, whatever the products are made in.
    """

    def __init__(
        self,
        drive: CutDrive,
        taps: int,
        fft_samples: int,
        hop: int,
        economy: Economy,
        fade: int = 0,
        factor: int = 1,
        *,
        bounded: bool = False,
        double: bool = True,
    ) -> None:
        self.economy = economy
        self._drive = drive
        self._bounded = bounded
        self._cut_type = np.dtype(np.float64 if double else economy.real)
        self._units = drive_units(fft_samples, economy) if self._cut_type == np.float32 else 0.0
        self._taps = taps
        self._fft_samples = fft_samples
        self._hop = hop
        self._fade = fade
        self._upsampling = _upsampling(fft_samples, economy.high, hop, factor) if factor > 1 else None
        self._factor = factor
        self._overlap = self._upsampling.overlap if self._upsampling else -(-fft_samples // hop)
        self._blocks = -(-drive.samples // hop)
        item = np.dtype(economy.complex).itemsize
        kept_bytes = 2 * economy.kept * drive.actuators * self._blocks * item
        self._known: _Spectra | None = None
        if kept_bytes <= SPECTRA_BYTES:
            self._known = self._block_spectra(0, self._blocks)

    @property
    def plain(self) -> bool:
        """Whether the drives are known to be finite and not much larger than 1, by their blocks' spectra."""
        if self._known is None or not self._bounded:
            return False
        return bool(self._known.sizes.norms.max() < LARGEST_NORM * np.sqrt(self._fft_samples))

    @property
    def samples(self) -> int:
        """Samples of a response."""
        return self._drive.samples + self._taps - 1

    @property
    def padded_samples(self) -> int:
        """Samples of a response and some more, as `convolve` makes them."""
        if not self._upsampling:
            return self.samples
        return FRAME * self._factor * -(-self.samples // (FRAME * self._factor))

    def part_bytes(self) -> int:
        """Bytes that convolving takes for each row."""
        spectra = self.economy.kept * (self._drive.actuators + min(self._blocks, BLOCKS_AT_ONCE))
        return int(spectra * np.dtype(self.economy.complex).itemsize + self.samples * 4)

    def transform(self, reader: RowReader, positions: Sequence[int], actuators: Int64Array) -> RowTransforms:
        """Read and transform rows, of the actuators of the drives, for `convolve`."""
        length, economy = self._fft_samples, self.economy
        return transform_rows(reader, positions, length, economy, bounded=self._bounded, actuators=actuators)

    def convolve(
        self, rows: RowTransforms, scale: Float64Array, out: RealArray | None = None
    ) -> tuple[RealArray, Float64Array, Float64Array]:
        """Convolve rows with the drives and add up over the actuators.

        Parameters
        ----------
        rows : RowTransforms
            Rows of size about 1, of the actuators of the drives; their own exponents are left to `scale`.
        scale : float64 array, shape (rows,)
            Responses are multiplied with this.
        out : array, shape (rows, `padded_samples`), optional
            Gets the responses.

        Returns
        -------
        responses : array, shape (rows, samples)
        errors : float64 array, shape (rows,)
            Bounds on the norms of their errors; 0 where not asked for.
        energies : float64 array, shape (rows,)
            Their energies; 0 where no bounds are asked for.
        """
        economy, lower = self.economy, self._fft_samples // self._factor
        count = len(rows.kept)
        half = self._upsampling.half if self._upsampling else 0
        found: NDArray[Any] = np.empty((count, self.padded_samples), dtype=economy.real) if out is None else out
        total = found
        if self._upsampling:
            total = np.empty((count, self.padded_samples // self._factor + 2 * half), dtype=economy.real)
        squares = np.zeros(count)
        total[:, :half] = 0
        reached = half
        for first in range(0, self._blocks, BLOCKS_AT_ONCE):
            last = min(first + BLOCKS_AT_ONCE, self._blocks)
            spectra = self._block_spectra(first, last)
            errors = np.zeros((count, last - first))
            if self._bounded:
                actuators = self._drive.actuators
                errors = product_errors(economy, self._fft_samples, actuators, rows.sizes, spectra.sizes, self._units)
            group = max(1, GROUP_BYTES // ((last - first) * lower * np.dtype(economy.real).itemsize))
            padded = np.empty((lower // 2 + 1, min(group, count), last - first), dtype=economy.complex)
            padded[: economy.low] = 0
            padded[economy.high :] = 0
            for begin in range(0, count, group):
                some = slice(begin, min(begin + group, count))
                spaced = padded[:, : some.stop - begin]
                kept = rows.kept[some].view(economy.real).transpose(1, 0, 2)
                np.matmul(kept, spectra.pairs, out=spaced[economy.low : economy.high].view(economy.real))
                parts: NDArray[Any] = scipy_fft.irfft(spaced.transpose(1, 2, 0), lower, axis=2)
                self._add(parts, total[some], first, reached)
                if self._bounded:
                    errors[some] += self._rounding(parts)
            squares += np.square(errors).sum(axis=1)
            reached = half + (last - 1) * self._hop // self._factor + lower
        total[:, reached:] = 0
        total *= scale.astype(economy.real)[:, None]
        return found[:, : self.samples], np.sqrt(self._overlap * squares) * scale, self._finish(total, found)

    def _finish(self, total: NDArray[Any], found: NDArray[Any]) -> Float64Array:
        """Interpolate sums of blocks where need be; the responses' energies where bounds are asked for, (rows,)."""
        energy = np.zeros(len(total))
        if not (self._upsampling or self._bounded):
            return energy
        # A few rows at a time: they are still in cache when their energy is taken.
        group = max(1, GROUP_BYTES // (self.padded_samples * np.dtype(self.economy.real).itemsize))
        for begin in range(0, len(total), group):
            some = slice(begin, begin + group)
            if self._upsampling:
                self._upsampling.interpolate(total[some], found[some])
            if self._bounded:
                energy[some] = row_energies(found[some, : self.samples])
        return energy

    def _add(self, parts: NDArray[Any], total: NDArray[Any], first: int, reached: int) -> None:
        """Add blocks (rows, blocks, samples) up; what lies beyond `reached` is still to be written at all."""
        hop, lower = self._hop // self._factor, parts.shape[2]
        half = self._upsampling.half if self._upsampling else 0
        for place in range(parts.shape[1]):
            start = half + (first + place) * hop
            end = min(start + lower, total.shape[1])
            shared = min(max(reached - start, 0), end - start)
            total[:, start : start + shared] += parts[:, place, :shared]
            total[:, start + shared : end] = parts[:, place, shared : end - start]
            reached = max(reached, end)

    def _rounding(self, parts: NDArray[Any]) -> Float64Array:
        """Bounds on the errors of transforming back and interpolating, (rows, blocks)."""
        rows, blocks, lower = parts.shape
        flat = parts.reshape(rows * blocks, 1, lower)
        norms = np.sqrt(block_energies(flat) / self._factor)
        errors = TRANSFORM * np.log2(self._fft_samples) * self.economy.roundoff * norms
        if self._upsampling:
            errors += self._upsampling.errors(flat, norms)
        bounds: Float64Array = errors.reshape(rows, blocks)
        return bounds

    def _block_spectra(self, first: int, last: int) -> _Spectra:
        if self._known is not None:
            return self._known.blocks(first, last)
        economy, actuators, blocks = self.economy, self._drive.actuators, last - first
        kept = np.empty((blocks, economy.kept, actuators), dtype=economy.complex)
        squared = np.zeros((blocks, 2, economy.bins if self._bounded else 0), dtype=economy.real)
        loops = inner_loops() if self._cut_type == np.float32 and transformable(self._fft_samples) else None

        def transform(item: tuple[int, slice]) -> None:
            block, some = item
            # What is too large shows in the sizes.
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                found, squares = self._transformed(block, some, loops)
                kept[block - first, :, some] = found
                if self._bounded:
                    squared[block - first, min(some.start, 1)] = squares

        share_out(self._work(first, last), transform)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            # Together: written block by block, every cache line would be fetched as often.
            pairs = np.empty((economy.kept, actuators, 2, blocks), dtype=economy.complex)
            pairs[:, :, 0] = kept.transpose(1, 2, 0)
            np.multiply(pairs[:, :, 0], 1j, out=pairs[:, :, 1])
            sizes = SpectrumSizes.zeros(blocks, economy)
            if self._bounded:
                sizes = SpectrumSizes.of(squared.sum(axis=1), economy, actuators)
        return _Spectra(pairs.view(economy.real).reshape(economy.kept, 2 * actuators, 2 * blocks), sizes)

    def _transformed(self, block: int, some: slice, loops: InnerLoops | None) -> tuple[NDArray[Any], NDArray[Any]]:
        """Spectra of a block of some actuators, (kept bins, actuators), and their joint squares, (bins,)."""
        economy, count = self.economy, some.stop - some.start
        if loops is None:
            samples = np.empty((count, self._fft_samples), dtype=self._cut_type)
            self._drive.cut(block, self._hop, self._fade, samples, some)
            whole = scipy_fft.rfft(samples, axis=1).astype(economy.complex, copy=False)
            return whole[:, economy.low : economy.high].T, joint_squares(whole)
        samples = np.empty((count, self._hop + self._fade), dtype=np.float32)
        self._drive.cut(block, self._hop, self._fade, samples, some)
        taps, found = samples.shape[1], np.empty((economy.kept, count), dtype=np.complex64)
        low, high = economy.low, economy.high
        transform = RowTransform(taps, taps, np.arange(count), self._fft_samples, low, high, conjugate=False)
        where = np.array([found.ctypes.data], dtype=np.uintp)
        return found, loops.transform(transform, [samples], np.ones(1, dtype=np.float32), where)[0]

    def _work(self, first: int, last: int) -> list[tuple[int, slice]]:
        """Blocks and actuators that are transformed together: all of them, but where that leaves a worker idle."""
        actuators = self._drive.actuators
        half = min(-(-actuators // (2 * LANES)) * LANES, actuators)
        whole = last - (last - first) % WORKERS
        work = [(block, slice(0, actuators)) for block in range(first, whole)]
        for block in range(whole, last):
            work += [(block, slice(0, half)), (block, slice(half, actuators))]
        return [(block, some) for block, some in work if some.start < some.stop]


@lru_cache(maxsize=8)
def _upsampling(fft_samples: int, high: int, hop: int, factor: int) -> Upsampling:
    """Matrices that depend on the blocks' shape alone."""
    return Upsampling(fft_samples, high, hop, factor)
