"""Figures by factor: shares with Wilson's intervals, sensitivity d', confusion matrix, reaction times, onset errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import quantile_test

from wavefocus.config.trials import TrialsTable
from wavefocus.trials.analysis.psychometric_fit import Interval
from wavefocus.trials.answers import Row
from wavefocus.trials.design import written_level

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
        for code, own in _all_and_each(answers)
        for factors in combined
        for levels, part in groups(own, factors)
        for share in _outcomes(own, part, code, levels)
    )


def _all_and_each(answers: DataFrame) -> Iterator[tuple[str, DataFrame]]:
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


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Sensitivity of one group of trials.

    participant, factors: See `wavefocus.trials.analysis.statistics.Share`.
    signal, noise: The answers that are right in the two kinds of trials.
    hits, of_signal: Answers `signal` in trials where that is right, and all those trials.
    false_alarms, of_noise: Answers `signal` in trials where `noise` is right, and all those trials.
    criterion: Positive where `noise` is preferred.
    """

    participant: str
    factors: Mapping[str, str]
    signal: str
    noise: str
    hits: int
    of_signal: int
    false_alarms: int
    of_noise: int
    d_prime: float
    interval: tuple[float, float]
    criterion: float


def d_prime(hits: int, of_signal: int, false_alarms: int, of_noise: int) -> tuple[float, tuple[float, float], float]:
    """Sensitivity d' = z(H) - z(F), its 95 % interval, and criterion c = -(z(H) + z(F)) / 2 of one interval.

    H = (hits + 1/2) / (of_signal + 1), F alike: log-linear correction (Hautus, Behav. Res. Methods 27 (1995), 46).
    Interval: d' +- 1.96 of the root of H (1 - H) / (n phi(z(H))^2), summed with the same of F (Gourevitch and Galanter,
    Psychometrika 32 (1967), 25), with n the number of trials and phi the normal density.
    """
    from scipy.stats import norm

    total = np.array([of_signal, of_noise])
    rate = (np.array([hits, false_alarms]) + 0.5) / (total + 1.0)
    z = norm.ppf(rate)
    spread = np.sum(rate * (1.0 - rate) / (total * norm.pdf(z) ** 2))
    value, half = float(z[0] - z[1]), float(norm.ppf(0.975) * np.sqrt(spread))
    return value, (value - half, value + half), float(-0.5 * (z[0] + z[1]))


def sensitivities_of(answers: DataFrame, names: Sequence[str]) -> tuple[Sensitivity, ...]:
    """Sensitivity of all participants together and of each, of all trials and by factor, where there are two answers.

    names: Answers of the design, in its order. The signal is the answer that is right where the amplitude is above 0,
        in a design with catch trials (amplitude 0); these then are the noise trials of every level of the amplitude.
        Else it is the second answer, and levels of factors count where either answer is right in some of their trials.

    Empty where answers are not two, or only one is ever right.
    """
    import pandas as pd

    judged = answers[answers.correct.notna()]
    if len(names) != 2 or not len(judged):
        return ()
    other = judged.answer.map(lambda answer: names[1] if answer == names[0] else names[0])
    judged = judged.assign(right=judged.answer.where(judged.correct.astype(bool), other))
    catch = judged[judged.amplitude == 0.0]
    signal = names[int(catch.right.iloc[0] == names[0])] if len(catch) else names[1]
    noise = names[int(signal == names[0])]
    found = []
    for code, own in _all_and_each(judged):
        for levels, part in [({}, own), *(group for factor in factors_of(judged) for group in groups(own, (factor,)))]:
            catch = own[own.amplitude == 0.0] if levels.get("amplitude", "0") != "0" else own[:0]
            pair = pd.concat([part, catch])
            with_signal, answered = pair.right == signal, pair.answer == signal
            hits, alarms = int((answered & with_signal).sum()), int((answered & ~with_signal).sum())
            counts = hits, int(with_signal.sum()), alarms, int((~with_signal).sum())
            if counts[1] and counts[3]:
                found.append(Sensitivity(code, levels, signal, noise, *counts, *d_prime(*counts)))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Confusion:
    """Answers of a participant; of all together where `participant` is empty.

    counts: Of each right answer, in the order of the design's answers, how often each answer was given, in that order.
    """

    participant: str
    counts: tuple[tuple[int, ...], ...]


def confusions_of(answers: DataFrame, design: TrialsTable) -> tuple[Confusion, ...]:
    """Confusion matrices of all together and of each participant; none where no answer is right or wrong."""
    import pandas as pd

    if design.correct is None:
        return ()
    levels = answers[design.correct].map(lambda level: written_level(None if pd.isna(level) else level))
    judged = answers.assign(right=levels.map(lambda level: design.correct_levels.get(level, level)))
    people = [] if judged.participant.nunique() < 2 else list(groups(judged, ("participant",)))
    return (
        Confusion("", _counts(judged, design.answers)),
        *(Confusion(person["participant"], _counts(own, design.answers)) for person, own in people),
    )


def _counts(answers: DataFrame, names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    import pandas as pd

    table = pd.crosstab(answers.right, answers.answer).reindex(index=names, columns=names, fill_value=0)
    return tuple(tuple(int(count) for count in row) for row in table.to_numpy())


@dataclass(frozen=True, slots=True)
class ReactionTime:
    """Median reaction time of a group of trials.

    participant, factors: See `wavefocus.trials.analysis.statistics.Share`.
    of: Trials in it: only right answers where the design has right answers.
    interval_s: 95 % of the median, by order statistics (`scipy.stats.quantile_test`); None at an end that so few trials
        leave open.
    """

    participant: str
    factors: Mapping[str, str]
    of: int
    median_s: float
    interval_s: Interval


@dataclass(frozen=True, slots=True)
class OnsetErrors:
    """Onset errors of the presentations that were answered.

    of: Trials that have one; the 2.5 %, 50 % and 97.5 % quantiles, and the largest magnitude.
    repeated: Trials that were presented anew since an instrument was lost or the onset was not found.
    """

    of: int
    low_ms: float
    median_ms: float
    high_ms: float
    largest_ms: float
    repeated: int


def reaction_times_of(answers: DataFrame) -> tuple[ReactionTime, ...]:
    """Median reaction times of all participants together and of each: of all trials, and by factor."""
    counted = answers[answers.correct.fillna(True)]
    times = []
    for code, own in _all_and_each(counted):
        for factors in ((), *((factor,) for factor in factors_of(answers))):
            for levels, part in groups(own, factors):
                reaction_s = part.reaction_s.to_numpy()
                times.append(
                    ReactionTime(code, levels, len(part), float(np.median(reaction_s)), _median_interval(reaction_s))
                )
    return tuple(times)


def _median_interval(values: NDArray[np.float64]) -> Interval:
    ends = np.asarray(quantile_test(values, q=0.0, p=0.5).confidence_interval(0.95)).tolist()
    low, high = (None if math.isnan(end) else end for end in ends)
    return low, high


def onset_errors_of(answers: DataFrame) -> OnsetErrors | None:
    """Onset errors of all trials; None where no trial has one."""
    errors_ms = answers.onset_error_ms.dropna().to_numpy()
    if not len(errors_ms):
        return None
    low_ms, median_ms, high_ms = np.quantile(errors_ms, (0.025, 0.5, 0.975)).tolist()
    repeated = int((answers.attempts > 1).sum())
    return OnsetErrors(len(errors_ms), low_ms, median_ms, high_ms, float(abs(errors_ms).max()), repeated)
