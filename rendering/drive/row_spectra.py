"""Spectra of bank rows, transformed when they are first asked for and kept while there is room."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.omission import Economy
from rendering.drive.row_pages import RowPage, RowsView, add_up_actuators
from rendering.drive.truncation import RowCut
from rendering.field.product_bounds import SpectrumSizes
from rendering.greens.bank_rows import BankRows
from rendering.inner_loops import InnerLoops, RowTransform, inner_loops, transformable
from rendering.reused_memory import reused
from rendering.shared_work import shares
from rendering.threads import WORKERS, AtOnce

CACHE_BYTES = 384 * 2**20
"""Most memory of spectra that are kept, beside pages that have gone and are still multiplied."""
PAGE_BYTES = 16 * 2**20
"""Rows lie together in pages of at most so many bytes, which go all at once."""
LEAST_ROWS = 16
"""Room is made for at least so many rows."""
GROUP_BYTES = 5 * 2**18
"""Rows of so many bytes are transformed together, within the cache of one core."""
AHEAD = 4
"""Groups that are being transformed while another one is read."""
CHUNK = 16
"""Most rows that compiled loops transform at a time: Python's lock, which others may hold, is waited for in between."""
CHUNKS_AHEAD = 8
"""Most of these that are under way."""
FEW = 4
"""So many rows take less time than it takes a thread to wake up."""


@dataclass(frozen=True, slots=True)
class _Begun:
    """Rows that are being transformed: how many chunks came before, where they go, and what tells their sizes."""

    number: int
    places: Sequence[tuple[RowPage, int]]
    squares: Future[NDArray[np.float32]]


