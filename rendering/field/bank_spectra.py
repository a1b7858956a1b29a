"""Spectra of bank rows as predictions multiply them with drives; kept for a whole bank where wanted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.band import Band, choose_band, tolerance_of
from rendering.device import Device, fast_length, host_device
from rendering.field.decimation import Decimation
from rendering.greens.source import GreenSource, RowReader
from rendering.threads import in_order
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

BLOCK_SHARE = 4.1
"""Transform length in taps of spectra that are kept: longer blocks overlap less and take as much more memory."""
CHOICE_SHARE = 0.25
"""Share of the tolerance that the bins left out may take for typical drives; the rest allows for others."""
LOOKED_AT_ROWS = 16
ROWS_AT_ONCE = 8


@dataclass(frozen=True, slots=True)
class RowsSpectra:
    """Spectra of some rows, each of size about 1.

    kept, complex (kept bins, rows, actuators): of the device.
    exponents, int64 (rows,): The rows are these times two to such a power.
    magnitude, float64 (rows, bins), or None: Norms over the actuators of every bin, where errors are bounded.
    """

    kept: Any
    exponents: Int64Array
    magnitude: Float64Array | None

    def rows(self, places: slice | Int64Array) -> RowsSpectra:
        """Some of the rows; those of a slice are the same memory."""
        magnitude = None if self.magnitude is None else self.magnitude[places]
        return RowsSpectra(self.kept[:, places, :], self.exponents[places], magnitude)


def transform_rows(
    reader: RowReader, positions: Sequence[int], band: Band, bins: int, device: Device, *, bounded: bool
) -> RowsSpectra:
    """Read some rows and transform them; magnitudes, where `bounded`, are of so many `bins`, at least those kept."""
    rows = [reader.read(position, single=band.single) for position in positions]
    green = device.xp.asarray(np.stack([row.values for row in rows]))
    # Bin by bin, as matrix products need them: the transform gathers at no cost.
    whole = device.fft(single=band.single).rfft(device.xp.moveaxis(green, 2, 0), n=band.fft_samples, axis=0)
    magnitude = None
    if bounded:
        host = device.to_host(whole[:bins, :, :])
        power = np.einsum("bra,bra->rb", host.real, host.real, dtype=np.float64)
        magnitude = np.sqrt(power + np.einsum("bra,bra->rb", host.imag, host.imag, dtype=np.float64))
    return RowsSpectra(whole[: band.kept, :, :], np.array([row.exponent for row in rows]), magnitude)


class BankSpectra:
    """Spectra of a bank's rows, made once and kept for the prediction of many drives.

    positions: Rows that will be predicted, measured.
    rate_hz: Rate of the fields, an integer fraction of the bank's.
    tolerance_db: Allows to keep only the bins that matter to within this relative L2 error, < 0. The error of each
        field is bounded, and one that has more in the other bins is computed from the bank instead.
    """

    decimation: Decimation
    """How the rate is lowered."""
    band: Band
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
        self.bank, self._reader = bank, RowReader(bank)
        self.tolerance = tolerance_of(tolerance_db)
        rate = float(bank.sample_rate_hz)
        self.decimation = Decimation(rate, rate if rate_hz is None else rate_hz)
        factor = self.decimation.factor
        least = (int(BLOCK_SHARE * bank.taps) + self.decimation.kernel_samples) // factor + 1
        fft_samples = factor * fast_length(least)
        self.bins = fft_samples // factor // 2 + 1
        """Bins up to half the rate."""
        rows = np.unique(np.asarray(positions, dtype=np.int64))
        self._place = np.full(bank.positions, -1, dtype=np.int64)
        self._place[rows] = np.arange(len(rows))
        self.band = Band(fft_samples, self.bins, single=True)
        if self.tolerance:
            self.band = self._choose(rows)
        try:
            self._made = self._transform(rows)
        except MemoryError as error:
            size = len(rows) * bank.actuators * self.band.kept * 8 / 2**30
            raise InputError(
                f"the bank's spectra take {size:.3g} GiB, which do not fit into memory; ask for fewer positions, a"
                " lower rate or a tolerance"
            ) from error

    @property
    def size_bytes(self) -> int:
        """Memory that the spectra take."""
        magnitude = self._made.magnitude
        return int(self._made.kept.nbytes) + (0 if magnitude is None else int(magnitude.nbytes))

    def rows(self, positions: Int64Array) -> RowsSpectra:
        """Spectra of some rows. Raises InputError where one was not among the positions."""
        place = self._place[positions]
        if (place < 0).any():
            raise InputError(
                f"the spectra of position {int(positions[int(np.argmin(place))])} were not kept; make them for all"
                " positions that are asked for"
            )
        if (np.diff(place) == 1).all():
            return self._made.rows(slice(int(place[0]), int(place[-1]) + 1))
        return self._made.rows(place)

    def _choose(self, rows: Int64Array) -> Band:
        """Bins that matter for drives that are made from the bank, from a few rows."""
        looked_at = rows[np.unique(np.linspace(0, len(rows) - 1, LOOKED_AT_ROWS).astype(int))].tolist()
        magnitude = transform_rows(self._reader, looked_at, self.band, self.bins, host_device(), bounded=True).magnitude
        assert magnitude is not None
        power = np.square(magnitude)
        drive = power.mean(axis=0)
        coherent = float(power.sum() * drive.max())
        contribution = (power * drive).sum(axis=0)
        # Responses of the actuators add up at random, bounds on their errors in phase.
        allowed = CHOICE_SHARE * self.tolerance / math.sqrt(self.bank.actuators)
        chosen = choose_band(
            self.band.fft_samples, contribution, float(contribution.sum()), coherent, self.bank.actuators, allowed
        )
        return Band(chosen.fft_samples, chosen.kept, single=True)

    def _transform(self, rows: Int64Array) -> RowsSpectra:
        kept = np.empty((self.band.kept, len(rows), self.bank.actuators), dtype=self.band.complex)
        magnitude = np.empty((len(rows), self.bins)) if self.tolerance else None
        exponents = np.empty(len(rows), dtype=np.int64)

        def fill(first: int) -> None:
            where = slice(first, first + ROWS_AT_ONCE)
            made = transform_rows(
                self._reader, rows[where].tolist(), self.band, self.bins, host_device(), bounded=bool(self.tolerance)
            )
            kept[:, where], exponents[where] = made.kept, made.exponents
            if magnitude is not None:
                magnitude[where] = made.magnitude

        for _ in in_order(fill, range(0, len(rows), ROWS_AT_ONCE)):
            pass
        return RowsSpectra(kept, exponents, magnitude)
