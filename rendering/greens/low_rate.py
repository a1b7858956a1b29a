"""A bank at a fraction of its rate, for fields that need no more."""

from __future__ import annotations

from collections.abc import Sequence

from rendering.field.decimation import Decimation
from rendering.greens.row_scaling import RawRow, ScaledRow
from rendering.greens.source import GreenSource, RowReader
from rendering.inner_loops import InnerLoops


class LowRateRows(RowReader):
    """Rows of a bank at a lower rate.

    Parameters
    ----------
    bank : GreenSource
        The bank.
    rate_hz : float
        Rate wanted, an integer fraction of the bank's.

    Raises
    ------
    InputError
        The rate is not such a fraction.
    """

    def __init__(self, bank: GreenSource, rate_hz: float) -> None:
        super().__init__(bank)
        self.bank = bank
        self.decimation = Decimation(float(bank.sample_rate_hz), rate_hz)

    @property
    def taps(self) -> int:
        """Samples of a row, from `half` before its tap 0."""
        return self.decimation.samples(self.bank.taps)

    def read(self, position: int, *, single: bool) -> ScaledRow:
        row = super().read(position, single=single)
        return ScaledRow(self.decimation.lower(row.values), row.exponent)

    def look_together(self, positions: Sequence[int], loops: InnerLoops) -> list[RawRow] | None:
        # Each has to be brought to the lower rate first.
        return None