class RowSpectra:
    """Transforms of time-reversed, scaled rows.

    Backwards in time a row has the conjugate spectrum; it ends at time 0.

    Rows get places in the order in which they are first asked for: what a path visits lies side by side.

    Parameters
    ----------
    rows : BankRows
        Where rows are read.
    cut : RowCut
        What of each row to use.
    fft_samples : int
        Transform length.
    economy : Economy
        Precision, and which bins to keep.
    workers : Executor
        Transforms groups of rows.
    looked_at : RowSpectra, optional
        Some of the rows in all bins, in the same precision.
    expected_rows : int
        About how many rows will be asked for.
    """

    def __init__(
        self,
        rows: BankRows,
        cut: RowCut,
        fft_samples: int,
        economy: Economy,
        workers: Executor,
        looked_at: RowSpectra | None = None,
        expected_rows: int = 0,
    ) -> None:
        self.economy = economy
        self._looked_at = looked_at
        self._rows = rows
        self._cut = cut
        self._fft_samples = fft_samples
        self._workers = workers
        self._actuators = actuators = len(cut.actuators)
        row_bytes = actuators * economy.kept * np.dtype(economy.complex).itemsize
        self._most = max(LEAST_ROWS, CACHE_BYTES // row_bytes)
        self._page_rows = max(1, PAGE_BYTES // row_bytes)
        self._group = max(1, GROUP_BYTES // (actuators * fft_samples * np.dtype(economy.real).itemsize))
        self._expected = expected_rows
        self._workspace: list[NDArray[Any]] = []
        self._place: dict[int, tuple[RowPage, int]] = {}
        self._pages: list[RowPage] = []
        self._loops = inner_loops() if economy.single and transformable(fft_samples) else None
        self._begun = 0
        self._under_way: deque[_Begun] = deque()
        self._squares: dict[tuple[RowPage, int], NDArray[np.float32]] = {}

    def prepare(self, rows: Sequence[int]) -> None:
        """Transform those of some rows that are not there yet. Raises InputError where one may not be used.

        At most `most_rows` rows; earlier ones may have to go.
        """
        missing = [row for row in dict.fromkeys(rows) if row not in self._place]
        if not missing:
            return
        if not self._make_room(len(missing), rows):
            missing = list(dict.fromkeys(rows))
        for page, some in self._placed(missing):
            first = page.taken - len(some)
            self._place.update({row: (page, place) for place, row in enumerate(some, first)})
        try:
            seen = {} if self._looked_at is None else self._looked_at._place
            fresh = [row for row in missing if row not in seen]
            self._transform(fresh if self._loops is None else self._begin(fresh, self._loops))
            self._copy([row for row in missing if row in seen])
        except BaseException:
            # Nothing may be taken for there that is not.
            self._forget()
            raise

    @property
    def most_rows(self) -> int:
        """How many rows may be asked for at a time."""
        return self._most

    def view(self, rows: Sequence[int]) -> RowsView:
        """What was prepared, as it is now: rows that come later do not touch it."""
        found = [self._place[row] for row in rows]
        pages = list(dict.fromkeys(page for page, _ in found))
        number = {page: place for place, page in enumerate(pages)}
        return RowsView(
            pages,
            np.array([number[page] for page, _ in found], dtype=np.int64),
            np.array([place for _, place in found], dtype=np.int64),
            partial(self._settle, self._begun),
        )

    def _make_room(self, wanted: int, rows: Sequence[int]) -> bool:
        """Let pages go that were not used for longest; tells whether those of `rows` that were there still are."""
        used = {self._place[row][0] for row in rows if row in self._place}
        self._pages = [page for page in self._pages if page not in used] + [
            page for page in self._pages if page in used
        ]
        places = sum(len(page.spectra) for page in self._pages)
        wanted -= sum(page.free for page in self._pages)
        gone: set[RowPage] = set()
        while self._pages and places + wanted > self._most:
            page = self._pages.pop(0)
            places -= len(page.spectra)
            wanted += page.free
            gone.add(page)
        if gone & used:
            self._forget()
            return False
        if gone:
            self._place = {row: at for row, at in self._place.items() if at[0] not in gone}
            self._squares = {at: squares for at, squares in self._squares.items() if at[0] not in gone}
        return True

    def _forget(self) -> None:
        # Views of the pages may still be in use.
        self._place, self._pages, self._squares = {}, [], {}

    def _placed(self, rows: Sequence[int]) -> list[tuple[RowPage, Sequence[int]]]:
        """Take places in pages for rows, one after the other."""
        placed = []
        first = 0
        free = [page for page in self._pages if page.free]
        while first < len(rows):
            if free:
                page = free.pop(0)
            else:
                places = sum(len(page.spectra) for page in self._pages)
                still = max(len(rows) - first, LEAST_ROWS, self._expected - places)
                room = max(1, min(still, self._page_rows, max(self._most - places, len(rows) - first)))
                page = RowPage(room, self._actuators, self.economy)
                self._pages.append(page)
            some = rows[first : first + page.free]
            page.taken += len(some)
            placed.append((page, some))
            first += len(some)
        return placed

    def _begin(self, rows: Sequence[int], loops: InnerLoops) -> list[int]:
        """Begin to transform rows by compiled loops; what they cannot do is returned."""
        economy, cut = self.economy, self._cut
        whole = RowTransform(
            self._rows.bank.taps, cut.taps, cut.actuators, self._fft_samples, economy.low, economy.high, conjugate=True
        )
        others: list[int] = []
        for begin in range(0, len(rows), WORKERS * CHUNK):
            some = rows[begin : begin + WORKERS * CHUNK]
            raws = self._rows.look_together(some, cut.taps, loops)
            if raws is None:
                others.extend(some)
                continue
            places = [self._place[row] for row in some]
            if not cut.whole:
                for (page, place), raw in zip(places, raws, strict=True):
                    page.sizes.cut_off[place] = cut.left_out_of(raw.energies)
            scales = np.ldexp(np.float32(1.0), [-raw.exponent for raw in raws]).astype(np.float32)
            few = len(raws) <= FEW
            workers: Executor = AtOnce() if few else self._workers
            values = [raw.values for raw in raws]
            for part in [slice(0, len(raws))] if few else shares(len(raws)):
                squares = workers.submit(_transform_to, places[part], loops, whole, values[part], scales[part])
                self._begun += 1
                self._under_way.append(_Begun(self._begun, places[part], squares))
            self._settle(self._begun - CHUNKS_AHEAD)
        return others

    def _settle(self, until: int) -> None:
        """Wait for what was begun first, so many chunks in all, and tell its sizes."""
        done = []
        while self._under_way and self._under_way[0].number <= until:
            done.append(self._under_way.popleft())
        if not done:
            return
        squares = np.concatenate([chunk.squares.result() for chunk in done])
        sizes = SpectrumSizes.of(squares, self.economy, self._actuators)
        places = [at for chunk in done for at in chunk.places]
        for number, (page, place) in enumerate(places):
            page.sizes.norms[place], page.sizes.peaks[place] = sizes.norms[number], sizes.largest[number, -1]
            if self.economy.kept == self.economy.bins:
                # Rows in all bins are looked at and then copied.
                self._squares[page, place] = squares[number]

    def _transform(self, rows: Sequence[int]) -> None:
        """Transform rows by the workers, some together.

        In single precision they are read here meanwhile: that takes many short steps, over which threads would wait for
        each other more than they gain.
        """
        under_way: deque[tuple[NDArray[Any], Future[None]]] = deque()
        squares = np.empty((len(rows), self.economy.bins), dtype=self.economy.real)
        for begin in range(0, len(rows), self._group):
            if len(under_way) > AHEAD:
                self._finish(*under_way.popleft())
            some = rows[begin : begin + self._group]
            padded = self._workspace.pop() if self._workspace else self._room()
            work = self._fill_and_keep
            if self.economy.single:
                self._fill(some, padded)
                work = self._keep
            under_way.append((padded, self._workers.submit(work, some, padded, squares[begin:])))
        while under_way:
            self._finish(*under_way.popleft())
        self._measure(rows, squares)

    def _room(self) -> NDArray[Any]:
        # Kept and refilled: fresh zeros for each group would cost as much as its transforms.
        room = reused((self._group, self._actuators, self._fft_samples), self.economy.real)
        room[:, :, self._cut.taps :] = 0.0
        return room

    def _finish(self, padded: NDArray[Any], kept: Future[None]) -> None:
        kept.result()
        self._workspace.append(padded)

    def _fill_and_keep(self, rows: Sequence[int], padded: NDArray[Any], squares: NDArray[Any]) -> None:
        self._fill(rows, padded)
        self._keep(rows, padded, squares)

    def _fill(self, rows: Sequence[int], padded: NDArray[Any]) -> None:
        """Read what is used of rows."""
        out = padded[: len(rows), :, : self._cut.taps]
        if self._cut.whole:
            self._rows.read_together(rows, out)
            return
        values = reused((len(rows), self._rows.bank.actuators, self._rows.bank.taps), out.dtype)
        self._rows.read_together(rows, values)
        out[...] = self._cut.used(values)
        left_out = self._cut.left_out(values)
        for page, places, some in self._runs(rows):
            page.sizes.cut_off[places] = left_out[some]

    def _keep(self, rows: Sequence[int], padded: NDArray[Any], squares: NDArray[Any]) -> None:
        """Transform rows and keep the bins that are computed."""
        economy = self.economy
        # Bin by bin, as pages have them: the transform gathers and scatters at no cost.
        whole = scipy_fft.rfft(padded[: len(rows)].transpose(0, 2, 1), axis=1)
        for page, places, some in self._runs(rows):
            np.conjugate(whole[some, economy.low : economy.high], out=page.spectra[places])
        if not economy.exact:
            add_up_actuators(whole, squares)

    def _runs(self, rows: Sequence[int]) -> Iterator[tuple[RowPage, slice, slice]]:
        """Runs of rows that lie side by side: their page, their places in it, and which of the rows they are."""
        found = [self._place[row] for row in rows]
        begin = 0
        for end in range(1, len(found) + 1):
            page, first = found[begin]
            if end == len(found) or found[end] != (page, first + end - begin):
                yield page, slice(first, first + end - begin), slice(begin, end)
                begin = end

    def _copy(self, rows: list[int]) -> None:
        looked_at = self._looked_at
        if looked_at is None or not rows:
            return
        looked_at._settle(looked_at._begun)
        economy = self.economy
        squares = np.empty((len(rows), economy.bins), dtype=economy.real)
        for number, row in enumerate(rows):
            seen, there = looked_at._place[row]
            page, here = self._place[row]
            page.sizes.cut_off[here] = seen.sizes.cut_off[there]
            page.spectra[here] = seen.spectra[there, economy.low : economy.high]
            known = looked_at._squares.get((seen, there))
            if known is not None:
                squares[number] = known
            elif not economy.exact:
                add_up_actuators(seen.spectra[there : there + 1], squares[number:])
        self._measure(rows, squares)

    def _measure(self, rows: Sequence[int], squares: NDArray[Any]) -> None:
        """Find norms and peaks of rows from the squares of their magnitudes, (rows, bins)."""
        if self.economy.exact or not len(rows):
            return
        sizes = SpectrumSizes.of(squares, self.economy, self._actuators)
        for page, places, some in self._runs(rows):
            page.sizes.norms[places], page.sizes.peaks[places] = sizes.norms[some], sizes.largest[some, -1]


def _transform_to(
    places: Sequence[tuple[RowPage, int]],
    loops: InnerLoops,
    transform: RowTransform,
    rows: Sequence[NDArray[np.float32]],
    scales: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Transform rows to their places, which are held on to: the loops know nothing but addresses."""
    where = np.concatenate([page.addresses(np.array([place])) for page, place in places])
    return loops.transform(transform, rows, scales, where)
