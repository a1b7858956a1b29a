"""What each bank row emits within blocks of a source: weighted values in time, and their spectra.

Values are weighted in time, before their transform: what several regularising rows make of one bank row is
then one window, unless they saturate actuators differently.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.inner_loops import Runs

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Complex128Array = NDArray[np.complex128]

LONG_RUN = 48
"""Runs of so many samples, on average, are copied one by one; shorter ones sample by sample, all at once."""

SIDES: tuple[Literal["left"], Literal["right"]] = ("left", "right")

Weigh = Callable[[Int64Array, Int64Array], tuple[Float64Array, NDArray[np.bool_]]]
"""For pairs of a row and its regularising row, in the order in which they are first needed: the factor, and
whether actuators are saturated."""


@dataclass(frozen=True, slots=True)
class Events:
    """What rows emit, and when.

    Parameters
    ----------
    rows : int64 array, shape (events, k)
        Bank rows that make each event.
    weights : float64 array, shape (events, k)
        Their weights; 0 where a row is not used.
    regularised_by : int64 array, shape (events,)
        Row whose regularisation counts.
    sample : int64 array, shape (events,)
        First sample of each event, from the first block's start.
    length : int64 array, shape (events,)
        Samples that it lasts, > 0.
    values : float64 array, shape (samples,)
        Samples of one event after the other.
    piece : int64 array, shape (events,), optional
        Which piece of a signal each event is convolved with, where it is not an impulse.
    """

    rows: Int64Array
    weights: Float64Array
    regularised_by: Int64Array
    sample: Int64Array
    length: Int64Array
    values: Float64Array
    piece: Int64Array | None = None

    def cut(self, hop: int) -> Events:
        """The same, with events cut where a block ends."""
        if not len(self.sample) or int(self.length.max()) == 1:
            return self
        end = int(self.sample[-1] + self.length[-1])
        sample = np.union1d(self.sample, np.arange(0, end, hop))
        event = np.searchsorted(self.sample, sample, side="right") - 1
        length = np.diff(sample, append=end)
        return Events(
            self.rows[event], self.weights[event], self.regularised_by[event], sample, length, self.values, self.piece
        )


class Windows:
    """Windows of some blocks, ordered by block and then by row.

    Parameters
    ----------
    events : Events
        All that is emitted within the blocks; longer ones follow each other without a gap.
    hop, blocks : int
        Samples from one block to the next, and number of blocks.
    weigh : callable
        Weighs pairs of rows.
    piece_spectra : callable, optional
        Gives the pieces' spectra, (pieces, bins), for a transform length; then events are beginnings of signals.
    """

    block: Int64Array
    """Block of each window, from 0."""
    rows: Int64Array
    """Bank row of each window."""
    regularised_by: Int64Array
    """The row whose sigma each window takes, -1 where no actuator is saturated."""
    quiet: Int64Array
    """How many windows of each block were left out."""
    quiet_errors: Float64Array
    """Bounds on what leaving them out does to a block, over sqrt(2 / fft_samples)."""

    def __init__(
        self,
        events: Events,
        hop: int,
        blocks: int,
        weigh: Weigh,
        piece_spectra: Callable[[int], Complex128Array] | None = None,
    ) -> None:
        self._piece_spectra = piece_spectra
        events = events.cut(hop)
        count, nodes = events.rows.shape
        block = events.sample // hop
        begins, ends, key, span = _runs(events, block)
        pieces = 1 if events.piece is None else int(events.piece.max(initial=0)) + 1
        first, last = begins % max(count, 1), (ends - 1) % max(count, 1)
        earliest = np.argsort(events.sample[first], kind="stable")
        keys, first_run, of_run = np.unique(key[begins][earliest] // pieces, return_index=True, return_inverse=True)
        of_run[earliest] = of_run.copy()
        rows, by = keys // span, keys % span
        order = np.argsort(first_run)
        factors, saturated = np.empty(len(keys)), np.empty(len(keys), dtype=bool)
        factors[order], saturated[order] = weigh(rows[order], by[order])
        pairs, to_pair = np.unique(rows * (span + 1) + np.where(saturated, by + 1, 0), return_inverse=True)
        in_block = block[first] * max(len(pairs), 1) + to_pair[of_run]
        fine, window = np.unique(in_block * pieces + key[begins] % pieces, return_inverse=True)
        merged, self._parts = (
            (fine, np.arange(len(fine))) if pieces == 1 else np.unique(fine // pieces, return_index=True)
        )
        self._piece = fine % pieces
        self.block = merged // max(len(pairs), 1)
        pair = pairs[merged % max(len(pairs), 1)] if len(pairs) else pairs
        self.rows, self.regularised_by = pair // (span + 1), pair % (span + 1) - 1
        # Runs by window and time; their values lie one after the other, node by node.
        start = events.sample[first] - block[first] * hop
        length = events.sample[last] + events.length[last] - events.sample[first]
        offset = np.cumsum(events.length) - events.length
        begin = begins // max(count, 1) * len(events.values) + offset[first]
        by_window = np.lexsort((start, window))
        self._window, self._start = window[by_window], start[by_window]
        self._begin, self._length = begin[by_window], length[by_window]
        self._factor = factors[of_run][by_window]
        self._values = events.values
        if nodes > 1 or (events.weights != 1.0).any():
            each = (
                events.weights.T if len(events.values) == count else np.repeat(events.weights.T, events.length, axis=1)
            )
            self._values = (each * events.values).ravel()
        self.quiet, self.quiet_errors = np.zeros(blocks, dtype=np.int64), np.zeros(blocks)
        goes_on = self._window[1:] == self._window[:-1]
        self._disjoint = not (goes_on & (self._start[1:] < self._start[:-1] + self._length[:-1])).any()

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def of_signals(self) -> bool:
        """Whether instants are at which a whole signal begins, not samples of one that runs on."""
        return self._piece_spectra is not None

    def leave_out_quiet(self, norm_of: Callable[[Int64Array], Float64Array], allowed: float, fft_samples: int) -> None:
        """Leave out windows that make next to nothing of a block: |u * g|_2 <= |u|_1 |g|_2 (Young).

        Parameters
        ----------
        norm_of : callable
            Norms of rows.
        allowed : float
            What the bounds of those left out may add up to in each block, over sqrt(2 / fft_samples).
        fft_samples : int
            Transform length.
        """
        if self.of_signals or not len(self):
            return
        whole = np.append(0.0, np.cumsum(np.abs(self._values)))
        sizes = (whole[self._begin + self._length] - whole[self._begin]) * np.abs(self._factor)
        # The running sum rounds: by so much a difference may be too small.
        sizes += 2.0**-52 * len(whole) * whole[-1] * np.abs(self._factor)
        size = np.bincount(self._window, weights=sizes, minlength=len(self))
        error = size * norm_of(self.rows) * np.sqrt(fft_samples / 2.0)
        order = np.lexsort((error, self.block))
        running = np.cumsum(error[order])
        before = np.append(0.0, running)[np.searchsorted(self.block[order], self.block[order])]
        left_out = np.zeros(len(self), dtype=bool)
        left_out[order] = running - before <= allowed
        if not left_out.any():
            return
        self.quiet += np.bincount(self.block[left_out], minlength=len(self.quiet))
        self.quiet_errors += np.bincount(self.block[left_out], weights=error[left_out], minlength=len(self.quiet))
        number = np.cumsum(~left_out) - 1
        run = ~left_out[self._window]
        for name in ("_window", "_start", "_begin", "_length", "_factor"):
            setattr(self, name, getattr(self, name)[run])
        self._window = number[self._window]
        self.block, self.rows, self.regularised_by = (
            array[~left_out] for array in (self.block, self.rows, self.regularised_by)
        )

    def spans(self, first: int, last: int) -> tuple[Int64Array, Int64Array]:
        """First sample of windows first to last - 1 in their block, and one past the last, of samples of one signal."""
        begin, end = np.searchsorted(self._window, [first, last])
        runs = np.searchsorted(self._window[begin:end], np.arange(first, last))
        start = self._start[begin:end]
        return start[runs], np.maximum.reduceat(start + self._length[begin:end], runs)

    def samples(
        self, chosen: Int64Array, length: int, real: type[Any] = np.float64, shift: Int64Array | None = None
    ) -> NDArray[Any]:
        """Samples of one signal in some windows, (len(chosen), length), from `shift` after their block's start."""
        begin, end = np.searchsorted(self._window, [chosen[0], chosen[-1] + 1])
        place = np.searchsorted(chosen, self._window[begin:end])
        run = np.flatnonzero(chosen[place] == self._window[begin:end]) + begin
        place = place[run - begin]
        count = self._length[run]
        start = self._start[run] if shift is None else self._start[run] - shift[place]
        first, target = self._begin[run], place * length + start
        if count.sum() >= LONG_RUN * len(run):
            dense = np.zeros(len(chosen) * length, dtype=real if self._disjoint else np.float64)
            runs = zip(first.tolist(), target.tolist(), count.tolist(), self._factor[run].tolist(), strict=True)
            for source, begins, samples, factor in runs:
                there, values = dense[begins : begins + samples], self._values[source : source + samples]
                if self._disjoint:
                    np.multiply(values, factor, out=there, casting="same_kind")
                else:
                    there += values * factor
            return dense.astype(real, copy=False).reshape(len(chosen), length)
        before = np.cumsum(count) - count
        number = np.arange(int(count.sum()))
        values = self._values[number + np.repeat(first - before, count)] * np.repeat(self._factor[run], count)
        places = number + np.repeat(target - before, count)
        if self._disjoint:
            dense = np.zeros(len(chosen) * length, dtype=real)
            dense[places] = values
        else:
            dense = np.bincount(places, weights=values, minlength=len(chosen) * length).astype(real, copy=False)
        return dense.reshape(len(chosen), length)

    def runs(self, chosen: Int64Array) -> tuple[Runs, Int64Array] | None:
        """What some windows in ascending order are made of, and their runs, the first and one past the last.

        None where runs of a window meet, or are beginnings of signals.
        """
        if self.of_signals or not self._disjoint:
            return None
        bounds = np.stack([np.searchsorted(self._window, chosen, side) for side in SIDES], axis=1)
        return Runs(self._values, self._begin, self._start, self._length, self._factor), bounds.astype(np.int64)

    def spectra(self, chosen: Int64Array, fft_samples: int) -> Complex128Array:
        """Spectra of some windows in ascending order, (len(chosen), bins), time 0 being their block's start."""
        if self._piece_spectra is None:
            return self._transformed(chosen, fft_samples)
        bounds = np.append(self._parts, len(self._piece))
        count = bounds[chosen + 1] - bounds[chosen]
        first = np.cumsum(count) - count
        parts = np.arange(int(count.sum())) + np.repeat(bounds[chosen] - first, count)
        spectra = self._transformed(parts, fft_samples)
        spectra *= self._piece_spectra(fft_samples)[self._piece[parts]]
        if len(parts) > len(chosen):
            spectra = np.add.reduceat(spectra, first, axis=0)
        return spectra

    def _transformed(self, chosen: Int64Array, fft_samples: int) -> Complex128Array:
        spectra: Complex128Array = scipy_fft.rfft(self.samples(chosen, fft_samples), axis=1, overwrite_x=True)
        return spectra


