"""A source cut into windows: what each bank row emits within a block of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

Float64Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Int64Array = NDArray[np.int64]

WINDOWS_AT_ONCE = 64
"""Bounds the memory of a block: 64 windows of 4096 samples and their spectra are 4 MB."""

NodesAt = Callable[[int, int], tuple[Int64Array, Float64Array, Int64Array]]
"""Rows (n, k), weights (n, k) and regularising rows (n,) of a range of samples or path points."""


@dataclass(frozen=True, slots=True)
class Windows:
    """Spectra of what some rows emit within one block.

    Parameters
    ----------
    rows : int64 array, shape (windows,)
        Bank rows, ascending.
    regularised_by : int64 array, shape (windows,)
        The row whose sigma and n each window takes.
    spectra : complex128 array, shape (windows, bins)
        Spectra; time 0 is the block's first sample.
    """

    rows: Int64Array
    regularised_by: Int64Array
    spectra: ComplexArray


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

    def windows(self, start: int, stop: int, fft_samples: int) -> Iterator[Windows]:
        """Windows of the events that begin in [start, stop), a few at a time."""
        ...


class ContinuousEmission:
    """A signal that runs on while its source moves (or stands).

    Parameters
    ----------
    signal : float64 array, shape (samples,)
        What is emitted, from `first_sample`.
    first_sample : int
        Start of the emission.
    stop_sample : int
        Its end; where the signal is shorter, silence follows.
    nodes_at : callable
        Where the source is at samples [start, stop), counted from `first_sample`.
    """

    event_samples = 1

    def __init__(self, signal: Float64Array, first_sample: int, stop_sample: int, nodes_at: NodesAt) -> None:
        self.first_sample = first_sample
        self.stop_sample = stop_sample
        self.signal = signal[: stop_sample - first_sample]
        self.stop_event = first_sample + len(self.signal)
        self._nodes_at = nodes_at

    def windows(self, start: int, stop: int, fft_samples: int) -> Iterator[Windows]:
        stop = min(stop, self.stop_event)
        if stop <= start:
            return
        signal = self.signal[start - self.first_sample : stop - self.first_sample]
        rows, weights, regularised_by = self._nodes_at(start - self.first_sample, stop - self.first_sample)
        values = signal[:, None] * weights
        time = np.broadcast_to(np.arange(stop - start)[:, None], rows.shape)
        pairs = _Pairs(rows, np.broadcast_to(regularised_by[:, None], rows.shape), values, time)
        for part in pairs.parts():
            window = np.zeros((part.count, fft_samples))
            window[part.window, part.time] = part.values
            yield Windows(part.rows, part.regularised_by, scipy_fft.rfft(window, axis=1, overwrite_x=True))


class PointEmission:
    """A signal that every path point emits anew, overlapping or not.

    A point is an impulse at its focus sample, and the spectrum of its emission is that of the impulse times
    that of the signal. A long signal is cut into pieces, each of them a signal that starts later, so that a
    block need not hold all of it.

    Parameters
    ----------
    signal : float64 array, shape (samples,)
        The signal.
    focus_sample : int64 array, shape (points,)
        Focus instants, ascending; several points may share one.
    nodes_at : callable
        Where the path points [start, stop) are.
    piece_samples : int
        Length of a piece, > 0.
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
        self._piece_spectra: ComplexArray | None = None

    def windows(self, start: int, stop: int, fft_samples: int) -> Iterator[Windows]:
        pairs = self._events(start, stop)
        if pairs is None:
            return
        if self._piece_spectra is None or self._piece_spectra.shape[1] != fft_samples // 2 + 1:
            self._piece_spectra = np.stack([scipy_fft.rfft(piece, fft_samples) for piece in self._pieces])
        for part in pairs.parts():
            spectra = np.zeros((part.count, fft_samples // 2 + 1), dtype=np.complex128)
            for piece in np.unique(part.piece):
                chosen = part.piece == piece
                windows, inverse = np.unique(part.window[chosen], return_inverse=True)
                impulses = np.zeros((len(windows), fft_samples))
                np.add.at(impulses, (inverse, part.time[chosen]), part.values[chosen])
                spectra[windows] += scipy_fft.rfft(impulses, axis=1) * self._piece_spectra[piece]
            yield Windows(part.rows, part.regularised_by, spectra)

    def _events(self, start: int, stop: int) -> _Pairs | None:
        """Every (point, piece) that begins in [start, stop)."""
        found = []
        for piece in range(len(self._pieces)):
            delay = piece * self.event_samples
            first, last = np.searchsorted(self.focus_sample, [start - delay, stop - delay])
            if last > first:
                rows, weights, regularised_by = self._nodes_at(int(first), int(last))
                time = self.focus_sample[first:last] + delay - start
                found.append((rows, regularised_by, weights, time, piece))
        if not found:
            return None
        shape = [entry[0].shape for entry in found]
        return _Pairs(
            np.concatenate([entry[0] for entry in found]),
            np.concatenate([np.broadcast_to(entry[1][:, None], entry[0].shape) for entry in found]),
            np.concatenate([entry[2] for entry in found]),
            np.concatenate([np.broadcast_to(entry[3][:, None], entry[0].shape) for entry in found]),
            np.concatenate([np.full(size, entry[4]) for entry, size in zip(found, shape, strict=True)]),
        )


@dataclass(frozen=True, slots=True)
class _Part:
    rows: Int64Array
    regularised_by: Int64Array
    window: Int64Array
    values: Float64Array
    time: Int64Array
    piece: Int64Array

    @property
    def count(self) -> int:
        return len(self.rows)


class _Pairs:
    """Emitted values, gathered by (row, regularising row)."""

    def __init__(
        self,
        rows: Int64Array,
        regularised_by: Int64Array,
        values: Float64Array,
        time: Int64Array,
        piece: Int64Array | None = None,
    ) -> None:
        used = values != 0
        rows, regularised_by = rows[used], regularised_by[used]
        span = int(max(rows.max(initial=0), regularised_by.max(initial=0))) + 1
        keys, window = np.unique(rows * span + regularised_by, return_inverse=True)
        order = np.argsort(window, kind="stable")
        self._rows, self._regularised_by = keys // span, keys % span
        self._window = window[order]
        self._values = values[used][order]
        self._time = time[used][order]
        self._piece = np.zeros(len(order), dtype=np.int64) if piece is None else piece[used][order]

    def parts(self) -> Iterator[_Part]:
        for first in range(0, len(self._rows), WINDOWS_AT_ONCE):
            last = min(first + WINDOWS_AT_ONCE, len(self._rows))
            begin, end = np.searchsorted(self._window, [first, last])
            chosen = slice(begin, end)
            yield _Part(
                self._rows[first:last],
                self._regularised_by[first:last],
                self._window[chosen] - first,
                self._values[chosen],
                self._time[chosen],
                self._piece[chosen],
            )
