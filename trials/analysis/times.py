"""Reaction times by factor, and the onset error of the presentations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.trials.analysis.shares import factors_of, grouped
from wavefocus.trials.answers import Row

REPLICATES = 2000


@dataclass(frozen=True, slots=True)
class ReactionTime:
    """Median reaction time of a group of trials.

    participant, factors: As of `wavefocus.trials.analysis.shares.Share`.
    of: Trials in it: right answers alone where the design has right answers.
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


def reaction_times_of(rows: Sequence[Row]) -> tuple[ReactionTime, ...]:
    """Median reaction times of all participants together and of each: of all trials, and by factor."""
    counted = [row for row in rows if row.correct is not False]
    rng = np.random.default_rng(1)
    found = []
    for code in ("", *sorted({row.participant for row in counted})):
        some = [row for row in counted if code in ("", row.participant)]
        for factors in ((), *((one,) for one in factors_of(rows))):
            for levels, part in grouped(some, factors).items():
                times_s = np.array([row.reaction_s for row in part])
                medians = np.median(rng.choice(times_s, (REPLICATES, len(times_s))), axis=1)
                low_s, high_s = (float(one) for one in np.quantile(medians, (0.025, 0.975)))
                named = dict(zip(factors, levels, strict=True))
                found.append(ReactionTime(code, named, len(part), float(np.median(times_s)), (low_s, high_s)))
    return tuple(found)


def onset_errors_of(rows: Sequence[Row]) -> OnsetErrors | None:
    """Onset errors of all trials; None where no trial has one."""
    errors_ms = np.array([row.onset_error_ms for row in rows if row.onset_error_ms is not None])
    if not len(errors_ms):
        return None
    low_ms, median_ms, high_ms = (float(one) for one in np.quantile(errors_ms, (0.025, 0.5, 0.975)))
    repeated = sum(row.attempts > 1 for row in rows)
    return OnsetErrors(len(errors_ms), low_ms, median_ms, high_ms, float(abs(errors_ms).max()), repeated)
