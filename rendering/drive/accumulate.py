"""The block frequency accumulator: drives from windows of the source and time-reversed bank rows.

The drive of eqs. (9) and (16) is a sum over bank rows of linear convolutions of what the row emits with its
time-reversed Green's functions. Time is cut into blocks; within a block, everything that one row emits is one
window, however many path points it comes from; its spectrum is multiplied with the row's, and a single
inverse transform per block and actuator gives the drives (overlap-add). Cost follows the number of (block,
row) pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.band import Band, norm_of
from wavefocus.rendering.device import WORKERS, Device, fast_length, host_device, in_order
from wavefocus.rendering.drive.windows import RowSpectra, Windows
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.scene.sampling import SampledSource

WINDOWS_AT_ONCE = 32
"""Windows that are transformed together: about as many as stay in the cache of one core."""
BLOCKS_AHEAD = 32
"""Most blocks whose rows are loaded together."""
TINY = 2.0**-100
"""Bounds what a window loses where single precision underflows."""
MIN_HOP_SAMPLES = 512
HOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Hops that are weighed, relative to how far one event reaches."""
TRANSFORM_S = 0.35e-9
PRODUCT_S = 1.5e-9
OUTPUT_S = 0.6e-9
"""Seconds per sample and factor 2 of a transform, per bin and actuator of a product, per sample that overlap-add
touches. Measured with scipy's transforms in float64 on a 2.5 GHz Xeon; only their ratios matter, and not much."""


@dataclass(frozen=True, slots=True)
class Accumulated:
    """What one emission cost and left out.

    error: Bound on the norm of the error from single precision; 0 in double precision.
    band_energy, energy: Energy of all windows within the band asked about, and in all.
    """

    error: float
    pairs: int
    band_energy: float
    energy: float


@dataclass(frozen=True, slots=True)
class _Block:
    """Drives of one block (actuators, samples) before overlap-add, and its share of the figures."""

    samples: NDArray[Any]
    error: float
    pairs: int
    band_energy: float
    energy: float


