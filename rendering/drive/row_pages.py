"""Spectra of bank rows, side by side in pages of memory, and their products with windows.

A row lies bin by bin, so that it is read from one end to the other while it is multiplied; and from one row to the
next it is as far everywhere, so that one call multiplies a run of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.drive.omission import Economy
from rendering.inner_loops import InnerLoops, TransformBack, inner_loops
from rendering.reused_memory import reused

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

MOST_GAP = 2
"""Rows are multiplied where they lie, so few unused ones between them included: one product more would cost as much."""
LEAST_RUN = 3
"""Rows that lie in shorter runs than this, on average, are gathered before they are multiplied."""


@dataclass(frozen=True, slots=True)
class RowSizes:
    """How large rows are over all actuators, for bounds on errors.

    Parameters
    ----------
    norms : float64 array, shape (rows, segments + 1)
        Norms over the segments of the economy, then over all bins; no segment where nothing is left out.
    peaks : float64 array, shape (rows,)
        Largest magnitudes of any bin.
    cut_off : float64 array, shape (rows,)
        Norms of what of each row is not used, in time.
    """

    norms: Float64Array
    peaks: Float64Array
    cut_off: Float64Array


class RowPage:
    """Room for the spectra of some rows.

    Parameters
    ----------
    places : int
        How many rows.
    actuators : int
        Rows of a row.
    economy : Economy
        Which bins there are, and what is told of the others.
    """

    def __init__(self, places: int, actuators: int, economy: Economy) -> None:
        segments = 0 if economy.exact else economy.segments + 1
        self.spectra: NDArray[Any] = reused((places, economy.kept, actuators), economy.complex)
        """Bins computed, (places, kept bins, actuators)."""
        self.sizes = RowSizes(np.empty((places, segments)), np.empty(places), np.zeros(places))
        """Of each place."""
        self.taken = 0
        """Places that rows have."""
        self._address = int(self.spectra.ctypes.data)

    @property
    def free(self) -> int:
        """Places that no row has."""
        return len(self.spectra) - self.taken

    def addresses(self, places: Int64Array) -> NDArray[np.uintp]:
        """Where the rows at some places lie in memory."""
        return (self._address + self.spectra.strides[0] * places).astype(np.uintp)


class RowsView:
    """Spectra of some rows.

    Parameters
    ----------
    pages : sequence of RowPage
        Where they lie, among others.
    page : int64 array, shape (rows,)
        In which of these pages each of them lies.
    place : int64 array, shape (rows,)
        Where in that page.
    settle : callable, optional
        Waits until they are there; without it they are.
    """

    def __init__(
        self, pages: Sequence[RowPage], page: Int64Array, place: Int64Array, settle: Callable[[], None] | None = None
    ) -> None:
        self._pages = pages
        self._page = page
        self._place = place
        self._settle = settle or (lambda: None)

    def sizes(self) -> RowSizes:
        """How large the rows are, copies."""
        self._settle()
        segments = self._pages[0].sizes.norms.shape[1]
        found = RowSizes(np.empty((len(self._place), segments)), np.empty(len(self._place)), np.empty(len(self._place)))
        for page, rows, place in self._by_page():
            found.norms[rows] = page.sizes.norms[place]
            found.peaks[rows] = page.sizes.peaks[place]
            found.cut_off[rows] = page.sizes.cut_off[place]
        return found

    def magnitudes(self) -> Float64Array:
        """Norms of the rows over the actuators, bin by bin, (rows, kept bins)."""
        self._settle()
        spectra = self._pages[0].spectra
        squares = np.empty((len(self._place), spectra.shape[1]), dtype=spectra.real.dtype)
        for page, rows, place in self._by_page():
            for row, at in zip(rows.tolist(), place.tolist(), strict=True):
                add_up_actuators(page.spectra[at : at + 1], squares[row:])
        return np.sqrt(squares).astype(np.float64)

    def sums(self, windows: NDArray[Any], turn: NDArray[Any], groups: Int64Array, out: NDArray[Any]) -> None:
        """Sum over the rows of each group of their spectra times those of windows.

        Parameters
        ----------
        windows : complex array, shape (rows, kept bins)
            One window for each row.
        turn : complex array, shape (kept bins,)
            What each of them is multiplied with besides.
        groups : int64 array, shape (rows,)
            Which group each of them belongs to; none holds a row twice.
        out : complex array, shape (groups, kept bins, actuators)
            Where the sums go, each contiguous; groups without a row stay as they are.
        """
        self._settle()
        loops = inner_loops()
        if loops is not None and out.dtype == np.complex128:
            order = np.argsort(groups, kind="stable")
            bounds = np.searchsorted(groups[order], np.arange(len(out) + 1))
            turned = np.ascontiguousarray(turn, dtype=np.complex128)
            loops.sum(self._addresses()[order], windows[order].astype(np.complex128, copy=False), bounds, turned, out)
            return
        order = np.lexsort((self._place, self._page, groups))
        group, page, place = groups[order], self._page[order], self._place[order]
        elsewhere = (np.diff(group, prepend=-1, append=-1) != 0) | (np.diff(page, prepend=-1, append=-1) != 0)
        apart = elsewhere | (np.diff(place, prepend=0, append=0) > MOST_GAP + 1)
        turned = windows * turn
        turned = np.ascontiguousarray((turned if (np.diff(order) > 0).all() else turned[order]).T)
        runs = np.flatnonzero(apart)
        ends = np.flatnonzero(elsewhere)
        # How many runs end before each end.
        before = np.searchsorted(runs, ends).tolist()
        last = -1
        for number, (begin, end) in enumerate(pairwise(ends.tolist())):
            spectra, one = self._pages[int(page[begin])].spectra, int(group[begin])
            some = runs[before[number] : before[number + 1] + 1].tolist()
            if (len(some) - 1) * LEAST_RUN > end - begin > LEAST_RUN:
                products = [(turned[:, begin:end], spectra[place[begin:end]])]
            else:
                products = [_run(turned[:, first:stop], place[first:stop], spectra) for first, stop in pairwise(some)]
            for product in products:
                if one == last:
                    out[one] += _product(*product)
                else:
                    _product(*product, out=out[one])
                last = one

    def begin_blocks(
        self, loops: InnerLoops, back: TransformBack, windows: NDArray[np.complex64], block: Int64Array
    ) -> Callable[[slice, NDArray[np.float32]], Float64Array]:
        """Prepare to do by compiled loops what `sums` and a transform back to time do.

        Parameters
        ----------
        loops : InnerLoops
            The loops.
        back : TransformBack
            What is made of the sums.
        windows : complex64 array, shape (rows, kept bins)
            One window for each row.
        block : int64 array, shape (rows,)
            Which block each of them belongs to, ascending.

        Returns
        -------
        callable
            Makes a range of blocks of an array (blocks, actuators, samples), without Python's lock, and tells their
            energies, no smaller than rounding.
        """
        self._settle()
        # Of this view, which holds on to the pages.
        return partial(
            self._make_blocks, loops, back, self._addresses(), np.ascontiguousarray(windows, dtype=np.complex64), block
        )

    def _make_blocks(
        self,
        loops: InnerLoops,
        back: TransformBack,
        where: NDArray[np.uintp],
        windows: NDArray[np.complex64],
        block: Int64Array,
        some: slice,
        out: NDArray[np.float32],
    ) -> Float64Array:
        bounds = np.searchsorted(block, np.arange(some.start, some.stop + 1))
        first, last = int(bounds[0]), int(bounds[-1])
        energies = loops.blocks(back, where[first:last], windows[first:last], bounds - first, out[some])
        energies *= 1.0 + out.shape[2] * np.finfo(np.float32).eps
        return energies

    def _addresses(self) -> NDArray[np.uintp]:
        """Where each of the rows lies in memory, as long as this view is held on to."""
        where = np.empty(len(self._place), dtype=np.uintp)
        for page, rows, place in self._by_page():
            where[rows] = page.addresses(place)
        return where

    def _by_page(self) -> Iterator[tuple[RowPage, Int64Array, Int64Array]]:
        """Each page, which of the rows lie in it, and where."""
        for number, page in enumerate(self._pages):
            rows = np.flatnonzero(self._page == number)
            yield page, rows, self._place[rows]


def _run(windows: NDArray[Any], place: Int64Array, spectra: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Rows at ascending places, few of which between them are not used, and windows for all of them."""
    low, high = int(place[0]), int(place[-1]) + 1
    if high - low > len(place):
        spread: NDArray[Any] = np.zeros((len(windows), high - low), dtype=windows.dtype)
        spread[:, place - low] = windows
        windows = spread
    return windows, spectra[low:high]


def _product(windows: NDArray[Any], spectra: NDArray[Any], out: NDArray[Any] | None = None) -> NDArray[Any]:
    """Sum over rows (bins, rows) times (rows, bins, actuators), (bins, actuators)."""
    into = None if out is None else out[:, None]
    product: NDArray[Any] = np.matmul(windows[:, None], spectra.transpose(1, 0, 2), out=into)
    return product[:, 0]


def add_up_actuators(spectra: NDArray[Any], out: NDArray[Any]) -> None:
    """Squares of magnitudes (rows, bins, actuators), added up over the actuators into the first rows of (k, bins)."""
    parts: NDArray[Any] = spectra.view(spectra.real.dtype)
    np.einsum("rka,rka->rk", parts, parts, out=out[: len(parts)])
