"""How each status looks on the map: a colour and, where a position is not good, a shape, so that colour is never all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.quality import Status
from gui.theme import LIGHT, Theme


@dataclass(frozen=True, slots=True)
class Look:
    """Look of one status.

    Parameters
    ----------
    word : str
        What the legend calls it.
    bit : Status
        Which bit it is.
    light, dark : str
        Colour, after Okabe and Ito.
    symbol : str
        pyqtgraph's name of the shape drawn over the cell; empty for none.
    """

    word: str
    bit: Status
    light: str
    dark: str
    symbol: str

    def colour(self, theme: Theme) -> str:
        """The colour in a theme."""
        return self.light if theme is LIGHT else self.dark


# A position with several bits looks like the first of these that it has.
LOOKS = (
    Look("disabled", Status.DISABLED, "#8c959f", "#6b7580", "+"),
    Look("failed", Status.FAILED, "#d55e00", "#ff7f3f", "x"),
    Look("over-range", Status.OVER_RANGE, "#cc79a7", "#e29ac6", "s"),
    Look("poor", Status.POOR_SIGNAL, "#e69f00", "#f0b030", "t"),
    Look("valid", Status.VALID, "#0072b2", "#2f8fd0", ""),
    Look("not measured", Status.NOT_MEASURED, "", "", ""),
)


def look_index(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Which of `LOOKS` each position has."""
    index = np.full(len(status), len(LOOKS) - 1, np.uint8)
    for number in reversed(range(len(LOOKS) - 1)):
        index[(status & int(LOOKS[number].bit)) > 0] = number
    return index
