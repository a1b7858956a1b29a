"""Status bits of the contract: words, and their look on the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gui.shell.theme import LIGHT, Theme
from storage.bank.ledger import DISABLED, FAILED, OVER_RANGE, POOR_SIGNAL, VALID

NOT_MEASURED = 0
DAMAGED = 128  # not in the bank: a row whose checksum does not hold
NOT_GOOD = POOR_SIGNAL | OVER_RANGE | FAILED


@dataclass(frozen=True, slots=True)
class Look:
    """Look of a status: a colour per theme, and pyqtgraph's name of a shape over the cell; empty for none."""

    word: str
    bit: int
    light: str
    dark: str
    symbol: str

    def colour(self, theme: Theme) -> str:
        return (self.light if theme is LIGHT else self.dark) or theme.cell


# A position with several bits has the look of the first of these; colours after Okabe and Ito.
LOOKS = (
    Look("damaged", DAMAGED, "#7d3c98", "#b57edc", "d"),
    Look("disabled", DISABLED, "#8c959f", "#6b7580", "+"),
    Look("failed", FAILED, "#d55e00", "#ff7f3f", "x"),
    Look("over-range", OVER_RANGE, "#cc79a7", "#e29ac6", "s"),
    Look("poor", POOR_SIGNAL, "#e69f00", "#f0b030", "t"),
    Look("valid", VALID, "#0072b2", "#2f8fd0", ""),
    Look("not measured", NOT_MEASURED, "", "", ""),
)


def status_text(status: int) -> str:
    """Status bits in words."""
    return ", ".join(look.word for look in reversed(LOOKS) if status & look.bit) or "not measured"


def look_index(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Index into `LOOKS` of each position."""
    index = np.full(len(status), len(LOOKS) - 1, np.uint8)
    for number in reversed(range(len(LOOKS) - 1)):
        index[(status & LOOKS[number].bit) > 0] = number
    return index
