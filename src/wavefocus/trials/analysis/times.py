"""Reaction times by factor, and the onset error of the presentations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.stats import quantile_test

from wavefocus.trials.analysis.psychometric_fit import Interval
from wavefocus.trials.analysis.shares import all_and_each, factors_of, groups

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, slots=True)
class ReactionTime:
    """Median reaction time of a group of trials.

    participant, factors: See `wavefocus.trials.analysis.shares.Share`.
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
    for code, own in all_and_each(counted):
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
