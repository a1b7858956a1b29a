"""Emissions: what a source emits in time, block by block, and from which rows (docs/reference/scene-file.md)."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.drive.windows import Events

NodesAt = Callable[[int, int], tuple[Int64Array, Float64Array, Int64Array]]
"""Rows (n, k), weights (n, k) and regularising rows (n,) of a range of samples or path points."""


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
            return Events(*self._nodes_at(begin, end), np.arange(end - begin), signal)
        point = self._last_point[np.searchsorted(self._focus, np.arange(start, stop), side="right") - 1]
        first = int(point[0])
        rows, weights, by = self._nodes_at(first, int(point[-1]) + 1)
        point = point - first
        return Events(rows[point], weights[point], by[point], np.arange(end - begin), signal)

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
        found = [self._piece_events(piece, start, stop) for piece in range(len(self._pieces))]
        rows, weights, by, sample = (np.concatenate(part) for part in zip(*found, strict=True))
        piece = np.repeat(np.arange(len(found)), [len(entry[3]) for entry in found])
        return Events(rows, weights, by, sample, np.ones(len(sample)), piece)

    def _piece_events(
        self, piece: int, start: int, stop: int
    ) -> tuple[Int64Array, Float64Array, Int64Array, Int64Array]:
        """Nodes and samples of path points whose emission comes to this piece in [start, stop)."""
        delay = piece * self.event_samples
        first, last = np.searchsorted(self.focus_sample, [start - delay, stop - delay])
        return *self._nodes_at(int(first), int(last)), self.focus_sample[first:last] + delay - start

    def piece_spectra(self, fft_samples: int) -> Complex128Array:
        return np.stack([np.fft.rfft(piece, fft_samples) for piece in self._pieces])
