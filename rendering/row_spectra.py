"""Spectra of bank rows, transformed when they are first asked for and kept while there is room."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.omission import Economy
from rendering.regularisation import BankRows
from rendering.row_cut import RowCut
from rendering.row_pages import RowPage, RowsView

CACHE_BYTES = 384 * 2**20
"""Most memory of spectra that are kept, beside pages that have gone and are still multiplied."""
PAGE_BYTES = 16 * 2**20
"""Rows lie together in pages of at most so many bytes, which go all at once."""
LEAST_ROWS = 16
"""Room is made for at least so many rows."""
GROUP_BYTES = 5 * 2**17
"""Rows of so many bytes are transformed together, within the cache of one core."""


class RowSpectra:
    """Transforms of time-reversed, scaled rows.

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
        self._workspace = threading.local()
        self._place: dict[int, tuple[RowPage, int]] = {}
        self._pages: list[RowPage] = []

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
            groups = [fresh[begin : begin + self._group] for begin in range(0, len(fresh), self._group)]
            for _ in self._workers.map(self._transform, groups):
                pass
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
        return True

    def _forget(self) -> None:
        # Views of the pages may still be in use.
        self._place, self._pages = {}, []

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

    def _transform(self, rows: list[int]) -> None:
        economy, actuators = self.economy, self._actuators
        padded = getattr(self._workspace, "padded", None)
        if padded is None:
            # Kept and refilled: fresh zeros for each group would cost as much as its transforms.
            padded = np.zeros((self._group * actuators, self._fft_samples), dtype=economy.real)
            self._workspace.padded = padded
        for number, row in enumerate(rows):
            values = self._rows.read(row, single=economy.single).values
            page, place = self._place[row]
            page.cut_off[place] = self._cut.left_out(values)
            values = self._cut.used(values)
            padded[number * actuators : (number + 1) * actuators, : values.shape[1]] = values[:, ::-1]
        self._keep(rows, scipy_fft.rfft(padded[: len(rows) * actuators], axis=1))

    def _copy(self, rows: list[int]) -> None:
        looked_at = self._looked_at
        if looked_at is None or not rows:
            return
        by_page: dict[RowPage, list[int]] = {}
        for row in rows:
            by_page.setdefault(looked_at._place[row][0], []).append(row)
        for seen, some in by_page.items():
            places = [looked_at._place[row][1] for row in some]
            whole = np.ascontiguousarray(seen.spectra[places].transpose(0, 2, 1))
            self._keep(some, whole.reshape(-1, whole.shape[2]))
            for row, place in zip(some, places, strict=True):
                page, here = self._place[row]
                page.cut_off[here] = seen.cut_off[place]

    def _keep(self, rows: list[int], whole: NDArray[Any]) -> None:
        """Keep spectra in all bins, (rows x actuators, bins), as the economy has them."""
        economy, actuators = self.economy, self._actuators
        spectra = whole.reshape(len(rows), actuators, -1)
        norms = None if economy.exact else economy.norms(spectra)
        begin = 0
        while begin < len(rows):
            page, place = self._place[rows[begin]]
            end = begin + 1
            while end < len(rows) and self._place[rows[end]] == (page, place + end - begin):
                end += 1
            where = slice(place, place + end - begin)
            page.spectra[where] = spectra[begin:end, :, economy.low : economy.high].transpose(0, 2, 1)
            if norms is not None:
                page.norms[where] = norms[begin:end]
                page.joint_norms[where] = np.sqrt(np.square(norms[begin:end]).sum(axis=1))
            begin = end
