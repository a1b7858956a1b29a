"""A source cut into windows: what each bank row emits within a block of samples.

Windows are weighted in time, before their transform: what several regularising rows make of one bank row is
then one window, unless they saturate actuators differently.
"""

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

SAMPLES_AT_ONCE = 64 * 4096
"""Bounds the memory of a block: windows of so many samples and their spectra are 4 MB."""

NodesAt = Callable[[int, int], tuple[Int64Array, Float64Array, Int64Array]]
"""Rows (n, k), weights (n, k) and regularising rows (n,) of a range of samples or path points."""
Weigh = Callable[[Int64Array, Int64Array], tuple[Float64Array, NDArray[np.bool_]]]
"""For pairs of a row and its regularising row: the factor, and whether actuators are saturated."""


@dataclass(frozen=True, slots=True)
class Windows:
    """Spectra of what some rows emit within one block.

    Parameters
    ----------
    rows : int64 array, shape (windows,)
        Bank rows, ascending.
    regularised_by : int64 array, shape (windows,)
        The row whose sigma each window takes, -1 where no actuator is saturated.
    spectra : complex128 array, shape (windows, bins)
        Spectra, weighted, over 2**exponent of the emission; time 0 is the block's first sample.
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
    exponent: int
    """The signal is emitted over 2**exponent, so that its largest value is about 1."""

    def windows(self, start: int, stop: int, fft_samples: int, weigh: Weigh) -> Iterator[Windows]:
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
        self.exponent = _exponent(self.signal)
        self.stop_event = first_sample + len(self.signal)
        self._nodes_at = nodes_at

    def windows(self, start: int, stop: int, fft_samples: int, weigh: Weigh) -> Iterator[Windows]:
        stop = min(stop, self.stop_event)
        if stop <= start:
            return
        signal = np.ldexp(self.signal[start - self.first_sample : stop - self.first_sample], -self.exponent)
        rows, weights, regularised_by = self._nodes_at(start - self.first_sample, stop - self.first_sample)
        # Node by node: along one, neighbouring samples share their row.
        values = (signal[:, None] * weights).T.ravel()
        time = np.tile(np.arange(stop - start), rows.shape[1])
        pairs = _Pairs(rows.T.ravel(), np.tile(regularised_by, rows.shape[1]), values, time, weigh)
        for part in pairs.parts(fft_samples):
            spectra = scipy_fft.rfft(part.scattered(fft_samples), axis=1, overwrite_x=True)
            yield Windows(part.rows, part.regularised_by, spectra)


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
        self.exponent = _exponent(signal)
        self._pieces = [
            np.ldexp(signal[begin : begin + self.event_samples], -self.exponent)
            for begin in range(0, len(signal), self.event_samples)
        ]
        self.stop_sample = int(focus_sample[-1]) + len(signal)
        self.stop_event = int(focus_sample[-1]) + (len(self._pieces) - 1) * self.event_samples + 1
        self._nodes_at = nodes_at
        self._piece_spectra: ComplexArray | None = None

    def windows(self, start: int, stop: int, fft_samples: int, weigh: Weigh) -> Iterator[Windows]:
        pieces = self._piece_spectra
        if pieces is None or pieces.shape[1] != fft_samples // 2 + 1:
            pieces = np.stack([scipy_fft.rfft(piece, fft_samples) for piece in self._pieces])
            self._piece_spectra = pieces
        for part in self._events(start, stop, weigh, fft_samples):
            spectra = np.zeros((part.count, fft_samples // 2 + 1), dtype=np.complex128)
            for piece in np.unique(part.piece).tolist():
                impulses = part.scattered(fft_samples, piece)
                spectra += scipy_fft.rfft(impulses, axis=1, overwrite_x=True) * pieces[piece]
            yield Windows(part.rows, part.regularised_by, spectra)

    def _events(self, start: int, stop: int, weigh: Weigh, fft_samples: int) -> Iterator[_Part]:
        """Every (point, piece) that begins in [start, stop), by windows."""
        found = []
        for piece in range(len(self._pieces)):
            delay = piece * self.event_samples
            first, last = np.searchsorted(self.focus_sample, [start - delay, stop - delay])
            if last > first:
                rows, weights, regularised_by = self._nodes_at(int(first), int(last))
                time = self.focus_sample[first:last] + delay - start
                nodes = rows.shape[1]
                found.append((rows, regularised_by, weights, time, np.full(rows.size, piece), nodes))
        if found:
            yield from _Pairs(
                np.concatenate([entry[0].T.ravel() for entry in found]),
                np.concatenate([np.tile(entry[1], entry[5]) for entry in found]),
                np.concatenate([entry[2].T.ravel() for entry in found]),
                np.concatenate([np.tile(entry[3], entry[5]) for entry in found]),
                weigh,
                np.concatenate([entry[4] for entry in found]),
            ).parts(fft_samples)


@dataclass(frozen=True, slots=True)
class _Part:
    """Values of some windows, each with its window, its time and the piece of the signal it is for."""

    rows: Int64Array
    regularised_by: Int64Array
    window: Int64Array
    values: Float64Array
    time: Int64Array
    piece: Int64Array

    @property
    def count(self) -> int:
        return len(self.rows)

    def scattered(self, fft_samples: int, piece: int = 0) -> Float64Array:
        """Windows in time, (windows, fft_samples); values that share window and time add up."""
        window, time, values = self.window, self.time, self.values
        if len(self.piece):
            chosen = self.piece == piece
            window, time, values = window[chosen], time[chosen], values[chosen]
        flat: Float64Array = np.bincount(
            window * fft_samples + time, weights=values, minlength=self.count * fft_samples
        )  # type: ignore[assignment]
        return flat.reshape(self.count, fft_samples)


class _Pairs:
    """Emitted values, weighted and gathered by row and, where actuators are saturated, by regularising row."""

    def __init__(
        self,
        rows: Int64Array,
        regularised_by: Int64Array,
        values: Float64Array,
        time: Int64Array,
        weigh: Weigh,
        piece: Int64Array | None = None,
    ) -> None:
        used = values != 0
        rows, regularised_by, values = rows[used], regularised_by[used], values[used]
        span = int(max(rows.max(initial=0), regularised_by.max(initial=0))) + 1
        # Only where a run of equal keys begins is there anything to sort.
        key = rows * span + regularised_by
        begins = np.flatnonzero(np.diff(key, prepend=-1))
        keys, window = np.unique(key[begins], return_inverse=True)
        rows, regularised_by = keys // span, keys % span
        factors, saturated = weigh(rows, regularised_by)
        merged, to_merged = np.unique(
            rows * (span + 1) + np.where(saturated, regularised_by + 1, 0), return_inverse=True
        )
        lengths = np.diff(begins, append=len(values))
        self._rows, self._regularised_by = merged // (span + 1), merged % (span + 1) - 1
        self._window: Int64Array = np.repeat(to_merged[window], lengths)
        self._values: Float64Array = values * np.repeat(factors[window], lengths)
        self._time = time[used]
        self._piece = np.zeros(0, dtype=np.int64) if piece is None else piece[used]

    def parts(self, fft_samples: int) -> Iterator[_Part]:
        """Windows a few at a time, rows ascending."""
        at_once = max(1, SAMPLES_AT_ONCE // fft_samples)
        for first in range(0, len(self._rows), at_once):
            last = min(first + at_once, len(self._rows))
            chosen: slice | NDArray[np.bool_] = slice(None)
            if len(self._rows) > at_once:
                chosen = (self._window >= first) & (self._window < last)
            yield _Part(
                self._rows[first:last],
                self._regularised_by[first:last],
                self._window[chosen] - first,
                self._values[chosen],
                self._time[chosen],
                self._piece[chosen] if len(self._piece) else self._piece,
            )


def _exponent(signal: Float64Array) -> int:
    return int(np.frexp(max(signal.max(initial=0.0), -signal.min(initial=0.0)))[1])
