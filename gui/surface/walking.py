"""Walking from position to position with the arrow keys."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import Qt

STEPS = {
    int(Qt.Key.Key_Left): (-1.0, 0.0),
    int(Qt.Key.Key_Right): (1.0, 0.0),
    int(Qt.Key.Key_Up): (0.0, 1.0),
    int(Qt.Key.Key_Down): (0.0, -1.0),
}


def next_position(position_mm: NDArray[np.float64], here: int, key: int) -> int:
    """The nearest position in an arrow key's direction, within 45 degrees of it; `here` where there is none.

    Parameters
    ----------
    position_mm : float64 array (positions, 2)
        The grid.
    here : int
        Where to start; -1 goes to the middle of the grid.
    key : int
        One of `STEPS`.
    """
    if here < 0:
        return int(np.hypot(*(position_mm - position_mm.mean(axis=0)).T).argmin())
    step = np.array(STEPS[key])
    away_mm = position_mm - position_mm[here]
    along_mm, aside_mm = away_mm @ step, np.abs(away_mm @ step[::-1])
    cost = np.where((along_mm > 0) & (aside_mm <= along_mm), along_mm + aside_mm, np.inf)
    return int(cost.argmin()) if np.isfinite(cost).any() else here
