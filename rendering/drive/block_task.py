"""Windows of some blocks times rows of the bank, and back to time, step by step."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.omission import TRANSFORM, Economy
from rendering.drive.overlap_add import FullRate, LowRate, OverlapAdd
from rendering.drive.row_pages import RowsView
from rendering.drive.upsampling import Upsampling, block_energies
from rendering.drive.window_spectra import WindowSpectra, window_spectra
from rendering.drive.windows import Windows
from rendering.inner_loops import TransformBack, inner_loops, transformable
from rendering.reused_memory import reused
from rendering.shared_work import shares
from rendering.threads import AtOnce

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
    turn : complex array, shape (kept bins,)
        Spectrum of a delay by one sample less than there are taps, so that time-reversed rows begin at 0.
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
    turn: NDArray[Any]

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

    def errors_in_time(self, samples: NDArray[Any], energies: Float64Array) -> Float64Array:
        """Bounds on what transforming back makes of blocks (blocks, actuators, samples), over sqrt(2 / fft_samples).

        Energies are those of the blocks, no smaller than rounding.
        """
        if not self.bounded:
            return np.zeros(len(samples))
        norms = np.sqrt(energies * self.samples / self.fft_samples)
        errors: Float64Array = TRANSFORM * np.log2(self.fft_samples) * self.economy.roundoff * norms
        if self.upsampling:
            errors += self.upsampling.errors(samples, norms)
        errors /= np.sqrt(2.0 / self.fft_samples)
        return errors


class BlockTask:
    """Some windows of some planned blocks, on their way to become a part.

    Its steps are taken one after the other by one thread, while workers transform what other tasks have begun.

    Parameters
    ----------
    shape : BlockShape
        What all blocks have in common.
    windows : Windows
        Windows of the planned blocks.
    chosen : range
        Which of them.
    part : range
        The blocks that they are of, counted from `planned_from`.
    planned_from : int
        First of the planned blocks.
    done : int
        So many blocks will be complete.
    rows : RowsView
        A row for each window chosen.
    workers : Executor
        Transforms.
    """

    def __init__(
        self,
        shape: BlockShape,
        windows: Windows,
        chosen: range,
        part: range,
        planned_from: int,
        done: int,
        rows: RowsView,
        workers: Executor,
    ) -> None:
        self._shape = shape
        self._windows = windows
        self._chosen = chosen
        self._part = part
        self._first = planned_from + part.start
        self._done = done
        self._rows = rows
        self._workers = workers
        self._errors = windows.quiet_errors[part.start : part.stop].copy()
        self._quiet = int(windows.quiet[part.start : part.stop].sum())
        if chosen.start > 0 and windows.block[chosen.start - 1] == part.start:
            # Another part of this block has told of that.
            self._errors[0] = 0.0
            self._quiet -= int(windows.quiet[part.start])
        self._energies = (0.0, 0.0)
        self._spectra: Callable[[], WindowSpectra] | None = None
        self._samples: Callable[[], tuple[NDArray[Any], Float64Array]] | None = None
        if len(chosen) and shape.economy.single:
            self._spectra = self._begin(workers)

    def multiply(self) -> None:
        """Multiply windows with rows, and begin to transform the blocks back."""
        if not len(self._chosen):
            return
        if self._spectra is None:
            # In double precision all steps are long, so that threads do not wait for each other.
            self._samples = self._workers.submit(self._make).result
            return
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            found, bounds = self._spectra(), self._bounds()
            self._samples = self._begin_back(found.kept, bounds)
            self._judge(found, bounds)

    def finish(self) -> Part:
        """The drives of the part."""
        if self._samples is None:
            nothing = np.empty((0, len(self._shape.actuators), 0))
            return Part(self._first, self._done, nothing, self._errors, 0, self._quiet, 0.0, 0.0)
        samples, energies = self._samples()
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            self._errors += self._shape.errors_in_time(samples, energies)
        return Part(self._first, self._done, samples, self._errors, len(self._chosen), self._quiet, *self._energies)

    def _begin(self, workers: Executor) -> Callable[[], WindowSpectra]:
        shape, chosen = self._shape, self._chosen
        return window_spectra(
            self._windows, chosen.start, chosen.stop, shape.fft_samples, shape.economy, shape.band, workers
        )

    def _bounds(self) -> Int64Array:
        """Where each block's windows begin among those chosen, and the end."""
        block = self._windows.block[self._chosen.start : self._chosen.stop]
        return np.searchsorted(block, np.arange(self._part.start, self._part.stop + 1))

    def _make(self) -> tuple[NDArray[Any], Float64Array]:
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            found, bounds = self._begin(AtOnce())(), self._bounds()
            samples: NDArray[Any] = scipy_fft.irfft(self._sums(found.kept, bounds), self._shape.samples, axis=2)
            self._judge(found, bounds)
            return samples, block_energies(samples) if self._shape.bounded else np.zeros(len(samples))

    def _begin_back(self, windows: NDArray[Any], bounds: Int64Array) -> Callable[[], tuple[NDArray[Any], Float64Array]]:
        """Begin to make blocks of windows and to transform them back; what is returned waits for them and energies."""
        shape, economy, blocks = self._shape, self._shape.economy, len(self._part)
        loops = inner_loops() if self._plain and transformable(shape.samples) else None
        samples = reused((blocks, len(shape.actuators), shape.samples), economy.real)
        if loops is not None:
            back = TransformBack(len(shape.actuators), shape.samples, economy.low, economy.high, shape.turn)
            make = self._rows.begin_blocks(loops, back, windows, self._blocks(bounds))
        else:
            spectra = self._sums(windows, bounds)

            @np.errstate(over="ignore", under="ignore", invalid="ignore")
            def make(some: slice, out: NDArray[Any]) -> Float64Array:
                out[some] = scipy_fft.irfft(spectra[some], shape.samples, axis=2)
                return block_energies(out[some])

        under_way = [self._workers.submit(make, some, samples) for some in shares(blocks)]

        def end() -> tuple[NDArray[Any], Float64Array]:
            return samples, np.concatenate([future.result() for future in under_way])

        return end

    def _judge(self, found: WindowSpectra, bounds: Int64Array) -> None:
        self._energies = found.band_energy, found.energy
        if self._shape.bounded:
            self._errors += self._left_out(found, bounds)

    def _blocks(self, bounds: Int64Array) -> Int64Array:
        """Block of each window."""
        return np.repeat(np.arange(len(self._part)), np.diff(bounds))

    @property
    def _plain(self) -> bool:
        """Whether no window's actuators are saturated."""
        return bool((self._windows.regularised_by[self._chosen.start : self._chosen.stop] < 0).all())

    def _sums(self, windows: NDArray[Any], bounds: Int64Array) -> NDArray[Any]:
        """Windows times their time-reversed rows added up to each block's spectra, (blocks, actuators, bins)."""
        shape, economy = self._shape, self._shape.economy
        blocks = len(self._part)
        whole = np.empty((blocks, shape.samples // 2 + 1, len(shape.actuators)), dtype=economy.complex)
        whole[:, : economy.low] = 0
        whole[:, economy.high :] = 0
        spectra = whole[:, economy.low : economy.high]
        count = np.diff(bounds)
        block = self._blocks(bounds)
        if self._plain:
            spectra[count == 0] = 0
            self._rows.sums(windows, shape.turn, block, spectra)
        else:
            spectra[...] = 0
            by = self._windows.regularised_by[self._chosen.start : self._chosen.stop]
            span = int(by.max()) + 2
            pairs, group = np.unique(block * span + by + 1, return_inverse=True)
            found = np.empty((len(pairs), *spectra.shape[1:]), dtype=economy.complex)
            self._rows.sums(windows, shape.turn, group, found)
            for pair, product in zip(pairs.tolist(), found, strict=True):
                place, one = divmod(pair, span)
                spectra[place] += product * self._sigma_of(one - 1).astype(windows.real.dtype)
        # Bin by bin, as rows are: the transform gathers at no cost.
        return whole.transpose(0, 2, 1)

    def _sigma_of(self, one: int) -> Float64Array:
        return np.ones(len(self._shape.actuators)) if one < 0 else self._shape.sigma(one)

    def _left_out(self, found: WindowSpectra, bounds: Int64Array) -> Float64Array:
        """Bounds on the errors of the part's blocks before they are transformed back."""
        # Of rows as they are: saturation only lessens them.
        shape, sizes = self._shape, self._rows.sizes()
        used = np.flatnonzero(np.diff(bounds))
        # What is cut off a row may meet the largest value of a window anywhere.
        cut_off = sizes.cut_off * found.largest[:, -1] * shape.peak_ratio * np.sqrt(shape.fft_samples / 2.0)
        blurred = np.minimum(sizes.norms[:, -1] * found.errors, sizes.peaks * found.blurs)
        further = np.add.reduceat(blurred + cut_off, bounds[used])
        coherent = np.add.reduceat(sizes.norms * found.largest, bounds[used], axis=0)
        errors = np.zeros(len(self._part))
        errors[used] = shape.economy.block_errors(coherent, shape.fft_samples, np.diff(bounds)[used]) + further
        return errors
