"""Spectra of bank rows, bin by bin, as products with drives need them; kept for a whole bank where wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.band_choice import Sample, choose_economy
from rendering.drive.omission import Economy, tolerance_of
from rendering.drive.upsampling import MULTIPLE
from rendering.field.decimation import Decimation
from rendering.field.product_bounds import SpectrumSizes, joint_squares
from rendering.greens.low_rate import LowRateRows
from rendering.greens.source import GreenSource, RowReader
from rendering.inner_loops import InnerLoops, RowTransform, inner_loops, transformable
from rendering.shared_work import share_out
from rendering.threads import one_blas_thread
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

GROUP_BYTES = 2**20
"""Rows of so many bytes are transformed together, within the cache of one core."""
BLOCK_SHARE = 4.1
"""Transform length in taps: longer blocks overlap less, and their spectra take as much more memory."""
CHOICE_SHARE = 0.25
"""Share of the tolerance that the bins left out may take for typical drives; the rest allows for others."""
LOOKED_AT_ROWS = 16
ROWS_AT_ONCE = 8
"""Rows that compiled loops look at and then transform."""


@dataclass(frozen=True, slots=True)
class RowTransforms:
    """Spectra of some rows of size about 1.

    Parameters
    ----------
    kept : complex array, shape (rows, kept bins, actuators)
        Actuators side by side.
    sizes : SpectrumSizes
        Over these actuators or more; zeros where no error is bounded.
    exponents : int64 array, shape (rows,)
        The rows are these times two to such a power.
    """

    kept: NDArray[Any]
    sizes: SpectrumSizes
    exponents: Int64Array

    @classmethod
    def empty(cls, rows: int, actuators: int, economy: Economy) -> RowTransforms:
        """Room for some rows."""
        kept = np.empty((rows, economy.kept, actuators), dtype=economy.complex)
        return cls(kept, SpectrumSizes.zeros(rows, economy), np.zeros(rows, dtype=np.int64))

    def rows(self, places: slice | Int64Array) -> RowTransforms:
        """Some of the rows; those of a slice are the same memory."""
        return RowTransforms(self.kept[places], self.sizes.some(places), self.exponents[places])

    def heard(self, actuators: Int64Array) -> RowTransforms:
        """Of some actuators only."""
        if len(actuators) == self.kept.shape[2]:
            return self
        return RowTransforms(self.kept.take(actuators, axis=2), self.sizes, self.exponents)


def transform_rows(
    reader: RowReader,
    positions: Sequence[int],
    fft_samples: int,
    economy: Economy,
    *,
    bounded: bool,
    actuators: Int64Array | None = None,
) -> RowTransforms:
    """Read rows and transform them.

    Parameters
    ----------
    reader : RowReader
        Reads the rows.
    positions : sequence of int
        Which.
    fft_samples : int
        Transform length, at least the rows' taps.
    economy : Economy
        Precision, and which bins to keep.
    bounded : bool
        Whether sizes are needed.
    actuators : int64 array, optional
        Of which; by default of all.
    """
    heard = np.arange(reader.actuators) if actuators is None else actuators
    made = RowTransforms.empty(len(positions), len(heard), economy)
    _fill(made, reader, positions, fft_samples, economy, heard, bounded=bounded)
    return made


def _fill(
    made: RowTransforms,
    reader: RowReader,
    positions: Sequence[int],
    fft_samples: int,
    economy: Economy,
    actuators: Int64Array,
    *,
    bounded: bool,
) -> None:
    """Read and transform rows into their place."""
    loops = inner_loops() if economy.single and transformable(fft_samples) else None
    if loops is not None:
        whole = RowTransform(
            reader.taps, reader.taps, actuators, fft_samples, economy.low, economy.high, conjugate=False
        )
        for begin in range(0, len(positions), ROWS_AT_ONCE):
            where = slice(begin, begin + ROWS_AT_ONCE)
            if not _fill_by_loops(made.rows(where), reader, positions[where], loops, whole, economy, bounded=bounded):
                _fill_by_numpy(
                    made.rows(where), reader, positions[where], fft_samples, economy, actuators, bounded=bounded
                )
        return
    _fill_by_numpy(made, reader, positions, fft_samples, economy, actuators, bounded=bounded)


def _fill_by_loops(
    made: RowTransforms,
    reader: RowReader,
    positions: Sequence[int],
    loops: InnerLoops,
    transform: RowTransform,
    economy: Economy,
    *,
    bounded: bool,
) -> bool:
    """The same by compiled loops; tells whether they can."""
    raws = reader.look_together([int(position) for position in positions], loops)
    if raws is None:
        return False
    made.exponents[:] = [raw.exponent for raw in raws]
    scales = np.ldexp(np.float32(1.0), -made.exponents).astype(np.float32)
    where = (made.kept.ctypes.data + made.kept.strides[0] * np.arange(len(raws))).astype(np.uintp)
    squares = loops.transform(transform, [raw.values for raw in raws], scales, where)
    if bounded:
        sizes = SpectrumSizes.of(squares, economy, made.kept.shape[2])
        made.sizes.norms[:], made.sizes.largest[:] = sizes.norms, sizes.largest
    return True


def _fill_by_numpy(
    made: RowTransforms,
    reader: RowReader,
    positions: Sequence[int],
    fft_samples: int,
    economy: Economy,
    actuators: Int64Array,
    *,
    bounded: bool,
) -> None:
    heard, count = len(actuators), len(positions)
    some_only = heard < reader.actuators
    at_once = max(1, GROUP_BYTES // (heard * fft_samples * np.dtype(economy.real).itemsize))
    padded = np.zeros((min(at_once, count), heard, fft_samples), dtype=economy.real)
    for begin in range(0, count, at_once):
        some = positions[begin : begin + at_once]
        for place, position in enumerate(some):
            row = reader.read(int(position), single=economy.single)
            padded[place, :, : row.values.shape[1]] = row.values[actuators] if some_only else row.values
            made.exponents[begin + place] = row.exponent
        whole = scipy_fft.rfft(padded[: len(some)], axis=2)
        where = slice(begin, begin + len(some))
        made.kept[where] = whole[:, :, economy.low : economy.high].transpose(0, 2, 1)
        if bounded:
            sizes = SpectrumSizes.of(joint_squares(whole), economy, heard)
            made.sizes.norms[where], made.sizes.largest[where] = sizes.norms, sizes.largest


class BankSpectra:
    """Spectra of a bank's rows, made once and kept for the prediction of many drives.

    Parameters
    ----------
    bank : GreenSource
        The bank.
    positions : sequence of int
        Its rows that will be asked for, measured.
    rate_hz : float, optional
        Rate of the fields, an integer fraction of the bank's.
    tolerance_db : float, optional
        Allows to keep only the bins that matter to within this relative L2 error, < 0. The error of each field is
        bounded, and one that has more in the other bins is computed from the bank instead.

    Raises
    ------
    InputError
        The rate is not such a fraction, the tolerance is not below 0, or the spectra do not fit into memory.
    """

    reader: RowReader
    decimation: Decimation | None
    """How the rate is lowered."""
    fft_samples: int
    economy: Economy
    tolerance: float
    """Relative magnitude that may be left out of a field, 0 where nothing may."""

    def __init__(
        self,
        bank: GreenSource,
        positions: Sequence[int] | Int64Array,
        *,
        rate_hz: float | None = None,
        tolerance_db: float | None = None,
    ) -> None:
        self.bank = bank
        self.tolerance = tolerance_of(tolerance_db)
        self.decimation = None
        self.reader = RowReader(bank)
        if rate_hz is not None and rate_hz != bank.sample_rate_hz:
            self.reader = low = LowRateRows(bank, rate_hz)
            self.decimation = low.decimation
        length = int(BLOCK_SHARE * self.reader.taps / MULTIPLE) + 1
        self.fft_samples = MULTIPLE * int(scipy_fft.next_fast_len(length, real=True))
        rows = np.unique(np.asarray(positions, dtype=np.int64))
        self._place = np.full(bank.positions, -1, dtype=np.int64)
        self._place[rows] = np.arange(len(rows))
        self.economy = self._choose(rows)
        try:
            self._made = self._transform(rows)
        except MemoryError as error:
            size = len(rows) * bank.actuators * self.economy.kept * 8 / 2**30
            raise InputError(
                f"the bank's spectra take {size:.3g} GiB, which do not fit into memory; ask for fewer positions, a"
                " lower rate or a tolerance"
            ) from error

    @property
    def size_bytes(self) -> int:
        """Memory that the spectra take."""
        return int(self._made.kept.nbytes + self._made.sizes.norms.nbytes + self._made.sizes.largest.nbytes)

    def rows(self, positions: Int64Array) -> RowTransforms:
        """Spectra of some rows. Raises InputError where one was not among the positions."""
        place = self._place[positions]
        if (place < 0).any():
            raise InputError(
                f"the spectra of position {int(positions[int(np.argmin(place))])} were not kept; make them for all"
                " positions that are asked for"
            )
        first, last = int(place[0]), int(place[-1]) + 1
        if last - first == len(place) and (np.diff(place) == 1).all():
            return self._made.rows(slice(first, last))
        return self._made.rows(place)

    def _choose(self, rows: Int64Array) -> Economy:
        """Bins that matter for drives that are made from the bank, by a look at some rows."""
        bins = self.fft_samples // 2 + 1
        if not self.tolerance:
            return Economy.of(bins, single=True)
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, LOOKED_AT_ROWS).astype(int))]
        greens = np.array(
            [
                np.abs(scipy_fft.rfft(self.reader.read(row, single=True).values, self.fft_samples, axis=1))
                for row in chosen.tolist()
            ],
            dtype=np.float64,
        )
        drives = np.sqrt(np.square(greens).mean(axis=0))
        samples = [Sample(drives, green, 1.0, np.zeros(len(green))) for green in greens]
        return choose_economy(samples, self.fft_samples, 1, CHOICE_SHARE * self.tolerance)

    def _transform(self, rows: Int64Array) -> RowTransforms:
        economy, every = self.economy, np.arange(self.bank.actuators)
        made = RowTransforms.empty(len(rows), self.bank.actuators, economy)
        at_once = max(1, 2 * GROUP_BYTES // (self.bank.actuators * self.fft_samples * 4))

        def fill(first: int) -> None:
            where, bounded = slice(first, first + at_once), self.tolerance > 0
            some = rows[where].tolist()
            _fill(made.rows(where), self.reader, some, self.fft_samples, economy, every, bounded=bounded)

        with one_blas_thread():
            share_out(range(0, len(rows), at_once), fill)
        return made
