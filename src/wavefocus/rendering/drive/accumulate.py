"""The block frequency accumulator: drives from windows of the source and time-reversed bank rows.

The drive of eqs. (9) and (16) is a sum over bank rows of linear convolutions of what the row emits with its
time-reversed Green's functions. Time is cut into blocks, the same for all sources; within a block, everything that one
row emits for one source is one window, however many path points it comes from; its spectrum is multiplied with the
row's, and a single inverse transform per block and actuator gives the drives (overlap-add). Cost follows the number of
(block, row) pairs.
"""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import WORKERS, Device, fast_length, host_device, threaded_map
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.scene.emission import Emission, RowSpectra, Windows
from wavefocus.rendering.scene.sampling import SampledScene

WINDOWS_AT_ONCE = 32
"""Windows that are transformed together: about as many as stay in the cache of one core."""
BLOCKS_AHEAD = 32
"""Most blocks whose rows are loaded together."""
MAX_SILENCE_SAMPLES = 4096


_Block = tuple[Float64Array, float, Float64Array]
"""Drives of one block, (actuators, samples), the bound on their error, and figures of each source, as `statistics`."""


class BlockAccumulator:
    """The drives of all sources of a scene, block by block.

    single: Compute in single precision, with a proved bound on the error.
    device: Where to compute, by default on this processor.
    """

    block_samples: int
    """Samples of drive that one block makes: those within which an event reaches, and a hop to the next block."""
    error: float = 0.0
    """Bound on the norm of the error from single precision in all blocks given so far."""

    def __init__(
        self, scene: SampledScene, rows: BankRows, *, single: bool = False, device: Device | None = None
    ) -> None:
        self._rows, self._single, self._samples = rows, single, scene.samples
        self._emissions = [source.emission for source in scene.sources]
        reach = rows.taps + max(emission.event_samples for emission in self._emissions) - 1
        first = min(emission.first_sample for emission in self._emissions)
        stop = max(emission.stop_event for emission in self._emissions)
        self.block_samples = _choose_fft_samples(
            reach, stop - first, rows.bank.actuators,
            [(source.focus_position, source.nodes) for source in scene.sources],
        )  # fmt: skip
        self._hop = self.block_samples - reach + 1
        self._starts = range(first, stop, self._hop)
        self._device = host_device() if device is None else device
        self._piece_spectra = [emission.piece_spectra(self.block_samples) for emission in self._emissions]
        self._inside = slice(0, 0)
        if (band_hz := rows.bank.band_hz) is not None:
            frequency_hz = np.fft.rfftfreq(self.block_samples, 1.0 / rows.bank.sample_rate_hz)
            edges = np.searchsorted(frequency_hz, [band_hz[0], np.nextafter(band_hz[1], np.inf)])
            self._inside = slice(*edges.tolist())
        self.statistics = np.zeros((len(self._emissions), 2))
        """Of each source, of all blocks given so far: energy of the windows in the bank's band, and in all."""

    def blocks(self, ahead: int = BLOCKS_AHEAD) -> Iterator[Float64Array]:
        """Yield finished drives in order, (actuators, some samples), from the lead-in's first sample to the last.

        ahead: Most blocks whose rows are loaded together.

        Raises InputError: a row on a path cannot be used.
        """
        band = Band(self.block_samples, self.block_samples // 2 + 1, self._single)
        spectra = RowSpectra(self._rows, band, self._device)
        self.statistics, errors = np.zeros_like(self.statistics), 0.0
        # A sample lies in so many blocks.
        overlap = -(-self.block_samples // self._hop)
        tail: Float64Array = np.zeros((self._rows.bank.actuators, self.block_samples - self._hop))
        yield from self._silence(self._starts[0])
        for start, (samples, error, figures) in zip(self._starts, self._blocks(spectra, ahead), strict=True):
            summed = samples.astype(np.float64, copy=False)
            summed[:, : tail.shape[1]] += tail
            tail = summed[:, self._hop :]
            errors = math.hypot(errors, error)
            self.error = math.sqrt(overlap) * errors
            self.statistics += figures
            yield summed[:, : min(self._hop, self._samples - start)]
        end = self._starts[-1] + self._hop
        yield tail[:, : max(self._samples - end, 0)]
        yield from self._silence(self._samples - end - tail.shape[1])

    def _silence(self, samples: int) -> Iterator[Float64Array]:
        for first in range(0, samples, MAX_SILENCE_SAMPLES):
            yield np.zeros((self._rows.bank.actuators, min(MAX_SILENCE_SAMPLES, samples - first)))

    def _blocks(self, spectra: RowSpectra, ahead: int) -> Iterator[_Block]:
        """Sum all blocks, in order; some of them side by side, as far as their rows fit into memory together."""
        planned: list[list[Windows | None]] = []
        needed: dict[int, None] = {}
        for start in self._starts:
            block = [self._windows(emission, start) for emission in self._emissions]
            more = dict.fromkeys(row for windows in block if windows is not None for row in windows.pairs[0].tolist())
            if planned and (len(planned) >= ahead or len(needed | more) > spectra.most_rows):
                yield from self._together(planned, list(needed), spectra)
                planned, needed = [], {}
            planned.append(block)
            needed |= more
        yield from self._together(planned, list(needed), spectra)

    def _windows(self, emission: Emission, start: int) -> Windows | None:
        """Windows of a source in the block from a sample on, None where no event begins in it."""
        first, stop = max(start, emission.first_sample), min(start + self._hop, emission.stop_event)
        return Windows(emission.events(first, stop), first - start) if first < stop else None

    def _together(
        self, planned: Sequence[Sequence[Windows | None]], rows: Sequence[int], spectra: RowSpectra
    ) -> Iterator[_Block]:
        fits = len(rows) <= spectra.most_rows
        if fits:
            spectra.load(rows)
        for windows in itertools.chain.from_iterable(planned):
            if windows is not None:
                windows.weigh(self._rows.weigh)
        workers = WORKERS if self._device.is_host and len(planned) > 1 else 1
        yield from threaded_map(lambda block: self._sum(block, spectra, loaded=fits), planned, workers)

    @np.errstate(over="ignore", invalid="ignore")
    def _sum(self, block: Sequence[Windows | None], spectra: RowSpectra, *, loaded: bool) -> _Block:
        """Windows times their time-reversed rows, added up and transformed back."""
        xp, band, actuators = self._device.xp, spectra.band, self._rows.bank.actuators
        figures, coherent, pairs = np.zeros((len(block), 2)), 0.0, 0
        total = xp.zeros((actuators, band.bins), dtype=self._device.dtype(band.complex))
        at_once = WINDOWS_AT_ONCE if loaded else min(WINDOWS_AT_ONCE, spectra.most_rows)
        for source, windows in enumerate(block):
            if windows is None:
                continue
            for first in range(0, len(windows), at_once):
                last = min(first + at_once, len(windows))
                rows = windows.rows[first:last].tolist()
                if not loaded:
                    spectra.load(list(dict.fromkeys(rows)))
                emitted = windows.spectra(first, last, self.block_samples, self._piece_spectra[source])
                power = np.square(emitted.real) + np.square(emitted.imag)
                figures[source] += power[:, self._inside].sum(), power.sum()
                pairs += last - first
                driven = xp.asarray(emitted.astype(band.complex, copy=False))
                for place, (row, by) in enumerate(zip(rows, windows.regularised_by[first:last].tolist(), strict=True)):
                    values, norm = spectra[row]
                    product = values * driven[place, :]
                    if by >= 0:
                        product *= xp.asarray(self._rows.sigma(by), dtype=self._device.dtype(band.real))[:, None]
                    total += product
                    if band.single:
                        # Saturation only lessens a row.
                        # Bounds what a window loses where single precision underflows.
                        coherent += (math.sqrt(float(power[place].max())) + 2.0**-100) * norm
        if not pairs:
            return np.zeros((actuators, self.block_samples)), 0.0, figures
        samples = self._device.to_host(self._device.fft(single=band.single).irfft(total, n=self.block_samples, axis=1))
        return samples, band.rounding_error(coherent, pairs), figures


def _choose_fft_samples(reach: int, span: int, actuators: int, paths: Sequence[tuple[Int64Array, int]]) -> int:
    """Choose the transform length by what transforms, products and overlap-add will cost.

    Long blocks waste less on their overlap, short ones less on rows that emit briefly.

    reach: Samples of drive that one event makes.
    span: Samples over which events begin.
    paths: Of each source, the row of each path point, int64 (points,), and how many rows make one path point.
    """
    rows = sum(nodes * len(np.unique(position)) for position, nodes in paths)
    moves = sum(nodes * np.count_nonzero(np.diff(position)) for position, nodes in paths)
    staying = sum(nodes for _, nodes in paths)

    def cost_s(fft_samples: int) -> float:
        blocks = -(-span // (fft_samples - reach + 1))
        pairs = moves + staying * blocks
        transform_s = 0.35e-9 * fft_samples * np.log2(fft_samples)
        # Seconds per sample and factor 2 of a transform, per bin and actuator of a product, per sample that overlap-
        # add touches. Measured with scipy's transforms in float64 on a 2.5 GHz Xeon; only their ratios matter, and not
        # much.
        return float(
            transform_s * (actuators * (rows + blocks) + pairs)
            + 1.5e-9 * pairs * actuators * fft_samples / 2
            + 0.6e-9 * blocks * actuators * fft_samples
        )

    # Hops that are weighed, relative to how far one event reaches.
    shares = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0, 1.5, 2.0, 3.0, 4.0)
    hops = (min(span, max(512, int(share * reach))) for share in shares)
    return min((fast_length(reach + hop - 1) for hop in hops), key=cost_s)
