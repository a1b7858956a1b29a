"""The block frequency accumulator: drives from windows of the source and time-reversed bank rows.

The drive of eqs. (9) and (16) is a sum over bank rows of linear convolutions of what the row emits with its
time-reversed Green's functions. Time is cut into blocks; within a block, everything that one row emits is one
window, however many path points it comes from; its spectrum is multiplied with the row's, and a single
inverse transform per block and actuator gives the drives (overlap-add). Cost follows the number of (block,
row) pairs.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.emission import Emission, Windows
from rendering.omission import ErrorBudget, Omission, choose_bins
from rendering.regularisation import BankRows

Float64Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LEAST_FFT_SAMPLES = 4096
CACHE_BYTES = 384 * 2**20
SAMPLED_BLOCKS = 3
SAMPLED_WINDOWS = 8
"""Blocks, and windows in each, that are looked at to choose the bins worth computing."""
CAUTION = 0.7
"""Share of the tolerance that the estimated bound may fill; the proved one is found only afterwards."""
STRICTEST = 1e4


@dataclass(frozen=True, slots=True)
class RowSpectrum:
    """Transform of a time-reversed, scaled row.

    Parameters
    ----------
    kept : complex128 array, shape (actuators, kept bins)
    norms : float64 array, shape (actuators, groups), or None
        Norms of the groups of `Omission`, where bins are left out.
    """

    kept: ComplexArray
    norms: Float64Array | None


class RowSpectra:
    """Transforms rows when they are first asked for and keeps the latest.

    Parameters
    ----------
    rows : BankRows
        Where rows are read.
    fft_samples : int
        Transform length.
    omission : Omission, optional
        Which bins to keep; all where not given.
    """

    def __init__(self, rows: BankRows, fft_samples: int, omission: Omission | None = None) -> None:
        self._rows = rows
        self._fft_samples = fft_samples
        self._omission = omission
        # Kept and refilled: fresh zeros for each row would cost as much as its transform. One thread, too: a
        # row takes half a millisecond, and a second thread often wakes later than that.
        self._padded = np.zeros((rows.bank.actuators, fft_samples))
        self._cache: OrderedDict[int, RowSpectrum] = OrderedDict()
        self._bytes = 0

    def spectrum(self, row: int) -> RowSpectrum:
        """Spectrum of a row. Raises InputError where the row may not be used."""
        if row in self._cache:
            self._cache.move_to_end(row)
            return self._cache[row]
        values = self._rows.read(row).values
        self._padded[:, : values.shape[1]] = values[:, ::-1]
        full: ComplexArray = scipy_fft.rfft(self._padded, axis=1)
        if self._omission is None:
            entry = RowSpectrum(full, None)
        else:
            entry = RowSpectrum(full[:, self._omission.kept], self._omission.norms(full))
        self._cache[row] = entry
        self._bytes += entry.kept.nbytes
        while self._bytes > CACHE_BYTES and len(self._cache) > 1:
            self._bytes -= self._cache.popitem(last=False)[1].kept.nbytes
        return entry


@dataclass(frozen=True, slots=True)
class Accumulated:
    """What one emission cost and left out.

    Parameters
    ----------
    error : float
        Bound on the norm of the error from everything left out, rounding included; 0 where nothing was.
    bins : int
        Bins of a block's spectrum.
    kept_bins : int
        How many of them were computed.
    pairs : int
        (Block, row) pairs that were multiplied.
    band_energy : float
    energy : float
        Energy of all windows within the band asked about, and in all.
    """

    error: float
    bins: int
    kept_bins: int
    pairs: int
    band_energy: float
    energy: float


def accumulate(
    emission: Emission,
    rows: BankRows,
    drive_v: Float64Array,
    *,
    tolerance: float = 0.0,
    band_hz: tuple[float, float] | None = None,
    on_block: Callable[[int, int], None] | None = None,
) -> Accumulated:
    """Add the drives of one emission.

    Parameters
    ----------
    emission : Emission
        The source in time.
    rows : BankRows
        Bank rows with their regularisation.
    drive_v : float64 array, shape (actuators, samples)
        Added to in place; its first sample is at -(taps - 1).
    tolerance : float
        Relative magnitude that may be left out; a goal, the proved error is returned. 0: everything is
        computed.
    band_hz : tuple of float, optional
        Band within which the windows' energy is counted.
    on_block : callable, optional
        Told blocks done and blocks in all.
    """
    taps = rows.bank.taps
    reach = taps + emission.event_samples - 1
    fft_samples = int(scipy_fft.next_fast_len(max(LEAST_FFT_SAMPLES, 2 * reach), real=True))
    hop = fft_samples - reach + 1
    starts = range(emission.first_sample, emission.stop_event, hop)
    bins = fft_samples // 2 + 1
    omission = _choose(emission, rows, fft_samples, starts, hop, tolerance) if tolerance > 0 else None
    block = _Block(emission, rows, RowSpectra(rows, fft_samples, omission), fft_samples, omission)
    if band_hz is not None:
        frequency = scipy_fft.rfftfreq(fft_samples, 1.0 / rows.bank.sample_rate_hz)
        block.in_band = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    budget = ErrorBudget(fft_samples, hop)
    for done, start in enumerate(starts, 1):
        samples = block.drives(start, min(start + hop, emission.stop_event), budget)
        if samples is not None:
            length = min(fft_samples, drive_v.shape[1] - start)
            drive_v[:, start : start + length] += samples[:, :length]
        if on_block is not None:
            on_block(done, len(starts))
    kept = bins if omission is None else len(omission.kept)
    error = 0.0 if omission is None else budget.error
    return Accumulated(error, bins, kept, block.pairs, block.band_energy, block.energy)


@dataclass(slots=True)
class _Weighted:
    """A window times n and scale, at the kept bins, with its largest magnitudes where bins are left out."""

    spectrum: ComplexArray
    sigma: Float64Array | None
    largest: Float64Array | None
    windows: int = 1

    def add(self, other: _Weighted) -> None:
        self.spectrum += other.spectrum
        self.windows += other.windows
        if self.largest is not None and other.largest is not None:
            self.largest = self.largest + other.largest


class _Block:
    """Evaluates one block after another."""

    def __init__(
        self,
        emission: Emission,
        rows: BankRows,
        spectra: RowSpectra,
        fft_samples: int,
        omission: Omission | None,
    ) -> None:
        self._emission = emission
        self._rows = rows
        self._spectra = spectra
        self._fft_samples = fft_samples
        self._omission = omission
        self.in_band: NDArray[np.bool_] | None = None
        self.pairs = 0
        self.band_energy = 0.0
        self.energy = 0.0
        kept = fft_samples // 2 + 1 if omission is None else len(omission.kept)
        self._product = np.empty((rows.bank.actuators, kept), dtype=np.complex128)

    def drives(self, start: int, stop: int, budget: ErrorBudget) -> Float64Array | None:
        """Drives that the events in [start, stop) cause, (actuators, fft_samples), or None for silence."""
        total: ComplexArray | None = None
        coherent: Float64Array | None = None
        windows = 0
        for batch in self._emission.windows(start, stop, self._fft_samples):
            self._count_energy(batch.spectra)
            for row, parts in self._regularised(batch):
                green = self._spectra.spectrum(row)
                for part in parts:
                    np.multiply(green.kept, part.spectrum, out=self._product)
                    if part.sigma is not None:
                        self._product *= part.sigma[:, None]
                    if total is None:
                        total = self._product.copy()
                    else:
                        total += self._product
                    windows += part.windows
                    self.pairs += 1
                    if green.norms is not None and part.largest is not None:
                        share = green.norms * part.largest
                        if part.sigma is not None:
                            share *= part.sigma[:, None]
                        coherent = share if coherent is None else coherent + share
        if total is None:
            return None
        if self._omission is not None and coherent is not None:
            budget.add_block(coherent, windows)
            full = np.zeros((len(total), self._fft_samples // 2 + 1), dtype=np.complex128)
            full[:, self._omission.kept] = total
            total = full
        drives: Float64Array = scipy_fft.irfft(total, self._fft_samples, axis=1, overwrite_x=True)
        return drives

    def sample(self, start: int, stop: int) -> _Sample:
        """Look at a few windows of a block, each of which stands for its like: rows cost a transform each."""
        bins = self._fft_samples // 2 + 1
        sample = _Sample(np.zeros((0, bins)), np.zeros((0, bins)), np.zeros((0, 1)))
        for batch in self._emission.windows(start, stop, self._fft_samples):
            every = -(-len(batch.rows) // SAMPLED_WINDOWS)
            some = Windows(batch.rows[::every], batch.regularised_by[::every], batch.spectra[::every])
            for row, parts in self._regularised(some):
                green = np.linalg.norm(self._spectra.spectrum(row).kept, axis=0)
                for part in parts:
                    sample = sample.with_window(np.abs(part.spectrum), green, every)
        return sample

    def _regularised(self, batch: Windows) -> Iterator[tuple[int, list[_Weighted]]]:
        """Row by row, its windows times n and scale; those without saturation merged into one."""
        spectra, largest = batch.spectra, None
        if self._omission is not None:
            largest = self._omission.largest(spectra)
            spectra = spectra[:, self._omission.kept]
        edges = [0, *(np.flatnonzero(np.diff(batch.rows)) + 1).tolist(), len(batch.rows)]
        for first, last in pairwise(edges):
            row = int(batch.rows[first])
            parts: list[_Weighted] = []
            merged: _Weighted | None = None
            for index in range(first, last):
                by = int(batch.regularised_by[index])
                factor = self._rows.factor(row, by)
                bound = None if largest is None else largest[index] * factor
                part = _Weighted(spectra[index] * factor, self._rows.sigma(by), bound)
                if part.sigma is not None:
                    parts.append(part)
                elif merged is None:
                    merged = part
                else:
                    merged.add(part)
            yield row, parts if merged is None else [merged, *parts]

    def _count_energy(self, spectra: ComplexArray) -> None:
        if self.in_band is None:
            return
        energy = (np.square(spectra.real) + np.square(spectra.imag)).sum(axis=0)
        self.energy += float(energy.sum())
        self.band_energy += float(energy[self.in_band].sum())


@dataclass(frozen=True, slots=True)
class _Sample:
    """Magnitudes of a block's windows and of their rows, all actuators taken together, (windows, bins)."""

    windows: Float64Array
    greens: Float64Array
    repeats: Float64Array

    def with_window(self, window: Float64Array, green: Float64Array, repeats: int) -> _Sample:
        return _Sample(
            np.vstack([self.windows, window]),
            np.vstack([self.greens, green]),
            np.vstack([self.repeats, [[float(repeats)]]]),
        )


