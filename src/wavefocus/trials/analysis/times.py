"""Reaction times by factor, and the onset error of the presentations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.trials.analysis.shares import all_and_each, factors_of, groups

if TYPE_CHECKING:
    from pandas import DataFrame

REPLICATES = 2000


@dataclass(frozen=True, slots=True)
class ReactionTime:
    """Median reaction time of a group of trials.

    participant, factors: See `wavefocus.trials.analysis.shares.Share`.
    of: Trials in it: only right answers where the design has right answers.
    interval: 95 % of the median, percentiles of a bootstrap over these trials (Efron and Tibshirani, An Introduction to
        the Bootstrap, 1993, chapter 13).
    """

    participant: str
    factors: Mapping[str, str]
    of: int
    median_s: float
    interval_s: tuple[float, float]


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
    rng = np.random.default_rng(1)
    times = []
    for code, own in all_and_each(counted):
        for factors in ((), *((factor,) for factor in factors_of(answers))):
            for levels, part in groups(own, factors):
                reaction_s = part.reaction_s.to_numpy()
                medians = np.median(rng.choice(reaction_s, (REPLICATES, len(part))), axis=1)
                low_s, high_s = np.quantile(medians, (0.025, 0.975)).tolist()
                times.append(ReactionTime(code, levels, len(part), float(np.median(reaction_s)), (low_s, high_s)))
    return tuple(times)


def onset_errors_of(answers: DataFrame) -> OnsetErrors | None:
    """Onset errors of all trials; None where no trial has one."""
    errors_ms = answers.onset_error_ms.dropna().to_numpy()
    if not len(errors_ms):
        return None
    low_ms, median_ms, high_ms = np.quantile(errors_ms, (0.025, 0.5, 0.975)).tolist()
    repeated = int((answers.attempts > 1).sum())
    return OnsetErrors(len(errors_ms), low_ms, median_ms, high_ms, float(abs(errors_ms).max()), repeated)
