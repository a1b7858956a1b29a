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

from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.band import Band, choose_band, norm_of, scale
from wavefocus.rendering.device import WORKERS, Device, fast_length, host_device, in_order
from wavefocus.rendering.drive.windows import RowSpectra, Windows
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.scene.sampling import SampledSource

WINDOWS_AT_ONCE = 32
"""Windows that are transformed together: about as many as stay in the cache of one core."""
BLOCKS_AHEAD = 32
"""Most blocks whose rows are loaded together."""
SAMPLED_BLOCKS, SAMPLED_WINDOWS = 3, 8
"""Blocks, and windows in each, by which the bins worth computing are chosen."""
LEAST_HOP_SAMPLES = 512
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

    error: Bound on the norm of the error from everything left out, rounding included; 0 where nothing was.
    bins: Bins of a block's spectrum.
    kept_bins: How many of them were computed.
    band_energy, energy: Energy of all windows within the band asked about, and in all.
    """

    error: float
    bins: int
    kept_bins: int
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

    tolerance: Relative magnitude that may be left out; a goal, the proved error is reported. 0: everything is computed,
        in double precision.
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
        tolerance: float = 0.0,
        on_block: Callable[[int, int], None] | None = None,
        live: bool = False,
        device: Device | None = None,
    ) -> None:
        self._emission = emission = source.emission
        self._rows, self._tolerance = rows, tolerance
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
        self._exponent: int | None = None
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
        bounded = self._tolerance > 0
        spectra = RowSpectra(self._rows, Band.whole(self.block_samples), self._device, bounded=bounded)
        if bounded:
            spectra.narrow(self._choose_band(spectra))
        band, count = spectra.band, len(self._starts)
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
            yield self._starts[number - 1], scale(done, self._unit)
            if self._on_block is not None:
                self._on_block(number, count)
        error = 0.0
        if not band.exact:
            with np.errstate(over="ignore", under="ignore"):
                error = float(np.ldexp(math.sqrt(self._overlap) * norm_of(np.array([errors])), self._unit))
        self._facts = Accumulated(error, band.bins, band.kept, pairs, band_energy, energy)

    def add_to(self, drive_v: Float64Array) -> Accumulated:
        """Make all of it and add it to drives (actuators, samples) whose first sample is at -(taps - 1)."""
        for first, samples in self.pieces():
            last = min(first + samples.shape[1], drive_v.shape[1])
            drive_v[:, first:last] += samples[:, : last - first]
        return self.facts

    @property
    def _overlap(self) -> int:
        """Most blocks that a sample lies in."""
        return -(-self.block_samples // self._hop)

    @property
    def _unit(self) -> int:
        """Power of two that samples of blocks are still to be multiplied with."""
        return self._emission.exponent + (self._exponent or 0)

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
            self._prepare(windows)
        workers = WORKERS if self._device.is_host and len(planned) > 1 else 1
        yield from in_order(lambda windows: self._sum(windows, spectra, loaded=fits), planned, workers)

    def _prepare(self, windows: Windows) -> None:
        """Read the rows that only regularise, and choose the unit in which windows are about 1."""
        rows, by = windows.pairs
        if len(rows) and self._exponent is None:
            self._exponent = int(np.frexp(self._rows.weigh(rows[:1], by[:1])[0][0])[1])
        windows.weigh(self._weigh)

    def _weigh(self, rows: Int64Array, regularised_by: Int64Array) -> tuple[Float64Array, BoolArray]:
        return self._rows.weigh(rows, regularised_by, self._exponent or 0)

    @np.errstate(over="ignore", invalid="ignore")
    def _sum(self, windows: Windows, spectra: RowSpectra, *, loaded: bool) -> _Block:
        """Windows times their time-reversed rows, added up and transformed back."""
        xp, band = self._device.xp, spectra.band
        total = xp.zeros((self._rows.bank.actuators, band.kept), dtype=self._device.dtype(band.complex))
        energy = band_energy = coherent = 0.0
        magnitude = np.zeros(band.bins)
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
            kept = xp.asarray(emitted[:, : band.kept].astype(band.complex, copy=False))
            for place, (row, by) in enumerate(zip(rows, windows.regularised_by[first:last].tolist(), strict=True)):
                known = spectra[row]
                product = known.kept * kept[place, :]
                if by >= 0:
                    product *= xp.asarray(self._rows.sigma(by), dtype=self._device.dtype(band.real))[:, None]
                total += product
                if known.magnitude is not None:
                    # Saturation only lessens a row.
                    size = np.sqrt(power[place])
                    magnitude += size * known.magnitude
                    coherent += float(size.max()) * known.norm
        samples = self._device.to_host(self._device.fft(single=band.single).irfft(total, n=self.block_samples, axis=1))
        error = 0.0 if band.exact else band.block_error(magnitude, coherent, len(windows))
        return _Block(samples, error, len(windows), band_energy, energy)

    def _choose_band(self, spectra: RowSpectra) -> Band:
        """Choose the bins worth computing by some windows of some blocks."""
        contribution, energy, coherent, most = np.zeros(self.block_samples // 2 + 1), 0.0, 0.0, 0
        for block in np.unique(np.linspace(0, len(self._starts) - 1, SAMPLED_BLOCKS).astype(int)).tolist():
            windows = self._windows(self._starts[block])
            self._prepare(windows)
            every = max(1, -(-len(windows) // SAMPLED_WINDOWS))
            magnitude, reach = np.zeros(len(contribution)), 0.0
            for place in range(0, len(windows), every):
                row = int(windows.rows[place])
                spectra.load([row])
                known = spectra[row]
                assert known.magnitude is not None
                size = np.abs(windows.spectra(place, place + 1, self.block_samples, self._piece_spectra)[0])
                product = size * known.magnitude
                magnitude += every * product
                energy += every * float(product @ product)
                reach += every * float(size.max()) * known.norm
            contribution += np.square(magnitude)
            coherent += reach**2
            most = max(most, len(windows))
        q = self._overlap
        return choose_band(self.block_samples, q * contribution, energy, q * coherent, most, self._tolerance)


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
    for hop in sorted({min(span, max(LEAST_HOP_SAMPLES, int(share * reach))) for share in HOPS}):
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
