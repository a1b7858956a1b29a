"""Drives cut into blocks, and rows of a bank convolved with them: a matrix product per frequency bin.

Where bins are left out, one block fades into the next: cut off sharply, each would have frequencies that the
drive has not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.green_source import RowReader
from rendering.omission import TRANSFORM, Economy
from rendering.row_transforms import GROUP_BYTES, RowTransforms, transform_rows
from rendering.threads import WORKERS
from rendering.upsampling import FRAME, Upsampling, energies, row_energies

Float64Array = NDArray[np.float64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

SPECTRA_BYTES = 128 * 2**20
"""The blocks' spectra are kept up to this size, else made anew for every part of the field."""
BLOCKS_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class _Spectra:
    """Spectra of some blocks.

    Parameters
    ----------
    pairs : array, shape (bins, 2 actuators, 2 blocks)
        Kept bins as real matrices [[Re, Im], [-Im, Re]]: what a product of complex matrices is, in real parts beside
        imaginary ones, and a third faster than one.
    largest : float64 array, shape (segments + 1, actuators, blocks)
        Largest magnitudes.
    """

    pairs: NDArray[Any]
    largest: Float64Array


class DriveBlocks:
    """Drives, to be convolved with rows; several threads may convolve.

    Parameters
    ----------
    drive : float64 array, shape (actuators, samples)
        Drives of size about 1.
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
    """

    def __init__(
        self,
        drive: Float64Array,
        taps: int,
        fft_samples: int,
        hop: int,
        economy: Economy,
        fade: int = 0,
        factor: int = 1,
        *,
        bounded: bool = False,
    ) -> None:
        self.economy = economy
        self._drive = drive
        self._bounded = bounded
        self._taps = taps
        self._fft_samples = fft_samples
        self._hop = hop
        self._fade = fade
        self._upsampling = Upsampling(fft_samples, economy.high, hop, factor) if factor > 1 else None
        self._factor = factor
        self._overlap = self._upsampling.overlap if self._upsampling else -(-fft_samples // hop)
        self._blocks = -(-drive.shape[1] // hop)
        item = np.dtype(economy.complex).itemsize
        kept_bytes = 2 * economy.kept * len(drive) * self._blocks * item
        self._known: _Spectra | None = None
        if kept_bytes <= SPECTRA_BYTES:
            self._known = self._block_spectra(0, self._blocks, bounded=bounded)

    @property
    def samples(self) -> int:
        """Samples of a response."""
        return int(self._drive.shape[1]) + self._taps - 1

    @property
    def padded_samples(self) -> int:
        """Samples of a response and some more, as `convolve` makes them."""
        if not self._upsampling:
            return self.samples
        return FRAME * self._factor * -(-self.samples // (FRAME * self._factor))

    def part_bytes(self) -> int:
        """Bytes that convolving takes for each row."""
        spectra = self.economy.kept * (len(self._drive) + min(self._blocks, BLOCKS_AT_ONCE))
        return int(spectra * np.dtype(self.economy.complex).itemsize + self.samples * 4)

    def transform(self, reader: RowReader, positions: Sequence[int]) -> RowTransforms:
        """Read and transform rows, for `convolve`."""
        return transform_rows(reader, positions, self._fft_samples, self.economy, bounded=self._bounded)

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
        count = rows.kept.shape[1]
        half = self._upsampling.half if self._upsampling else 0
        found: NDArray[Any] = np.empty((count, self.padded_samples), dtype=economy.real) if out is None else out
        total = found
        if self._upsampling:
            total = np.empty((count, self.padded_samples // self._factor + 2 * half), dtype=economy.real)
        factors = scale.astype(economy.real)[:, None, None]
        squares = np.zeros(count)
        total[:, :half] = 0
        reached = half
        for first in range(0, self._blocks, BLOCKS_AT_ONCE):
            last = min(first + BLOCKS_AT_ONCE, self._blocks)
            spectra = self._block_spectra(first, last, bounded=self._bounded)
            product = np.matmul(rows.kept.view(economy.real), spectra.pairs).view(economy.complex)
            errors = np.zeros((count, last - first))
            if self._bounded:
                errors = self._left_out(rows.norms, spectra.largest) * scale[:, None]
            group = max(1, GROUP_BYTES // ((last - first) * lower * np.dtype(economy.real).itemsize))
            padded = np.zeros((min(group, count), last - first, lower // 2 + 1), dtype=economy.complex)
            for begin in range(0, count, group):
                some = slice(begin, min(begin + group, count))
                spaced = padded[: some.stop - begin]
                kept = spaced[:, :, economy.low : economy.high]
                np.multiply(product[:, some].transpose(1, 2, 0), factors[some], out=kept)
                parts: NDArray[Any] = scipy_fft.irfft(spaced, lower, axis=2)
                self._add(parts, total[some], first, reached)
                if self._bounded:
                    errors[some] += self._rounding(parts)
            squares += np.square(errors).sum(axis=1)
            reached = half + (last - 1) * self._hop // self._factor + lower
        total[:, reached:] = 0
        return found[:, : self.samples], np.sqrt(self._overlap * squares), self._finish(total, found)

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

    def _left_out(self, norms: Float64Array, largest: Float64Array) -> Float64Array:
        """Bounds on what is left out and on its rounding, (rows, blocks)."""
        coherent = np.matmul(norms, largest).transpose(1, 2, 0)
        flat = np.ascontiguousarray(coherent.reshape(-1, self.economy.segments + 1))
        heard = np.full(len(flat), float(len(self._drive)))
        errors = self.economy.block_errors(flat, self._fft_samples, heard) * np.sqrt(2.0 / self._fft_samples)
        bounds: Float64Array = errors.reshape(coherent.shape[:2])
        return bounds

    def _rounding(self, parts: NDArray[Any]) -> Float64Array:
        """Bounds on the errors of transforming back and interpolating, (rows, blocks)."""
        rows, blocks, lower = parts.shape
        flat = parts.reshape(rows * blocks, 1, lower)
        norms = np.sqrt(energies(flat) / self._factor)
        errors = TRANSFORM * np.log2(self._fft_samples) * self.economy.roundoff * norms
        if self._upsampling:
            errors += self._upsampling.errors(flat, norms)
        bounds: Float64Array = errors.reshape(rows, blocks)
        return bounds

    def _block_spectra(self, first: int, last: int, *, bounded: bool) -> _Spectra:
        if self._known is not None:
            return _Spectra(self._known.pairs[:, :, 2 * first : 2 * last], self._known.largest[:, :, first:last])
        economy, heard = self.economy, len(self._drive)
        pairs = np.empty((economy.kept, heard, 2, last - first, 2), dtype=economy.real)
        largest = np.zeros((economy.segments + 1, heard, last - first))

        def transform(block: int) -> None:
            samples = cut_block(self._drive, block, self._hop, self._fade)
            # In double precision: what a block's spectrum errs by would meet the largest of a row's values.
            whole = scipy_fft.rfft(samples, self._fft_samples, axis=1).astype(economy.complex, copy=False)
            kept, place = whole[:, economy.low : economy.high].T, block - first
            pairs[:, :, 0, place, 0] = pairs[:, :, 1, place, 1] = kept.real
            pairs[:, :, 0, place, 1] = kept.imag
            pairs[:, :, 1, place, 0] = -kept.imag
            if bounded:
                largest[:, :, place] = economy.largest(economy.squared(whole)).T

        with ThreadPoolExecutor(WORKERS) as pool:
            deque(pool.map(transform, range(first, last)), maxlen=0)
        return _Spectra(pairs.reshape(economy.kept, 2 * heard, 2 * (last - first)), largest)


def cut_block(drive: Float64Array, block: int, hop: int, fade: int) -> Float64Array:
    """Samples of one block: it begins at block * hop, and fades out as the next one fades in."""
    samples = drive[:, block * hop : (block + 1) * hop + fade].copy()
    if fade:
        ramp = _ramp(fade)
        if block:
            samples[:, :fade] *= ramp[: samples.shape[1]]
        over = samples[:, hop:]
        over *= 1.0 - ramp[: over.shape[1]]
    return samples


@lru_cache(maxsize=4)
def _ramp(fade: int) -> Float64Array:
    """From 0 to 1, with next to no frequencies above ten times its inverse length."""
    steps: Float64Array = np.cumsum(np.kaiser(fade, 12.0))
    return np.asarray(steps / steps[-1], dtype=np.float64)
