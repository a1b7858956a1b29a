"""A bank at a fraction of its rate, for fields that need no more."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from rendering.decimation import Decimation
from rendering.green_source import GreenSource, RowReader, ScaledRow

Float64Array = NDArray[np.float64]
RealArray = NDArray[np.float32] | NDArray[np.float64]


class LowRateRows(RowReader):
    """Rows of a bank at a lower rate; reads them as they are asked for, and keeps them where told to.

    Parameters
    ----------
    bank : GreenSource
        The bank.
    rate_hz : float
        Rate wanted, an integer fraction of the bank's.
    keep : bool
        Whether to keep the rows for later predictions: a fraction of the bank's size in memory.

    Raises
    ------
    InputError
        The rate is not such a fraction.
    """

    def __init__(self, bank: GreenSource, rate_hz: float, *, keep: bool = True) -> None:
        super().__init__(bank)
        self.bank = bank
        self.decimation = Decimation(float(bank.sample_rate_hz), rate_hz)
        self._kept: dict[tuple[int, bool], ScaledRow] | None = {} if keep else None
        self._workspace = threading.local()

    @property
    def taps(self) -> int:
        """Samples of a row, from `half` before its tap 0."""
        return self.decimation.samples(self.bank.taps)

    def read(self, position: int, *, single: bool) -> ScaledRow:
        found = self._kept.get((position, single)) if self._kept is not None else None
        if found is not None:
            return found
        row = super().read(position, single=single)
        lower = ScaledRow(self.decimation.lower(row.values), row.exponent)
        if self._kept is not None:
            self._kept[position, single] = lower
        return lower
