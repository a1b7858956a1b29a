"""What a source emits in time, block by block, from which rows, as windows; and the spectra of time-reversed rows."""

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.band import Band
from wavefocus.rendering.device import WORKERS, Device, threaded_map
from wavefocus.rendering.greens.interpolation.base import Nodes
from wavefocus.rendering.greens.regularisation import BankRows

Weigh = Callable[[Int64Array], tuple[Float64Array, BoolArray]]
"""For regularising rows: the factor, and whether actuators are saturated."""

MIN_ROW_NORM = 2.0**-116
"""Single precision takes 2**-150 from each sample of a row (IEEE 754, denormal numbers): 2**-34 of this norm."""
SPAN = 2**31
"""More than a bank has rows: two of them make one number."""


@dataclass(frozen=True, slots=True)
class Events:
    """Samples that rows emit within a block.

    nodes: Rows and weights that make each event; those of weight 0 are not used.
    sample, int64 (events,): When, from the block's start.
    values, float64 (events,): What is emitted.
    piece, int64 (events,): Which piece of a signal each event is the beginning of, where it is not a sample.
    """

    nodes: Nodes
    sample: Int64Array
    values: Float64Array
    piece: Int64Array | None = None


class Windows:
    """Windows of one block: what one row emits, one saturation at a time.

    Before `weigh` is called there are only the pairs of a row and a regularising row.

    delay: Samples from the block's start to the one from which the events are counted.
    """

    pairs: tuple[Int64Array, Int64Array]
    """Rows and regularising rows that emit something, none twice, in the order in which they are first needed."""
    rows: Int64Array
    """Bank row of each window."""
    regularised_by: Int64Array
    """The row whose sigma each window takes, -1 where no actuator is saturated."""

    def __init__(self, events: Events, delay: int = 0) -> None:
        nodes, each = events.nodes, events.nodes.rows.shape[1]
        self._amount = (nodes.weights * events.values[:, None]).T.ravel()
        key = (nodes.rows * SPAN + nodes.nearest[:, None]).T.ravel()
        key[self._amount == 0] = -1
        self._sample = np.concatenate([events.sample + delay] * each)
        self._piece = None if events.piece is None else np.concatenate([events.piece] * each)
        # Runs of one key are few: only they go through what takes long.
        begins = np.concatenate([[0], np.flatnonzero(key[1:] != key[:-1]) + 1])[: len(key)]
        first = np.minimum.reduceat(self._sample, begins) if len(begins) else begins
        of_run = key[begins].tolist()
        needed = dict.fromkeys(of_run[run] for run in np.argsort(first, kind="stable").tolist())
        needed.pop(-1, None)
        index = {key: pair for pair, key in enumerate(needed)} | {-1: -1}
        pairs = np.array(list(needed), dtype=np.int64)
        self.pairs = pairs // SPAN, pairs % SPAN
        lengths = np.concatenate([begins[1:], [len(key)]])[: len(begins)] - begins
        self._pair = np.repeat(np.array([index[key] for key in of_run], dtype=np.int64), lengths)
        if -1 in of_run:
            loud = self._pair >= 0
            self._pair, self._sample, self._amount = self._pair[loud], self._sample[loud], self._amount[loud]
            self._piece = None if self._piece is None else self._piece[loud]

    def __len__(self) -> int:
        return len(self.rows)

    def weigh(self, weigh: Weigh) -> None:
        """Weigh what is emitted, and join what saturates alike."""
        rows, by = self.pairs
        factors, saturated = weigh(by)
        windows, of_pair = np.unique(rows * SPAN + np.where(saturated, by + 1, 0), return_inverse=True)
        self.rows, self.regularised_by = windows // SPAN, windows % SPAN - 1
        self._part, self._parts, self._pieces = of_pair[self._pair], np.arange(len(windows)), 1
        if self._piece is not None:
            # One part for each piece of a signal that a window holds beginnings of.
            self._pieces = int(self._piece.max(initial=0)) + 1
            self._parts, self._part = np.unique(self._part * self._pieces + self._piece, return_inverse=True)
        self._amount = self._amount * factors[self._pair]

    def spectra(
        self, first: int, last: int, fft_samples: int, piece_spectra: Complex128Array | None = None
    ) -> Complex128Array:
        """Spectra of windows first to last - 1, (windows, bins), time 0 being the block's start.

        first, last: Which windows.
        piece_spectra, complex128 (pieces, bins): Spectra of the pieces of a signal that events are beginnings of.
        """
        begin, end = np.searchsorted(self._parts, [first * self._pieces, last * self._pieces]).tolist()
        part, sample, amount = self._part, self._sample, self._amount
        if end - begin < len(self._parts):
            chosen = (part >= begin) & (part < end)
            part, sample, amount = part[chosen] - begin, sample[chosen], amount[chosen]
        dense = np.bincount(part * fft_samples + sample, weights=amount, minlength=(end - begin) * fft_samples)
        spectra: Complex128Array = np.fft.rfft(dense.reshape(end - begin, fft_samples), axis=1)
        if piece_spectra is None:
            return spectra
        parts = self._parts[begin:end]
        spectra *= piece_spectra[parts % self._pieces]
        return np.add.reduceat(spectra, np.searchsorted(parts, np.arange(first, last) * self._pieces), axis=0)


