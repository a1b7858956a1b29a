"""Analysis of an experiment: all statistics of its answers, as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wavefocus.config.trials import AdaptiveTable, TrialsTable
from wavefocus.trials.adaptive import UpDown
from wavefocus.trials.analysis.mixed_model import MixedModel, fit_mixed_model
from wavefocus.trials.analysis.psychometric_fit import PsychometricFit, fit_psychometric
from wavefocus.trials.analysis.sensitivity import Sensitivity, sensitivities_of
from wavefocus.trials.analysis.shares import Share, factors_of, grouped, shares_of
from wavefocus.trials.analysis.times import OnsetErrors, ReactionTime, onset_errors_of, reaction_times_of
from wavefocus.trials.answers import Row

FORMAT = "wavefocus-trials-analysis"
FEWEST_LEVELS = 5
"""Levels above 0 from which a factor gets a psychometric function where the design is not adaptive."""


@dataclass(frozen=True, slots=True)
class Psychometric:
    """The psychometric function of a participant, of one adaptive track or of trials alike in all other factors.

    factor: Column whose levels are the function's.
    factors: Levels of the other factors that part the trials; empty for a track.
    reversals_threshold: Of an up-down staircase, as `wavefocus.trials.adaptive.UpDown.threshold`, in the level's unit.
    """

    participant: str
    track: str
    factors: Mapping[str, str]
    factor: str
    fit: PsychometricFit
    reversals_threshold: float | None


@dataclass(frozen=True, slots=True)
class Analysis:
    """Statistics of an experiment.

    name, question, answers: Of the experiment; answers in their order on the screen.
    trials: By participant, the number that is answered.
    banks, tables: SHA-256 of the banks and trials files that answers belong to; more than one of either is no one
        experiment.
    """

    name: str
    question: str
    answers: tuple[str, ...]
    trials: Mapping[str, int]
    banks: tuple[str, ...]
    tables: tuple[str, ...]
    shares: tuple[Share, ...]
    sensitivities: tuple[Sensitivity, ...]
    psychometric: tuple[Psychometric, ...]
    reaction_times: tuple[ReactionTime, ...]
    onset_errors: OnsetErrors | None
    replays: int
    mixed_model: MixedModel | None = None

    def document(self) -> dict[str, Any]:
        """All of it for JSON."""
        return {"format": FORMAT, "format_version": 1, **asdict(self)}


def analysis_of(
    rows: Sequence[Row], design: TrialsTable, adaptive: AdaptiveTable | None = None, *, mixed_model: bool = False
) -> Analysis:
    """Analyse all answers of an experiment, at least one.

    Raises InputError: the mixed model is asked for and cannot be fitted.
    """
    codes = sorted({row.participant for row in rows})
    return Analysis(
        design.name,
        design.question,
        design.answers,
        {code: sum(row.participant == code for row in rows) for code in codes},
        tuple(sorted({row.bank_sha256 for row in rows})),
        tuple(sorted({row.trials_sha256 for row in rows})),
        shares_of(rows),
        sensitivities_of(rows, design.answers),
        psychometric_of(rows, design.answers, adaptive),
        reaction_times_of(rows),
        onset_errors_of(rows),
        sum(row.replays for row in rows),
        fit_mixed_model(rows) if mixed_model else None,
    )


def psychometric_of(
    rows: Sequence[Row], answers: Sequence[str], table: AdaptiveTable | None = None
) -> tuple[Psychometric, ...]:
    """Psychometric functions of each participant: of each adaptive track, or by a factor with at least five levels."""
    judged = [row for row in rows if row.correct is not None]
    factor = table.factor if table else _factor(judged)
    if factor is None:
        return ()
    parting = [one for one in factors_of(judged) if one not in (factor, "plays") and not _decides(judged, one)]
    found = []
    for code, *_ in grouped(judged, ("participant",)):
        own = [row for row in judged if row.participant == code]
        guess = table.guess_rate if table else _guess(own, answers)
        for levels, part in grouped(own, ("track",) if table else parting).items():
            some = [row for row in part if (getattr(row, factor) or 0.0) > 0.0]
            falling = table.harder == "higher" if table else _falls(some, factor)
            if (fit := _fit(some, factor, guess, falling=falling)) is None:
                continue
            factors = {} if table else dict(zip(parting, levels, strict=True))
            reversals = _reversals_threshold(some, table) if table and table.method == "up_down" else None
            found.append(Psychometric(code, levels[0] if table else "", factors, factor, fit, reversals))
    return tuple(found)


def _factor(rows: Sequence[Row]) -> str | None:
    """The factor of constant stimuli."""
    for factor in ("amplitude", "speed_mm_s"):
        if len({getattr(row, factor) for row in rows if (getattr(row, factor) or 0.0) > 0.0}) >= FEWEST_LEVELS:
            return factor
    return None


def _decides(rows: Sequence[Row], factor: str) -> bool:
    """The level of the factor decides which answer is right."""
    right = grouped([row for row in rows if row.correct], (factor,)).values()
    answers = [{row.answer for row in some} for some in right]
    return all(len(some) == 1 for some in answers) and len(set.union(*answers)) > 1 if answers else False


def _guess(rows: Sequence[Row], answers: Sequence[str]) -> float:
    """Share of wrong answers to catch trials, with the log-linear correction; without these 1 over the answers."""
    catch = [row for row in rows if row.amplitude == 0.0]
    if catch:
        return (sum(not row.correct for row in catch) + 0.5) / (len(catch) + 1.0)
    return 1.0 / max(len(answers), 2)


def _falls(rows: Sequence[Row], factor: str) -> bool:
    """The share of right answers falls with a speed; with an amplitude it never does."""
    if factor == "amplitude":
        return False
    x = np.log10([getattr(row, factor) for row in rows])
    return bool(np.sum((x - x.mean()) * np.array([bool(row.correct) for row in rows])) < 0.0)


def _fit(rows: Sequence[Row], factor: str, guess: float, *, falling: bool) -> PsychometricFit | None:
    counts = {getattr(some[0], factor): (sum(bool(row.correct) for row in some), len(some))
              for some in grouped(rows, (factor,)).values()}  # fmt: skip
    if len(counts) < 2:
        return None
    right, of = zip(*counts.values(), strict=True)
    return fit_psychometric(list(counts), right, of, guess=guess, falling=falling)


def _reversals_threshold(rows: Sequence[Row], table: AdaptiveTable) -> float | None:
    """Replay the answers through the staircase; levels that were not reached do not change it."""
    levels = sorted({getattr(row, table.factor) for row in rows}, reverse=table.harder == "lower")
    staircase = UpDown(table, levels)
    for row in sorted(rows, key=lambda one: one.trial):
        staircase.answered(bool(row.correct))
    return None if staircase.threshold is None else float(10.0**staircase.threshold)
