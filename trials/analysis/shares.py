"""Shares of right answers, or of each answer, by factor, with Wilson's intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from wavefocus.trials.answers import Row

FACTORS = ("speed_mm_s", "amplitude", "path", "signal", "plays")
"""Columns that may be factors, in the order in which they are tabled."""
RIGHT = "right"
Z_95 = 1.959963984540054
"""95 % of a normal distribution lie within so many standard deviations."""


@dataclass(frozen=True, slots=True)
class Share:
    """A share of answers, with its 95 % interval.

    participant: Code; empty for all together.
    factors: Levels of the factors that the trials have in common; empty for all trials.
    outcome: `RIGHT`, or an answer where the design has no right one.
    """

    participant: str
    factors: Mapping[str, str]
    outcome: str
    count: int
    of: int
    share: float
    interval: tuple[float, float]


def wilson(count: int, of: int, z: float = Z_95) -> tuple[float, float]:
    """Score interval of a share, by default of 95 % (Wilson, J. Am. Stat. Assoc. 22 (1927), 209).

    Centre (p + z^2 / 2n) / (1 + z^2 / n), half width z sqrt(p (1 - p) / n + z^2 / 4n^2) / (1 + z^2 / n).
    """
    share, scale = count / of, 1.0 + z * z / of
    centre = (share + z * z / (2 * of)) / scale
    half = z * math.sqrt(share * (1.0 - share) / of + z * z / (4 * of * of)) / scale
    # Rounding may leave the ends of 0 and 1 beside them.
    return 0.0 if count == 0 else centre - half, 1.0 if count == of else centre + half


def level_of(row: Row, factor: str) -> str:
    """Level of a factor as text; empty where the trial has none."""
    value = getattr(row, factor)
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def factors_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """Factors with more than one level that part the trials each in a way of its own."""
    found: dict[NDArray[np.int64] | bytes, str] = {}
    for factor in FACTORS:
        parts = _parts(rows, (factor,))
        if parts.max(initial=0) > 0:
            found.setdefault(parts.tobytes(), factor)
    return tuple(found.values())


def combinations_of(rows: Sequence[Row]) -> tuple[tuple[str, ...], ...]:
    """Single factors, and pairs of those that are not given by another factor, as signals may be by the speed."""
    factors = factors_of(rows)
    count = {one: _parts(rows, one).max(initial=0) for size in (1, 2) for one in combinations(factors, size)}
    given = {one for pair in count if len(pair) == 2 for one in pair
             if count[pair] == count[(pair[1],) if one == pair[0] else (pair[0],)]}  # fmt: skip
    free = [one for one in factors if one not in given]
    return (*((one,) for one in factors), *combinations(free, 2))


def shares_of(rows: Sequence[Row]) -> tuple[Share, ...]:
    """Shares of all participants together and of each: of all trials, by factor, and by pairs of factors.

    The interval of all together takes each answer as independent of the others.
    """
    codes = sorted({row.participant for row in rows})
    combined = ((), *combinations_of(rows))
    return tuple(
        share
        for code in ("", *codes)
        for factors in combined
        for share in _table([row for row in rows if code in ("", row.participant)], code, factors)
    )


def grouped(rows: Sequence[Row], factors: Sequence[str]) -> dict[tuple[str, ...], list[Row]]:
    """Rows by levels of factors: numbers rising, then texts by the alphabet."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(level_of(row, factor) for factor in factors), []).append(row)
    return dict(sorted(found.items(), key=lambda one: tuple(map(_order, one[0]))))


def _table(rows: Sequence[Row], code: str, factors: tuple[str, ...]) -> Iterator[Share]:
    for levels, some in grouped(rows, factors).items():
        named = dict(zip(factors, levels, strict=True))
        judged = [row for row in some if row.correct is not None]
        if judged:
            yield _share(code, named, RIGHT, sum(bool(row.correct) for row in judged), len(judged))
            continue
        for answer in sorted({row.answer for row in rows}):
            yield _share(code, named, answer, sum(row.answer == answer for row in some), len(some))


def _share(code: str, factors: Mapping[str, str], outcome: str, count: int, of: int) -> Share:
    return Share(code, factors, outcome, count, of, count / of, wilson(count, of))


def _parts(rows: Sequence[Row], factors: tuple[str, ...]) -> NDArray[np.int64]:
    """Number of the part that each trial belongs to, by first appearance."""
    seen: dict[tuple[str, ...], int] = {}
    return np.array(
        [seen.setdefault(tuple(level_of(row, one) for one in factors), len(seen)) for row in rows], np.int64
    )


def _order(level: str) -> tuple[bool, float, str]:
    try:
        return False, float(level), ""
    except ValueError:
        return True, 0.0, level
