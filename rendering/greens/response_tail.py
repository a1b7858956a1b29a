"""What a bank's window cuts off: responses that go on beyond it, or wrap round into it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.greens.source import GreenSource, read_rows

Float64Array = NDArray[np.float64]

ROWS = 6
LOUD_DB = -40.0
"""Level of the last tenth from which it is said."""


@dataclass(frozen=True, slots=True)
class ResponseTail:
    """The end of some rows' Green's functions.

    position: The row whose end is loudest.
    last_tenth_db: Energy of the last tenth of its taps over that of all, all actuators together.
    beyond_share: Share of the whole response's energy that lies beyond the window, 0 to 1, if it dies away from half
        window to half window as it does within: with r the energy of the second half over that of the first, r squared.
    """

    position: int
    last_tenth_db: float
    beyond_share: float

    @property
    def warning(self) -> str | None:
        """One sentence where the end is loud."""
        if self.last_tenth_db <= LOUD_DB:
            return None
        return (
            f"the last tenth of the Green's functions holds {self.last_tenth_db:.0f} dB of their energy (position"
            f" {self.position}); if they die away as they do until then, {100 * self.beyond_share:.3g} % of the"
            " response lies beyond the bank's window: measure with more taps, or look for noise or for what wraps round"
        )


def response_tail(bank: GreenSource, rows: Sequence[int]) -> ResponseTail | None:
    """Look at the ends of at most six of the rows, evenly chosen.

    Returns ResponseTail or None: None where there is no row, none that is not silent, or Green's functions have fewer
    than ten taps.
    """
    if not len(rows) or bank.taps < 10:
        return None
    found: ResponseTail | None = None
    chosen = [rows[index] for index in np.unique(np.linspace(0, len(rows) - 1, min(ROWS, len(rows))).astype(np.int64))]
    green = read_rows(bank, chosen)
    for row, energy in zip(chosen, np.einsum("rit,rit->rt", green, green).astype(np.float64), strict=True):
        total = float(energy.sum())
        if total == 0.0:
            continue
        share = float(energy[-(bank.taps // 10) :].sum()) / total
        last = 10.0 * math.log10(share) if share > 0 else -math.inf
        if found is None or last > found.last_tenth_db:
            first, second = float(energy[: bank.taps // 2].sum()), float(energy[bank.taps // 2 :].sum())
            ratio = min(second / first, 1.0) if first > 0 else 1.0
            found = ResponseTail(row, last, ratio**2)
    return found
