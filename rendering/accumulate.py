"""The block frequency accumulator: drives from windows of the source and time-reversed bank rows.

The drive of eqs. (9) and (16) is a sum over bank rows of linear convolutions of what the row emits with its
time-reversed Green's functions. Time is cut into blocks; within a block, everything that one row emits is one
window, however many path points it comes from; its spectrum is multiplied with the row's, and a single
inverse transform per block and actuator gives the drives (overlap-add). Cost follows the number of (block,
row) pairs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.choice import choose_economy
from rendering.emission import Emission, Windows
from rendering.omission import Economy, ErrorBudget
from rendering.regularisation import BankRows
from rendering.row_spectra import RowSpectra

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

COARSE = 1e-4
"""Tolerances above this allow to look for the bins worth computing in single precision."""
SPECTRA_BYTES = 4 * 2**20
"""Blocks of so many bytes are transformed back together."""
PLAIN_SINGLE, PLAIN_DOUBLE = 60, 900
"""Spectra about 1 can be multiplied by two to a power below these."""


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
    fft_samples: int,
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
    fft_samples : int
        Transform length, at least taps + event samples - 1.
    tolerance : float
        Relative magnitude that may be left out; a goal, the proved error is returned. 0: everything is
        computed, in double precision.
    band_hz : tuple of float, optional
        Band within which the windows' energy is counted.
    on_block : callable, optional
        Told blocks done and blocks in all.
    """
    hop = fft_samples - (rows.bank.taps + emission.event_samples - 1) + 1
    starts = range(emission.first_sample, emission.stop_event, hop)
    blocks = _Blocks(emission, rows, fft_samples, hop, band_hz)
    economy = blocks.choose(starts, tolerance)
    budget = ErrorBudget(fft_samples, hop)
    # A second thread transforms back and adds, in order, while this one goes on with the next blocks.
    shape = (blocks.at_once, rows.bank.actuators, economy.bins)
    idle = [np.zeros(shape, dtype=economy.complex) for _ in range(1 if len(starts) <= blocks.at_once else 2)]
    under_way: deque[Future[NDArray[Any]]] = deque()
    with np.errstate(over="ignore", under="ignore", invalid="ignore"), ThreadPoolExecutor(1) as second:
        for first in range(0, len(starts), blocks.at_once):
            batch = starts[first : first + blocks.at_once]
            spectra = idle.pop() if idle else under_way.popleft().result()
            for place, start in enumerate(batch):
                budget.add_block(blocks.spectrum(start, spectra[place]))
                if on_block is not None:
                    on_block(first + place + 1, len(starts))
            under_way.append(second.submit(blocks.add_in_time, spectra, batch, drive_v))
        for future in under_way:
            future.result()
    error = 0.0 if economy.exact else budget.error
    return Accumulated(error, economy.bins, economy.kept, blocks.pairs, blocks.band_energy, blocks.energy)


