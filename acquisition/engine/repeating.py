"""How a position is tried again: with which range, and with the mirror where.

Nothing here remembers anything from one position to the next: a campaign that was killed and resumed must try
each position exactly as one that was not. So every position starts at the configured range, in place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from acquisition.engine.attempt import Attempt
from acquisition.engine.setup import Setup
from acquisition.quality.defects import Cure
from acquisition.quality.judgement import Judgement
from acquisition.quality.limits import QualityLimits
from drivers.protocols import Float64Array
from storage.point_status import Status

# Steps aside, in units of the speckle step, towards the middle of the surface: there is no rim and no mirror limit.
STEPS = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2), (2, 2))
# After so many positions in a row that a pass could not make valid it is not the positions.
FUTILE_IN_A_ROW = 10


def next_attempt(
    attempt: Attempt,
    judgement: Judgement,
    earlier: Status,
    setup: Setup,
    limits: QualityLimits,
    place_mm: Float64Array,
    *,
    joint: bool = False,
) -> Attempt:
    """The try after one that was not good enough.

    Over-range takes the next larger range. A signal that was lost in several records, or twice at one place, is
    looked for a fraction of a millimetre aside, for speckle is that fine; all else is tried again in place.

    Parameters
    ----------
    attempt : Attempt
        The try that was not good enough.
    judgement : Judgement
        Why.
    earlier : Status
        Bits of the tries at this position before it, in this session.
    setup : Setup
        Knows the recorder's ranges.
    limits : QualityLimits
        How far a step aside is.
    place_mm : float64 array, shape (2,)
        The position.
    joint : bool
        Whether several actuators sound in a record: then one loss shows in all of them, and is tried again in place.

    Returns
    -------
    Attempt
    """
    following = attempt.next()
    if judgement.status & Status.OVER_RANGE:
        used_v = attempt.response_range_v or setup.range_v[1]
        larger_v = min((one for one in setup.response_ranges_v if one > used_v * (1 + 1e-9)), default=used_v)
        following = replace(following, response_range_v=larger_v)
    dark = not joint and any(defect.cure is Cure.MOVE for defect in judgement.defects)
    again = judgement.status & earlier & Status.POOR_SIGNAL and any(
        defect.cure in (Cure.MOVE, Cure.REPEAT) and not defect.over_range for defect in judgement.defects
    )
    if dark or again:
        following = replace(following, moved_mm=_aside_mm(following.number, limits.speckle_step_mm, place_mm))
    return following


def is_final(attempt: Attempt, judgement: Judgement, limits: QualityLimits) -> bool:
    """Whether no further try follows in this round: it is good, the tries are used up, or none can help."""
    hopeless = judgement.cure is Cure.NOTHING and not judgement.status & Status.OVER_RANGE
    return judgement.good or hopeless or attempt.of_session >= limits.max_attempts


def first_attempts(rows: Sequence[int] | NDArray[np.int64], attempts: NDArray[np.int64]) -> Iterator[Attempt]:
    """The first try of a session at each of some positions."""
    for row in rows:
        yield Attempt(int(row), int(attempts[row]) + 1, 1)


def attempts_again(
    order: NDArray[np.int64],
    status: NDArray[np.uint8],
    attempts: NDArray[np.int64],
    setup: Setup,
    limits: QualityLimits,
) -> list[Attempt]:
    """The tries of the next pass over all that is not valid, if there is one.

    Which positions have had a pass shows in the numbers of their tries alone: pass `n` counts from
    ``n * max_attempts + 1``, however few tries came before. So a campaign that is killed in a pass goes on where
    it was. What was over-range starts with the largest range.

    Parameters
    ----------
    order : int64 array, shape (positions,)
        Bank rows that the session covers, in the order of measurement.
    status, attempts : arrays, shape (positions,)
        As the bank has them.
    setup : Setup
        Knows the recorder's ranges.
    limits : QualityLimits
        How many tries a round has, and how many passes there are.
    """
    usable = (status[order] != 0) & (status[order] & (Status.VALID | Status.DISABLED) == 0)
    for number in range(1, limits.remeasure_pass + 1):
        before = number * limits.max_attempts
        due = order[usable & (attempts[order] <= before)]
        if due.size:
            if is_futile(order, status, attempts, before):
                return []
            widest_v = setup.widest_response_v
            return [
                Attempt(int(row), before + 1, 1, response_range_v=widest_v if status[row] & Status.OVER_RANGE else None)
                for row in due
            ]
    return []


def is_futile(order: NDArray[np.int64], status: NDArray[np.uint8], attempts: NDArray[np.int64], before: int) -> bool:
    """Whether the latest positions that a pass measured again have all stayed as they were.

    Parameters
    ----------
    order, status, attempts
        As of `attempts_again`.
    before : int
        Tries that a position can have had before the pass.
    """
    latest = order[attempts[order] > before][-FUTILE_IN_A_ROW:]
    return latest.size == FUTILE_IN_A_ROW and not np.any(status[latest] & Status.VALID)


def _aside_mm(number: int, step_mm: float, place_mm: Float64Array) -> tuple[float, float]:
    """How far the mirror moves for this try, towards the middle of the surface."""
    x, y = STEPS[(number - 2) % len(STEPS)]
    return -math.copysign(x * step_mm, place_mm[0]), -math.copysign(y * step_mm, place_mm[1])
