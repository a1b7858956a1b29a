"""Status bits of a position and their words."""

from collections.abc import Sequence
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray


class Status(IntFlag):
    """Status bits of a position, as the bank's contract and scanning vibrometers have them."""

    NOT_MEASURED = 0
    VALID = 1
    OVER_RANGE = 2
    POOR_SIGNAL = 4
    FAILED = 8
    DISABLED = 16


USABLE = Status.VALID | Status.OVER_RANGE | Status.POOR_SIGNAL
"""Bits of a row that holds a measurement."""
DOUBTFUL = Status.OVER_RANGE | Status.POOR_SIGNAL
REFUSED = Status.FAILED | Status.DISABLED

STATUS_WORDS: dict[str, Status] = {
    "not-measured": Status.NOT_MEASURED,
    "valid": Status.VALID,
    "over-range": Status.OVER_RANGE,
    "poor": Status.POOR_SIGNAL,
    "failed": Status.FAILED,
    "disabled": Status.DISABLED,
}


def usable(status: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Rows that hold a measurement that may be used, bool (positions,)."""
    return np.asarray(((status & USABLE) != 0) & ((status & REFUSED) == 0))


def status_words(status: int) -> str:
    """The words of a status, as ``"poor"`` or ``"valid+over-range"``."""
    return "+".join(word for word, bit in STATUS_WORDS.items() if status & bit) or "not-measured"


def status_counts(status: NDArray[np.uint8]) -> dict[str, int]:
    """Positions per status word; a position with several bits counts under each."""
    counts = {word: int(np.count_nonzero(status & bit)) for word, bit in STATUS_WORDS.items() if bit}
    return {"not-measured": int(np.count_nonzero(status == 0)), **counts}


def not_valid(status: NDArray[np.uint8]) -> list[int]:
    """Bank rows that were measured and are not valid, those that a person has excluded left out."""
    return np.flatnonzero((status != 0) & (status & (Status.VALID | Status.DISABLED) == 0)).tolist()


def median_of_pairs(figures: NDArray[np.floating] | None, status: NDArray[np.uint8]) -> float | None:
    """Median of a figure over all measured pairs (position, actuator); None where none is known."""
    if figures is None:
        return None
    known = figures[status > 0]
    known = known[np.isfinite(known)]
    if not known.size:
        return None
    ordered = np.sort(known)  # np.median would load numpy.ma, which `wavefocus status` has no other use for
    return float(np.mean(ordered[[(known.size - 1) // 2, known.size // 2]]))


def row_ranges(rows: Sequence[int]) -> str:
    """Bank rows as ``--positions`` takes them: ``"3,5-9"``."""
    ranges: list[list[int]] = []
    for row in sorted(set(rows)):
        if ranges and row == ranges[-1][1] + 1:
            ranges[-1][1] = row
        else:
            ranges.append([row, row])
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in ranges)
