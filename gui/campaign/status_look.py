"""How each status looks on the map: a colour and, where it is not good, a shape, so that colour is never all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gui.campaign.statuses import DISABLED, FAILED, NOT_MEASURED, OVER_RANGE, POOR_SIGNAL, VALID
from gui.shell.theme import LIGHT, Theme


@dataclass(frozen=True, slots=True)
class Look:
    """Look of one status.

    Parameters
    ----------
    word : str
        What the legend calls it.
    bit : int
        Which bit it is.
    light, dark : str
        Colour, after Okabe and Ito.
    symbol : str
        pyqtgraph's name of the shape drawn over the cell; empty for none.
    """

    word: str
    bit: int
    light: str
    dark: str
    symbol: str

    def colour(self, theme: Theme) -> str:
        """The colour in a theme."""
        return self.light if theme is LIGHT else self.dark


# A position with several bits looks like the first of these that it has.
LOOKS = (
    Look("disabled", DISABLED, "#8c959f", "#6b7580", "+"),
    Look("failed", FAILED, "#d55e00", "#ff7f3f", "x"),
    Look("over-range", OVER_RANGE, "#cc79a7", "#e29ac6", "s"),
    Look("poor", POOR_SIGNAL, "#e69f00", "#f0b030", "t"),
    Look("valid", VALID, "#0072b2", "#2f8fd0", ""),
    Look("not measured", NOT_MEASURED, "", "", ""),
)


def look_index(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Which of `LOOKS` each position has."""
    index = np.full(len(status), len(LOOKS) - 1, np.uint8)
    for number in reversed(range(len(LOOKS) - 1)):
        index[(status & LOOKS[number].bit) > 0] = number
    return index
