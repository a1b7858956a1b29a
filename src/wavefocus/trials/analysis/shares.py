"""Shares of right answers, or of each answer, by factor, with Wilson's intervals; answers as a table of pandas."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

from wavefocus.trials.answers import Row

if TYPE_CHECKING:
    from pandas import DataFrame, Series

FACTORS = ("speed_mm_s", "amplitude", "path", "signal", "plays")
"""Columns that may be factors, in the order in which they are tabled."""
RIGHT = "right"


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


def table_of(rows: Sequence[Row]) -> DataFrame:
    """Answers, a column per field of `Row`; missing numbers are NaN; `correct` is NA where no answer is right."""
    import pandas as pd

    return pd.DataFrame(rows).astype({"speed_mm_s": float, "onset_error_ms": float, "correct": "boolean"})


def shares_of(answers: DataFrame) -> tuple[Share, ...]:
    """Shares of all participants together and of each: of all trials, by factor, and by pairs of factors.

    The interval of all together takes each answer as independent of the others.
    """
    combined = ((), *combinations_of(answers))
    return tuple(
        share
        for code, own in all_and_each(answers)
        for factors in combined
        for levels, part in groups(own, factors)
        for share in _outcomes(own, part, code, levels)
    )


def all_and_each(answers: DataFrame) -> Iterator[tuple[str, DataFrame]]:
    """All answers, under an empty code, then those of each participant."""
    yield "", answers
    yield from answers.groupby("participant")


def groups(answers: DataFrame, columns: Sequence[str]) -> Iterator[tuple[dict[str, str], DataFrame]]:
    """Answers by levels of columns, at least one in each group: numbers rising, then texts by the alphabet."""
    if not columns and len(answers):
        yield {}, answers
    if columns:
        for levels, part in answers.groupby([_levels(answers[column]) for column in columns], observed=True):
            yield dict(zip(columns, levels, strict=True)), part


def factors_of(answers: DataFrame) -> tuple[str, ...]:
    """Factors with more than one level; of two that part the trials alike, the first."""
    levels = {factor: _levels(answers[factor]) for factor in FACTORS}
    found = {levels[factor].factorize()[0].tobytes(): factor for factor in reversed(FACTORS)}
    return tuple(factor for factor in FACTORS if factor in found.values() and levels[factor].nunique() > 1)


def combinations_of(answers: DataFrame) -> tuple[tuple[str, ...], ...]:
    """Single factors, and pairs of those that are not given by another factor, as signals may be by the speed."""

    def count(*columns: str) -> int:
        return sum(1 for _ in groups(answers, columns))

    factors = factors_of(answers)
    given = {
        factor for factor in factors for other in factors if factor != other and count(factor, other) == count(other)
    }
    return (*((factor,) for factor in factors), *combinations([factor for factor in factors if factor not in given], 2))


def _outcomes(own: DataFrame, part: DataFrame, code: str, levels: Mapping[str, str]) -> Iterator[Share]:
    """Shares of a group of a participant's answers."""
    from scipy.stats import binomtest

    judged = part.correct.dropna()
    if len(judged):
        counts, total = {RIGHT: int(judged.sum())}, len(judged)
    else:
        counts, total = {name: int((part.answer == name).sum()) for name in sorted(own.answer.unique())}, len(part)
    for outcome, count in counts.items():
        # Wilson, J. Am. Stat. Assoc. 22 (1927), 209.
        low, high = binomtest(count, total).proportion_ci(method="wilson")
        yield Share(code, levels, outcome, count, total, count / total, (float(low), float(high)))


def _levels(column: Series) -> Series:
    """Levels of a column as ordered texts; empty where a trial has none."""
    import pandas as pd

    texts = column.map(lambda value: "" if pd.isna(value) else f"{value:g}" if isinstance(value, float) else str(value))
    return texts.astype(pd.CategoricalDtype(sorted(texts.unique(), key=_order), ordered=True))


def _order(level: str) -> tuple[bool, float, str]:
    try:
        return False, float(level), ""
    except ValueError:
        return True, 0.0, level
