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

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

CACHE_BYTES = 96 * 2**20
LEAST_ROOM, ROOM = 16, 1.5
"""Room is made for so many rows, and for so many times as many as there are when it is full."""
GROUP_BYTES = 5 * 2**18
"""Rows of so many bytes are transformed together, within the cache of one core."""
MOST_GAPS = 1.5
"""Rows are multiplied where they lie, as long as so few more lie between them."""


class RowSpectra:
    """Transforms of time-reversed, scaled rows, bin by bin.

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
        self._most = max(LEAST_ROOM, CACHE_BYTES // row_bytes)
        self._group = max(1, GROUP_BYTES // (actuators * fft_samples * np.dtype(economy.real).itemsize))
        self._workspace = threading.local()
        self._place: dict[int, int] = {}
        self._room(min(expected_rows, self._most))

    def prepare(self, rows: Sequence[int]) -> None:
        """Transform those of some rows that are not there yet. Raises InputError where one may not be used.

        At most `most_rows` rows; earlier ones may have to go.
        """
        missing = [row for row in dict.fromkeys(rows) if row not in self._place]
        if not missing:
            return
        wanted = len(self._place) + len(missing)
        if wanted > self._most:
            self._place = {}
            missing = list(dict.fromkeys(rows))
            self._room(max(len(missing), self._spectra.shape[1]))
        elif wanted > self._spectra.shape[1]:
            self._grow(min(self._most, max(int(ROOM * wanted), LEAST_ROOM)))
        first = len(self._place)
        self._place.update({row: first + number for number, row in enumerate(missing)})
        try:
            seen = {} if self._looked_at is None else self._looked_at._place
            fresh = [row for row in missing if row not in seen]
            groups = [fresh[begin : begin + self._group] for begin in range(0, len(fresh), self._group)]
            for _ in self._workers.map(self._transform, groups):
                pass
            for row in missing:
                if row in seen:
                    self._copy(row)
        except BaseException:
            # Nothing may be taken for there that is not.
            self._place = {}
            raise

    @property
    def most_rows(self) -> int:
        """How many rows may be asked for at a time."""
        return self._most

    def view(self, rows: Sequence[int]) -> RowsView:
        """What was prepared, as it is now: rows that come later do not touch it."""
        place = np.array([self._place[row] for row in rows], dtype=np.int64)
        return RowsView(self._spectra, self._norms, self._joint_norms, self._cut_off, place)

    def _room(self, places: int) -> None:
        actuators, economy = self._actuators, self.economy
        # Fresh arrays: views of the earlier ones may still be in use.
        self._spectra: NDArray[Any] = np.empty((economy.kept, places, actuators), dtype=economy.complex)
        columns = 0 if economy.exact else economy.segments + 1
        self._norms: Float64Array = np.empty((places, actuators, columns))
        self._joint_norms: Float64Array = np.empty((places, columns))
        self._cut_off: Float64Array = np.zeros(places)

    def _grow(self, places: int) -> None:
        spectra, norms, joint, cut_off = self._spectra, self._norms, self._joint_norms, self._cut_off
        count = len(self._place)
        self._room(places)
        self._cut_off[:count] = cut_off[:count]
        self._joint_norms[:count] = joint[:count]
        self._spectra[:, :count] = spectra[:, :count]
        self._norms[:count] = norms[:count]

    def _transform(self, rows: list[int]) -> None:
        economy, actuators = self.economy, self._actuators
        padded = getattr(self._workspace, "padded", None)
        if padded is None:
            # Kept and refilled: fresh zeros for each group would cost as much as its transforms.
            padded = np.zeros((self._group * actuators, self._fft_samples), dtype=economy.real)
            self._workspace.padded = padded
        for number, row in enumerate(rows):
            values = self._rows.read(row, single=economy.single).values
            self._cut_off[self._place[row]] = self._cut.left_out(values)
            values = self._cut.used(values)
            padded[number * actuators : (number + 1) * actuators, : values.shape[1]] = values[:, ::-1]
        self._keep(rows, scipy_fft.rfft(padded[: len(rows) * actuators], axis=1))

    def _copy(self, row: int) -> None:
        looked_at = self._looked_at
        if looked_at is not None:
            self._keep([row], np.ascontiguousarray(looked_at._spectra[:, looked_at._place[row]].T))
            self._cut_off[self._place[row]] = looked_at._cut_off[looked_at._place[row]]

    def _keep(self, rows: list[int], whole: NDArray[Any]) -> None:
        """Keep spectra in all bins, (rows x actuators, bins), as the economy has them."""
        economy, actuators = self.economy, self._actuators
        place = np.array([self._place[row] for row in rows])
        first = int(place[0])
        side_by_side = int(place[-1]) - first == len(rows) - 1
        where: slice | Int64Array = slice(first, first + len(rows)) if side_by_side else place
        kept = whole[:, economy.low : economy.high].T
        self._spectra[:, where] = kept.reshape(economy.kept, len(rows), actuators)
        if not economy.exact:
            norms = economy.norms(whole).reshape(len(rows), actuators, -1)
            self._norms[where] = norms
            self._joint_norms[where] = np.sqrt(np.square(norms).sum(axis=1))


class RowsView:
    """Spectra of some rows.

    Parameters
    ----------
    spectra : complex array, shape (kept bins, places, actuators)
        Among others.
    norms : float64 array, shape (places, actuators, segments + 1)
        Norms over the segments of the economy; no segment where nothing is left out.
    joint_norms : float64 array, shape (places, segments + 1)
        The same over all actuators.
    cut_off : float64 array, shape (places,)
        Norms of what of each row is not used, in time.
    place : int64 array, shape (rows,)
        Where the rows lie.
    """

    def __init__(
        self,
        spectra: NDArray[Any],
        norms: Float64Array,
        joint_norms: Float64Array,
        cut_off: Float64Array,
        place: Int64Array,
    ) -> None:
        self._cut_off = cut_off
        self._spectra = spectra
        self._norms = norms
        self._joint_norms = joint_norms
        self._place = place

    def norms(self) -> Float64Array:
        """Norms of the rows over all actuators, (rows, segments + 1), a copy."""
        return self._joint_norms[self._place]

    def cut_off(self) -> Float64Array:
        """Norms of what of each row is not used, in time, (rows,)."""
        return self._cut_off[self._place]

    def weighted_norms(self, chosen: Int64Array, weights: Float64Array) -> Float64Array:
        """Norms of some rows over the actuators, each times a weight, (len(chosen), segments + 1)."""
        norms: Float64Array = np.sqrt(np.square(self._norms[self._place[chosen]] * weights[:, None]).sum(axis=1))
        return norms

    def magnitudes(self, chosen: Int64Array) -> Float64Array:
        """Norms over the actuators of some rows, bin by bin, (len(chosen), kept bins)."""
        spectra = np.take(self._spectra, self._place[chosen], axis=1)
        parts = spectra.view(spectra.real.dtype)
        return np.ascontiguousarray(np.sqrt(np.einsum("bki,bki->kb", parts, parts, dtype=np.float64)))

    def times(self, windows: NDArray[Any], chosen: Int64Array) -> NDArray[Any]:
        """Sum over rows of their spectra times those of windows.

        Parameters
        ----------
        windows : complex array, shape (len(chosen), kept bins)
            One window for each row.
        chosen : int64 array
            Which of the rows, none twice.

        Returns
        -------
        complex array, shape (kept bins, actuators)
        """
        place = self._place[chosen]
        low, high = int(place.min()), int(place.max()) + 1
        if high - low <= MOST_GAPS * len(place) + 1:
            spectra = self._spectra[:, low:high]
            if high - low > len(place) or (np.diff(place) < 0).any():
                spread = np.zeros((high - low, windows.shape[1]), dtype=windows.dtype)
                spread[place - low] = windows
                windows = spread
        else:
            spectra = np.take(self._spectra, place, axis=1)
        product: NDArray[Any] = np.matmul(np.ascontiguousarray(windows.T)[:, None], spectra)
        return product[:, 0]