def _runs(events: Events, block: Int64Array) -> tuple[Int64Array, Int64Array, Int64Array, int]:
    """Runs of events, node by node, that one row emits without a gap within a block.

    Returns
    -------
    begins, ends : int64 array, shape (runs,)
        First event of each, and one past the last, counted through all nodes.
    key : int64 array, shape (nodes x events,)
        (row * span + regularising row) * pieces + piece.
    span : int
    """
    count, nodes = events.rows.shape
    span = int(max(events.rows.max(initial=0), events.regularised_by.max(initial=0))) + 1
    key = (events.rows * span + events.regularised_by[:, None]).T.ravel()
    if events.piece is not None:
        key = key * (int(events.piece.max(initial=0)) + 1) + np.tile(events.piece, nodes)
    if len(events.values) == count:
        loud = events.values != 0
    else:
        loud = np.logical_or.reduceat(events.values != 0, np.cumsum(events.length) - events.length)
    key[~((events.weights != 0) & loud[:, None]).T.ravel()] = -1
    follows = (events.sample[1:] == events.sample[:-1] + events.length[:-1]) & (block[1:] == block[:-1])
    goes_on = np.diff(key) == 0
    goes_on &= np.tile(np.append(follows, False), nodes)[: len(goes_on)]
    begins = np.concatenate([np.zeros(min(count, 1), dtype=np.int64), np.flatnonzero(~goes_on) + 1])
    ends = np.append(begins[1:], len(key))[: len(begins)]
    used = key[begins] >= 0
    return begins[used], ends[used], key, span