def _choose(
    emission: Emission, rows: BankRows, fft_samples: int, starts: range, hop: int, tolerance: float
) -> Omission | None:
    """Choose bins so that the bound, estimated from some windows of some blocks, meets the tolerance."""
    block = _Block(emission, rows, RowSpectra(rows, fft_samples), fft_samples, None)
    places = np.unique(np.linspace(0, len(starts) - 1, SAMPLED_BLOCKS).astype(int))
    samples = [block.sample(starts[place], min(starts[place] + hop, emission.stop_event)) for place in places.tolist()]
    in_phase = [(item.repeats * item.windows * item.greens).sum(axis=0) for item in samples]
    contribution = np.sum(np.square(in_phase), axis=0)
    energy = sum(float((item.repeats * np.square(item.windows * item.greens)).sum()) for item in samples)
    aim = tolerance
    while energy > 0 and aim > tolerance / STRICTEST:
        kept = choose_bins(contribution, aim)
        if kept.all():
            return None
        omission = Omission.of(kept)
        left_out = [
            (item.repeats * omission.largest(item.windows) * omission.norms(item.greens)).sum(axis=0)[:-1]
            for item in samples
        ]
        if np.sqrt(-(-fft_samples // hop) * np.sum(np.square(left_out)) / energy) <= CAUTION * tolerance:
            return omission
        aim *= 0.75
    return None