RowSpectrum = tuple[Any, float]
"""Spectrum of one row, a complex array of the device (actuators, bins), and its norm, at least `MIN_ROW_NORM`; the norm
in single precision only."""


class RowSpectra:
    """Reads rows, reverses them in time and transforms them; the rows used last are kept.

    band: Transform length and precision.
    device: Where they are computed and kept, within its memory.
    """

    def __init__(self, rows: BankRows, band: Band, device: Device) -> None:
        self._rows, self._device, self.band = rows, device, band
        self._spectra: OrderedDict[int, RowSpectrum] = OrderedDict()
        row_bytes = band.bins * rows.bank.actuators * np.dtype(band.complex).itemsize
        self.most_rows = int(max(1, device.memory_bytes // row_bytes))

    def __getitem__(self, row: int) -> RowSpectrum:
        return self._spectra[row]

    def load(self, rows: Sequence[int]) -> None:
        """Have the spectra of some rows, at most `most_rows`, in memory. Raises InputError: a row may not be used."""
        missing = [row for row in rows if row not in self._spectra]
        for row in rows:
            if row in self._spectra:
                self._spectra.move_to_end(row)
        while self._spectra and len(self._spectra) + len(missing) > self.most_rows:
            self._spectra.popitem(last=False)
        workers = WORKERS if self._device.is_host and len(missing) > 1 else 1
        for row, spectrum in zip(missing, threaded_map(self._transform, missing, workers), strict=True):
            self._spectra[row] = spectrum

    def _transform(self, row: int) -> RowSpectrum:
        xp, single = self._device.xp, self.band.single
        green = self._rows.read(row, single=single)
        reversed_in_time = xp.asarray(np.ascontiguousarray(green[:, ::-1]))
        values = self._device.fft(single=single).rfft(reversed_in_time, n=self.band.fft_samples, axis=1)
        # Of what is transformed: the spectrum of a whole transform has sqrt(n) times the norm.
        norm = math.sqrt(self.band.fft_samples) * float(np.linalg.norm(green)) if single else 0.0
        return values, max(norm, MIN_ROW_NORM)


NodesAt = Callable[[int, int], Nodes]
"""Nodes of a range of samples or path points."""


class Emission(Protocol):
    """A source in time. Samples count from scene time zero."""

    first_sample: int
    """First sample at which something is emitted."""
    stop_event: int
    """One past the last sample at which an event (a sample, or a whole signal) begins."""
    stop_sample: int
    """One past the last sample of the emission."""
    event_samples: int
    """Samples that one event lasts, 1 for a continuous emission."""

    def events(self, start: int, stop: int) -> Events:
        """Events that begin at samples [start, stop), counted from `start`."""

    def piece_spectra(self, fft_samples: int) -> Complex128Array | None:
        """Spectra (pieces, bins) of what begins at an event; None where an event is a sample."""


class ContinuousEmission:
    """A signal that runs on while its source moves (or stands).

    signal, float64 (samples,): Emitted from `first_sample`.
    first_sample: Start of the emission.
    stop_sample: Its end; where the signal is shorter, silence follows.
    nodes_at: Where the source is at samples [start, stop), counted from `first_sample`; a node for each sample, or for
        each point where it stands still for a while.
    focus_sample, int64 (points,): When it comes to those points, counted from scene time zero; without it, `nodes_at`
        is asked for samples.
    """

    event_samples = 1

    def __init__(
        self,
        signal: Float64Array,
        first_sample: int,
        stop_sample: int,
        nodes_at: NodesAt,
        focus_sample: Int64Array | None = None,
    ) -> None:
        self.first_sample = first_sample
        self.stop_sample = stop_sample
        self.signal = signal[: stop_sample - first_sample]
        self.stop_event = first_sample + len(self.signal)
        self._nodes_at = nodes_at
        self._focus: Int64Array | None = None
        if focus_sample is not None:
            # Of several points in one sample the last one counts.
            self._last_point = np.flatnonzero(np.diff(focus_sample, append=stop_sample) > 0)
            self._focus = focus_sample[self._last_point]

    def events(self, start: int, stop: int) -> Events:
        begin, end = start - self.first_sample, stop - self.first_sample
        signal = self.signal[begin:end]
        if self._focus is None:
            return Events(self._nodes_at(begin, end), np.arange(end - begin), signal)
        point = self._last_point[np.searchsorted(self._focus, np.arange(start, stop), side="right") - 1]
        first = int(point[0])
        nodes = self._nodes_at(first, int(point[-1]) + 1)
        point = point - first
        nodes = Nodes(nodes.rows[point], nodes.weights[point], nodes.nearest[point])
        return Events(nodes, np.arange(end - begin), signal)

    def piece_spectra(self, fft_samples: int) -> None:
        return None


class PointEmission:
    """A signal that every path point emits anew, overlapping or not.

    A point is an impulse at its focus sample, and the spectrum of its emission is that of the impulse times
    that of the signal. A long signal is cut into pieces, each of them a signal that starts later, so that a
    block need not hold all of it.

    focus_sample, int64 (points,): Focus instants, ascending; several points may share one.
    nodes_at: Where the path points [start, stop) are.
    piece_samples: Length of a piece, > 0.
    """

    def __init__(self, signal: Float64Array, focus_sample: Int64Array, nodes_at: NodesAt, piece_samples: int) -> None:
        self.event_samples = min(len(signal), piece_samples)
        self.signal = signal
        self.focus_sample = focus_sample
        self.first_sample = int(focus_sample[0])
        self._pieces = [
            signal[begin : begin + self.event_samples] for begin in range(0, len(signal), self.event_samples)
        ]
        self.stop_sample = int(focus_sample[-1]) + len(signal)
        self.stop_event = int(focus_sample[-1]) + (len(self._pieces) - 1) * self.event_samples + 1
        self._nodes_at = nodes_at

    def events(self, start: int, stop: int) -> Events:
        found = []
        for piece in range(len(self._pieces)):
            # Path points whose emission comes to this piece in [start, stop).
            delay = piece * self.event_samples
            first, last = np.searchsorted(self.focus_sample, [start - delay, stop - delay]).tolist()
            nodes, sample = self._nodes_at(first, last), self.focus_sample[first:last] + delay - start
            found.append((nodes.rows, nodes.weights, nodes.nearest, sample, np.full(len(sample), piece)))
        rows, weights, nearest, sample, pieces = (np.concatenate(part) for part in zip(*found, strict=True))
        return Events(Nodes(rows, weights, nearest), sample, np.ones(len(sample)), pieces)

    def piece_spectra(self, fft_samples: int) -> Complex128Array:
        return np.stack([np.fft.rfft(piece, fft_samples) for piece in self._pieces])