class _Blocks:
    """Evaluates one block after another."""

    def __init__(
        self,
        emission: Emission,
        rows: BankRows,
        fft_samples: int,
        hop: int,
        band_hz: tuple[float, float] | None,
    ) -> None:
        self._emission = emission
        self._rows = rows
        self._fft_samples = fft_samples
        self._hop = hop
        self._band: slice | None = None
        if band_hz is not None:
            frequency = scipy_fft.rfftfreq(fft_samples, 1.0 / rows.bank.sample_rate_hz)
            first = np.searchsorted(frequency, band_hz[0], side="left")
            self._band = slice(int(first), int(np.searchsorted(frequency, band_hz[1], side="right")))
        self.at_once = max(1, SPECTRA_BYTES // (16 * rows.bank.actuators * (fft_samples // 2 + 1)))
        self.pairs = 0
        self.band_energy = 0.0
        self.energy = 0.0
        self._economy = Economy.of(fft_samples // 2 + 1)
        self._spectra = RowSpectra(rows, fft_samples, self._economy)
        self._sums: NDArray[Any] = np.zeros((0, 0))
        self._product: NDArray[Any] = np.zeros((0, 0))
        self._factor_exponent = 0
        self._settled = False

    def choose(self, starts: range, tolerance: float) -> Economy:
        """Settle scale, bins and precision; the first window says what the scale is."""
        for start in starts:
            first = next(self._windows(start), None)
            if first is not None and len(first.rows):
                row = first.rows[:1]
                by = np.where(first.regularised_by[:1] < 0, row, first.regularised_by[:1])
                self._factor_exponent = int(np.frexp(self._rows.weigh(row, by)[0][0])[1])
                break
        bins = self._fft_samples // 2 + 1
        if tolerance > COARSE:
            # What single precision blurs, a part in ten million, does not change the choice.
            self._spectra = RowSpectra(self._rows, self._fft_samples, Economy.of(bins, single=True))
        self._economy = choose_economy(self._emission, self._weigh, self._norms, self._fft_samples, starts, tolerance)
        if tolerance:
            self._spectra = RowSpectra(self._rows, self._fft_samples, self._economy)
        shape = (self._rows.bank.actuators, self._economy.kept)
        self._sums, self._product = (np.empty(shape, dtype=self._economy.complex) for _ in range(2))
        self._settled = True
        return self._economy

    def spectrum(self, start: int, total: NDArray[Any]) -> float:
        """Compute the drives that the events in [start, start + hop) cause, and a bound on their error.

        Parameters
        ----------
        start : int
            First sample of the block.
        total : complex array, shape (actuators, bins)
            Gets their spectrum, over 2**exponent of the emission and of the first factor, in the bins kept.
        """
        economy = self._economy
        # Apart from `total`, so that numpy adds one long run instead of one per actuator.
        sums, product = self._sums, self._product
        sums[:] = 0
        coherent = np.zeros((self._rows.bank.actuators, economy.segments + 1))
        pairs = 0
        for batch in self._windows(start):
            if not len(batch.rows):
                continue
            whole = batch.spectra.astype(economy.complex, copy=False)
            squared = economy.squared(whole)
            self._count_energy(squared)
            windows = whole[:, economy.low : economy.high]
            greens = self._spectra.spectra(batch.rows.tolist())
            sigmas = [self._sigma(by) for by in batch.regularised_by.tolist()]
            for green, window, sigma in zip(greens, windows, sigmas, strict=True):
                np.multiply(green.kept, window, out=product)
                if sigma is not None:
                    product *= sigma[:, None]
                sums += product
            if not economy.exact:
                norms = np.array([green.norms for green in greens])
                for place, sigma in enumerate(sigmas):
                    if sigma is not None:
                        norms[place] *= sigma[:, None]
                coherent += np.einsum("wis,ws->is", norms, economy.largest(squared))
            pairs += len(greens)
        total[:, economy.low : economy.high] = sums
        self.pairs += pairs
        if economy.exact or not pairs:
            return 0.0
        exponent = self._emission.exponent + self._factor_exponent
        return float(np.ldexp(economy.block_error(coherent, self._fft_samples, pairs), exponent))

    def add_in_time(self, spectra: NDArray[Any], starts: range, drive_v: Float64Array) -> NDArray[Any]:
        """Transform blocks back and add them to the drives; gives the spectra's array back for others."""
        economy = self._economy
        blocks = spectra[: len(starts)]
        exponent = self._emission.exponent + self._factor_exponent
        near = abs(exponent) < (PLAIN_SINGLE if economy.single else PLAIN_DOUBLE)
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            if near:
                blocks[:, :, economy.low : economy.high] *= economy.real(2.0**exponent)
            samples: NDArray[Any] = scipy_fft.irfft(blocks, self._fft_samples, axis=2)
            for start, block in zip(starts, samples, strict=True):
                # Adding mixed types takes numpy twice as long as converting first.
                volts = block.astype(np.float64, copy=False)
                length = min(self._fft_samples, drive_v.shape[1] - start)
                drive_v[:, start : start + length] += (volts if near else np.ldexp(volts, exponent))[:, :length]
        return spectra

    def _windows(self, start: int) -> Iterator[Windows]:
        stop = min(start + self._hop, self._emission.stop_event)
        return self._emission.windows(start, stop, self._fft_samples, self._weigh)

    def _weigh(self, rows: Int64Array, regularised_by: Int64Array) -> tuple[Float64Array, NDArray[np.bool_]]:
        if self._settled:
            # Rows that are read for their weights are transformed on the spot, lest they be read twice.
            unknown = [row for row in rows.tolist() if not self._rows.knows(row)]
            if unknown:
                self._spectra.spectra(unknown)
        return self._rows.weigh(rows, regularised_by, self._factor_exponent)

    def _sigma(self, by: int) -> NDArray[Any] | None:
        sigma = None if by < 0 else self._rows.sigma(by)
        return None if sigma is None else sigma.astype(self._economy.real)

    def _norms(self, row: int) -> Float64Array:
        norms: Float64Array = np.linalg.norm(self._spectra.spectra([row])[0].kept, axis=0)
        return norms

    def _count_energy(self, squared: NDArray[Any]) -> None:
        if self._band is not None:
            self.band_energy += float(squared[:, self._band].sum(dtype=np.float64))
            self.energy += float(squared.sum(dtype=np.float64))
