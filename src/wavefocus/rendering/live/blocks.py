"""Blocks of drives, computed anew from what sources emit, as far as it is certain or predicted now.

A drive sample n is made of the source samples n to n + L - 1, L the bank's taps (eq. 9, with p(s) the place of the
source at sample s):

    f_i[n] = sum_s u[s] g_i(p(s))[s - n]

At frequency k of a transform of all of these samples that is F_i = sum_r U_r conj(G_ir), U_r the transform of what is
emitted at the places of row r. It is evaluated only at the frequencies of the bank's band, with a margin, since rows
have next to nothing elsewhere. Samples before n, which have no effect on it, let the sum begin smoothly. The drives at
the instants t of the interface's samples are one product with a fixed matrix:

    f_i(t) = 2 / K sum_k Re F_i[k] exp(2 pi i k t / K)      (half of it for k = 0 and k = K / 2)

Independent sources (`wavefocus.rendering.live.finer`) have filters of their own in place of conj(G). They last
longer: `EXTENSION_S` of source samples more are taken at either end. A filter is made for the places of all sources at
one instant, and serves samples around it, weighted by a hat: every `HAT_S`; where places are predicted, the first one
serves all samples after it.

Four blocks are computed at once. Where an order changes a course the next block is computed anew, and crossfaded with
what the computation before gave for it, so that a prediction that did not come true makes no click. Where nothing
changes, both are the same numbers, and the second and the third block are taken as they are.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.band import power_over
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.greens.interpolation.base import Nodes
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import usable
from wavefocus.rendering.live.finer import Complex64Array, FinerRows, independent_filters
from wavefocus.rendering.live.lives import Life, runs_of
from wavefocus.storage.errors import InputError

CACHE_BYTES = 2**30
"""Memory of row spectra: 1500 positions of 20 actuators, 500 Hz and 200 ms take 4 % of it."""
HAT_S, EXTENSION_S = 0.02, 0.02
"""Sources are quiet where the others are at the instant of a hat, and where they are at those before and after."""
AT_ONCE = 4
"""Blocks computed at once: the one that is due, two that stand where no order comes, and one to fade from."""

WeightedRows = tuple[tuple[int, float], ...]
"""Rows of a place, and their weights."""
Piece = tuple[int, Float64Array, float | Float64Array]
"""Part of what is emitted through a filter: its first sample in the window, values, and a factor or a factor each."""


class CrossfadedBlocks:
    """Blocks of drives, one after the other.

    rows: Rows of the bank, and how they are regularised.
    block_samples: Samples of a block at the bank's rate, B.
    frame_rate_hz: Rate of the blocks that come out.
    nodes_at: Rows and weights of places, float64 (n, 2) in millimetres.
    independent: Whether each source is quiet where the others are.
    finer: Rows between the bank's, where places have some; `load_finer` makes their filters.
    """

    window_samples: int
    """Source samples that a computation takes from the block's first one on: L - 1 + 4 B, and the extension."""
    extension_samples: int
    """Those before it."""
    memory_samples: int
    """A block depends on places until so many samples before it."""

    def __init__(
        self,
        rows: BankRows,
        block_samples: int,
        frame_rate_hz: float,
        nodes_at: Callable[[Float64Array], Nodes],
        *,
        independent: bool = False,
        finer: FinerRows | None = None,
    ) -> None:
        import scipy.fft  # several times as fast in single precision as NumPy's

        self._rfft = scipy.fft.rfft
        bank, rate_hz = rows.bank, float(rows.bank.sample_rate_hz)
        self._rows, self._block_samples, self._nodes_at = rows, block_samples, nodes_at
        self._frames_per_sample = Fraction(frame_rate_hz) / Fraction(rate_hz)
        self.bounded = False
        """Whether the bound of the energy of independent sources acted in the last block that was computed."""
        self._independent, self._finer = independent, finer
        self._between: Complex64Array | None = None
        extension = round(EXTENSION_S * rate_hz) if independent else 0
        # What is emitted before a block has no effect on it, except that a sudden begin has frequencies beyond the
        # band.
        ramp = round(0.02 * rate_hz)
        self._ramp = np.sin(np.pi / 2 * (np.arange(ramp) + 0.5) / max(ramp, 1)).astype(np.float32) ** 2
        self.extension_samples = ramp + extension
        self.window_samples = bank.taps - 1 + AT_ONCE * block_samples + extension
        self._fft_samples = fast_length(self.extension_samples + self.window_samples)
        top_hz = min(rate_hz, frame_rate_hz) / 2.0
        self._bins = math.floor(top_hz * self._fft_samples / rate_hz + 1e-9) + 1
        self._bins = min(self._bins, self._bins_of_band())
        self._synthesis = self._synthesis_matrix()
        self._hat = max(1, round(HAT_S * rate_hz))
        self.memory_samples = self.extension_samples + (2 * self._hat if independent else 0)
        self.most_rows = max(1, CACHE_BYTES // (8 * self._bins * bank.actuators))
        """Rows whose spectra are kept in memory."""
        if finer is not None and finer.count > self.most_rows:
            raise InputError(
                f"the {finer.count} rows between the positions that the interpolation makes do not fit into"
                f" {CACHE_BYTES / 2**30:g} GiB; use 'nearest'"
            )
        self._row_filter = lru_cache(self.most_rows)(self._make_row_filter)
        # Instants whose independent filters are kept: those of four sources take 0.1 MB, and a block has about ten.
        self._filters = lru_cache(64)(self._make_filters)
        self._gain = lru_cache(None)(self._make_gain)
        self._ahead: Float64Array = np.zeros((bank.actuators, self._frame(block_samples)))
        """What the last computation gave for the blocks to come."""

    def _bins_of_band(self) -> int:
        """Number of bins that hold what rows have."""
        bank, whole = self._rows.bank, self._fft_samples // 2 + 1
        if bank.band_hz is None:
            return whole
        usable_rows, power = np.flatnonzero(usable(bank)), np.zeros(whole)
        for row in usable_rows[np.linspace(0, len(usable_rows) - 1, 16).astype(np.int64)].tolist():
            with suppress(InputError):  # it matters only where a source comes near
                power += power_over(np.fft.rfft(self._rows.read(row), n=self._fft_samples, axis=1), axis=0)
        # Frequencies are computed up to the first of these multiples of the upper end of the bank's band that leaves
        # out at most a thousandth of the energy of these rows; all of them where none does.
        for margin in (1.2, 1.5, 2.0):
            bins = math.floor(margin * bank.band_hz[1] / float(bank.sample_rate_hz) * self._fft_samples) + 1
            if power[bins:].sum() <= 1e-3 * power.sum():
                return min(bins, whole)
        return whole

    def load_finer(self) -> None:
        """Make the filters of finer rows, where there are any."""
        if self._finer is not None:
            bin_hz = np.arange(self._bins, dtype=np.float64)
            bin_hz *= float(self._rows.bank.sample_rate_hz) / self._fft_samples
            self._between = self._finer.filters(lambda row: self._row_filter(row, -1), bin_hz)

    def load(self, row: int) -> None:
        """Read and transform a row. Raises InputError: it may not be used."""
        self._row_filter(row, -1)

    def next(self, lives: Iterable[Life], first: int, due: int) -> Float64Array:
        """Compute a block, float64 (actuators, frames), in volts; infinite or NaN where it does not fit into numbers.

        lives: What sounds.
        first, due: The block's first sample; the sample from which on places are predicted.
        """
        begin, stop = first - self.extension_samples, first + self.window_samples
        heard = [life for life in lives if life.begin < stop and life.end >= begin]
        emitted = self._mixed(heard, begin, stop, due) if self._independent else self._plain(heard, begin, stop)
        size, frames = self._frames(first, 1), self._frames(first, AT_ONCE)
        computed = np.zeros((len(self._ahead), frames))
        if emitted:
            computed = self._computed(emitted, first, frames)
        rise = (np.arange(size) + 0.5) / size
        block = computed[:, :size] * rise
        block += self._ahead[:, :size] * (1.0 - rise)
        self._ahead = computed[:, size:]
        return block

    def foreseen(self, first: int) -> bool:
        """Whether the block from this sample on was computed with the last one, and one to fade from after it."""
        return bool(self._ahead.shape[1] > self._frames(first, 1))

    def unchanged(self, first: int) -> Float64Array:
        """The next block where it is `foreseen`, and no course has changed since the last one."""
        size = self._frames(first, 1)
        block, self._ahead = self._ahead[:, :size].copy(), self._ahead[:, size:]
        return block

    def _frames(self, first: int, blocks: int) -> int:
        """Number of frames of so many blocks from a sample on."""
        return self._frame(first + blocks * self._block_samples) - self._frame(first)

    def _frame(self, sample: int) -> int:
        """Number of the first frame not before a sample."""
        return math.ceil(sample * self._frames_per_sample)

    def _plain(self, lives: Sequence[Life], first: int, stop: int) -> list[tuple[Complex64Array, list[Piece]]]:
        """What is emitted through the filter of each row, and each saturation of it."""
        emitted: dict[tuple[int, int], list[Piece]] = {}
        spans = [(max(first, life.begin), min(stop, life.end + 1)) for life in lives]
        values = [life.values(*span) for life, span in zip(lives, spans, strict=True)]
        for run in runs_of(lives, self._nodes_at, first, stop) if lives else ():
            since, until = spans[run.life]
            begin, end = max(since, run.begin), min(until, run.end)
            if begin >= end:
                continue
            part = values[run.life][begin - since : end - since]
            gain, saturated_by = self._gain(run.nearest)
            steady = run.weights.shape[1] == 1
            for row, weights in zip(run.rows, run.weights, strict=True):
                factor = gain * (float(weights[0]) if steady else weights[begin - run.begin : end - run.begin])
                if not steady or factor:
                    emitted.setdefault((row, saturated_by), []).append((begin - first, part, factor))
        return [(self._row_filter(*row), pieces) for row, pieces in emitted.items()]

    def _mixed(
        self, lives: Sequence[Life], first: int, stop: int, due: int
    ) -> list[tuple[Complex64Array, list[Piece]]]:
        """What is emitted through the filter of each source around the instant of each hat."""
        self.bounded = False
        if not lives:
            return []
        instants = [first // self._hat * self._hat - self._hat]
        while instants[-1] <= due and instants[-1] < stop:
            instants.append(instants[-1] + self._hat)
        if instants[-1] < stop:
            instants.append(stop)
        at = np.array(instants)
        places = self._places([life.course.at(np.clip(at, life.begin, life.end))[0] for life in lives])
        emitted: list[tuple[Complex64Array, list[Piece]]] = []
        values = [life.values(max(first, life.begin), min(stop, life.end + 1)) for life in lives]
        for index in range(1, len(instants) - 1):
            hat = instants[index - 1 : index + 2]
            there = [number for number, life in enumerate(lives) if life.begin < hat[2] and life.end > hat[0]]
            predicted = hat[1] > due
            share = _hat_weights(hat[1] - hat[0], hat[2] - hat[1], last=predicted)
            # Where places are predicted, those before and after are no better known.
            # Where there would be more, those before and after are left out.
            counted = (0,) if predicted or 3 * len(there) > 24 else (0, -1, 1)
            own = tuple(tuple(places[number][index + other][0] for other in counted) for number in there)
            weights = [self._gain(places[number][index][1]) for number in there]
            filters = self._filters(own, tuple(by for _, by in weights)) if own else ()
            for number, (row_filter, bounded), (gain, _) in zip(there, filters, weights, strict=True):
                life = lives[number]
                begin, end = max(first, life.begin, hat[0]), min(stop, life.end + 1, hat[2])
                since = max(first, life.begin)
                loud = values[number][begin - since : end - since] * share[begin - hat[0] : end - hat[0]]
                if loud.any():
                    self.bounded |= bounded
                    emitted.append((row_filter, [(begin - first, loud, gain)]))
        return emitted

    def _places(self, at_mm: Sequence[Float64Array]) -> list[list[tuple[WeightedRows, int]]]:
        """Weighted rows, and nearest rows, of places of lives."""
        nodes = self._nodes_at(np.concatenate(at_mm))
        rows, weights, nearest = nodes.rows.tolist(), nodes.weights.tolist(), nodes.nearest.tolist()
        known = [
            (tuple((row, weight) for row, weight in zip(*pair, strict=True) if weight), by)
            for *pair, by in zip(rows, weights, nearest, strict=True)
        ]
        count = len(at_mm[0])
        return [known[begin : begin + count] for begin in range(0, len(known), count)]

    def _computed(self, emitted: Sequence[tuple[Complex64Array, list[Piece]]], first: int, frames: int) -> Float64Array:
        """Drives at the next frames, (actuators, frames)."""
        windows = np.zeros((len(emitted), self._fft_samples), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for window, (_, pieces) in zip(windows, emitted, strict=True):
                for begin, values, factor in pieces:
                    window[begin : begin + len(values)] += values * factor
            windows[:, : len(self._ramp)] *= self._ramp
            spectra = self._rfft(windows, axis=1)[:, : self._bins]
            total = np.zeros((self._rows.bank.actuators, self._bins), dtype=np.complex64)
            product = np.empty_like(total)
            for (row_filter, _), spectrum in zip(emitted, spectra, strict=True):
                np.multiply(row_filter, spectrum, out=product)
                total += product
            late = float(self._frame(first) / self._frames_per_sample - first)
            if late:
                total *= np.exp(2j * np.pi / self._fft_samples * late * np.arange(self._bins)).astype(np.complex64)
            return np.asarray(total.view(np.float32) @ self._synthesis[:, :frames], dtype=np.float64)

    def _synthesis_matrix(self) -> NDArray[np.float32]:
        """From real and imaginary parts of bins, one after the other, to the frames of blocks."""
        frames = math.ceil(AT_ONCE * self._block_samples * self._frames_per_sample) + 1
        sample = self.extension_samples + np.arange(frames) / float(self._frames_per_sample)
        bins = np.arange(self._bins)
        turns = np.exp(2j * np.pi / self._fft_samples * bins[:, None] * sample) * (2.0 / self._fft_samples)
        turns[(bins == 0) | (2 * bins == self._fft_samples)] /= 2.0
        return np.stack([turns.real, -turns.imag], axis=1).reshape(2 * self._bins, frames).astype(np.float32)

    def _make_row_filter(self, row: int, saturated_by: int) -> Complex64Array:
        if saturated_by >= 0:
            sigma = self._rows.sigma(saturated_by)
            assert sigma is not None
            return np.asarray(self._row_filter(row, -1) * sigma[:, None].astype(np.float32))
        if row >= self._rows.bank.positions:
            if self._between is None:
                self.load_finer()
            assert self._between is not None
            return np.asarray(self._between[row - self._rows.bank.positions])
        spectra = np.fft.rfft(self._rows.read(row), n=self._fft_samples, axis=1)[:, : self._bins]
        return np.asarray(spectra.conj(), dtype=np.complex64)

    def _make_filters(
        self, own: tuple[tuple[WeightedRows, ...], ...], saturated_by: tuple[int, ...]
    ) -> list[tuple[Complex64Array, bool]]:
        """Filters of sources that are independent, and whether their energy is bounded.

        By the places of each, and the row that saturates it, or -1.
        """
        places = {place: index for index, place in enumerate(dict.fromkeys(place for mine in own for place in mine))}
        green = np.array([self._at(place, -1) for place in places]).conj()
        plain = np.array([self._at(mine[0], by) for mine, by in zip(own, saturated_by, strict=True)])
        filters, bounded = independent_filters(green, [[places[place] for place in mine] for mine in own], plain)
        # Share of the frequencies from which on it is worth saying that the bound of the energy acts.
        return list(zip(filters, (bounded.mean(axis=1) > 0.1).tolist(), strict=True))

    def _at(self, place: WeightedRows, saturated_by: int) -> Complex64Array:
        """Filters of time reversal at a place, (actuators, bins)."""
        if len(place) == 1 and place[0][1] == 1.0:
            return self._row_filter(place[0][0], saturated_by)
        return np.asarray(sum(weight * self._row_filter(row, saturated_by) for row, weight in place))

    def _make_gain(self, row: int) -> tuple[float, int]:
        """n(x) of a row, and the row itself where it saturates, else -1."""
        (gain,), (saturated,) = self._rows.weigh(np.array([row]))
        return float(gain), row if saturated else -1


@lru_cache(64)
def _hat_weights(rise: int, fall: int, *, last: bool) -> Float64Array:
    """Weights of the samples of a hat, 1 at its instant, of the last one also after it, (rise + fall,)."""
    falling = np.ones(fall) if last else np.linspace(1.0, 0.0, fall, endpoint=False)
    return np.concatenate([np.linspace(0.0, 1.0, rise, endpoint=False), falling])