class SourceDrives:
    """The drives of one source, as they come.

    single: Compute in single precision, with a proved bound on the error.
    on_block: Called with blocks done and blocks in all.
    live: Load the rows of no more than one block at a time.
    device: Where to compute, by default on this processor.
    """

    block_samples: int
    """Samples of drive that one block makes: those within which an event reaches, and a hop to the next block."""

    def __init__(
        self,
        source: SampledSource,
        rows: BankRows,
        *,
        single: bool = False,
        on_block: Callable[[int, int], None] | None = None,
        live: bool = False,
        device: Device | None = None,
    ) -> None:
        self._emission = emission = source.emission
        self._rows, self._single = rows, single
        reach = rows.bank.taps + emission.event_samples - 1
        span = emission.stop_event - emission.first_sample
        self.block_samples = choose_fft_samples(reach, span, rows.bank.actuators, source.focus_position, source.nodes)
        self._hop = self.block_samples - reach + 1
        self._starts = range(emission.first_sample, emission.stop_event, self._hop)
        self._on_block, self._blocks_ahead = on_block, 1 if live else BLOCKS_AHEAD
        self._device = host_device() if device is None else device
        self._piece_spectra = emission.piece_spectra(self.block_samples)
        self._inside = slice(0, 0)
        if (band_hz := rows.bank.band_hz) is not None:
            frequency_hz = np.fft.rfftfreq(self.block_samples, 1.0 / rows.bank.sample_rate_hz)
            edges = np.searchsorted(frequency_hz, [band_hz[0], np.nextafter(band_hz[1], np.inf)])
            self._inside = slice(*edges.tolist())
        self._facts: Accumulated | None = None

    @property
    def facts(self) -> Accumulated:
        """What all of it cost and left out, when the last piece was given."""
        if self._facts is None:
            raise RuntimeError("the drives were not made to their end")
        return self._facts

    def pieces(self) -> Generator[tuple[int, Float64Array], None, None]:
        """Give drives that nothing more is added to, without gaps and in order.

        Returns iterator of tuples: first sample, in an array of drives that begins with the bank's lead-in, and drives
        (actuators, samples) over 2**`BankRows.drive_exponent`.
        """
        spectra = RowSpectra(self._rows, Band.whole(self.block_samples, single=self._single), self._device)
        count = len(self._starts)
        tail: Float64Array = np.zeros((self._rows.bank.actuators, self.block_samples - self._hop))
        errors, pairs, band_energy, energy = [], 0, 0.0, 0.0
        for number, block in enumerate(self._blocks(spectra), 1):
            summed = block.samples.astype(np.float64, copy=False)
            summed[:, : tail.shape[1]] += tail
            tail = summed[:, self._hop :]
            errors.append(block.error)
            pairs += block.pairs
            band_energy += block.band_energy
            energy += block.energy
            done = summed if number == count else summed[:, : self._hop]
            yield self._starts[number - 1], done
            if self._on_block is not None:
                self._on_block(number, count)
        # A sample lies in so many blocks.
        overlap = -(-self.block_samples // self._hop)
        error = math.sqrt(overlap) * norm_of(np.array([errors]))
        self._facts = Accumulated(error, pairs, band_energy, energy)

    def add_to(self, drive_v: Float64Array) -> Accumulated:
        """Make all of it and add it to drives (actuators, samples) whose first sample is at -(taps - 1)."""
        for first, samples in self.pieces():
            last = min(first + samples.shape[1], drive_v.shape[1])
            drive_v[:, first:last] += samples[:, : last - first]
        return self.facts

    def _blocks(self, spectra: RowSpectra) -> Iterator[_Block]:
        """Sum all blocks, in order; some of them side by side, as far as their rows fit into memory together."""
        planned: list[Windows] = []
        needed: dict[int, None] = {}
        for start in self._starts:
            windows = self._windows(start)
            more = dict.fromkeys(windows.pairs[0].tolist())
            if planned and (len(planned) >= self._blocks_ahead or len(needed | more) > spectra.most_rows):
                yield from self._together(planned, list(needed), spectra)
                planned, needed = [], {}
            planned.append(windows)
            needed |= more
        yield from self._together(planned, list(needed), spectra)

    def _windows(self, start: int) -> Windows:
        return Windows(self._emission.events(start, min(start + self._hop, self._emission.stop_event)))

    def _together(self, planned: Sequence[Windows], rows: Sequence[int], spectra: RowSpectra) -> Iterator[_Block]:
        fits = len(rows) <= spectra.most_rows
        if fits:
            spectra.load(rows)
        for windows in planned:
            windows.weigh(self._rows.weigh)
        workers = WORKERS if self._device.is_host and len(planned) > 1 else 1
        yield from in_order(lambda windows: self._sum(windows, spectra, loaded=fits), planned, workers)

    @np.errstate(over="ignore", invalid="ignore")
    def _sum(self, windows: Windows, spectra: RowSpectra, *, loaded: bool) -> _Block:
        """Windows times their time-reversed rows, added up and transformed back."""
        xp, band = self._device.xp, spectra.band
        total = xp.zeros((self._rows.bank.actuators, band.bins), dtype=self._device.dtype(band.complex))
        energy = band_energy = coherent = 0.0
        at_once = WINDOWS_AT_ONCE if loaded else min(WINDOWS_AT_ONCE, spectra.most_rows)
        for first in range(0, len(windows), at_once):
            last = min(first + at_once, len(windows))
            rows = windows.rows[first:last].tolist()
            if not loaded:
                spectra.load(list(dict.fromkeys(rows)))
            emitted = windows.spectra(first, last, self.block_samples, self._piece_spectra)
            power = np.square(emitted.real) + np.square(emitted.imag)
            energy += float(power.sum())
            band_energy += float(power[:, self._inside].sum())
            driven = xp.asarray(emitted.astype(band.complex, copy=False))
            for place, (row, by) in enumerate(zip(rows, windows.regularised_by[first:last].tolist(), strict=True)):
                product = spectra[row].values * driven[place, :]
                if by >= 0:
                    product *= xp.asarray(self._rows.sigma(by), dtype=self._device.dtype(band.real))[:, None]
                total += product
                if band.single:
                    # Saturation only lessens a row.
                    coherent += (math.sqrt(float(power[place].max())) + TINY) * spectra[row].norm
        samples = self._device.to_host(self._device.fft(single=band.single).irfft(total, n=self.block_samples, axis=1))
        return _Block(samples, band.rounding_error(coherent, len(windows)), len(windows), band_energy, energy)


def choose_fft_samples(reach: int, span: int, actuators: int, focus_position: Int64Array, nodes: int) -> int:
    """Choose the transform length by what transforms, products and overlap-add will cost.

    Long blocks waste less on their overlap, short ones less on rows that emit briefly.

    reach: Samples of drive that one event makes.
    span: Samples over which events begin.
    focus_position, int64 (points,): Row of each path point.
    nodes: Rows that make one path point.
    """
    rows = nodes * len(np.unique(focus_position))
    moves = nodes * np.count_nonzero(np.diff(focus_position))
    best, least = 0, np.inf
    for hop in sorted({min(span, max(MIN_HOP_SAMPLES, int(share * reach))) for share in HOPS}):
        fft_samples = fast_length(reach + hop - 1)
        blocks = -(-span // (fft_samples - reach + 1))
        pairs = moves + nodes * blocks
        transform_s = TRANSFORM_S * fft_samples * np.log2(fft_samples)
        cost_s = (
            transform_s * (actuators * (rows + blocks) + pairs)
            + PRODUCT_S * pairs * actuators * fft_samples / 2
            + OUTPUT_S * blocks * actuators * fft_samples
        )
        if cost_s < least:
            best, least = fft_samples, cost_s
    return best
