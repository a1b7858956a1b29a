"""Analysis of an experiment: all statistics of its answers as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.config.trials import AdaptiveTable, TrialsTable
from wavefocus.trials.analysis.consistency import UnfitRow
from wavefocus.trials.analysis.psychometric_fit import PsychometricFit, fit_psychometric
from wavefocus.trials.analysis.statistics import (
    Confusion,
    OnsetErrors,
    ReactionTime,
    Sensitivity,
    Share,
    confusions_of,
    factors_of,
    groups,
    onset_errors_of,
    reaction_times_of,
    sensitivities_of,
    shares_of,
    table_of,
)
from wavefocus.trials.answers import Row
from wavefocus.trials.order import UpDown

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = "wavefocus-trials-analysis"


@dataclass(frozen=True, slots=True)
class Psychometric:
    """The psychometric function of a participant, of one adaptive track or of trials alike in all other factors.

    factor: Column whose levels are the function's.
    factors: Levels of the other factors that part the trials; empty for a track.
    reversals_threshold: Of an up-down staircase, as `wavefocus.trials.order.UpDown.threshold`, in the level's unit.
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
    banks, tables: SHA-256 of the banks and trials files that answers belong to; with more than one of either,
        the answers belong to several experiments.
    left_out: Rows of the file that are no answers of the experiment and are in none of the statistics.
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
    confusions: tuple[Confusion, ...]
    reaction_times: tuple[ReactionTime, ...]
    onset_errors: OnsetErrors | None
    replays: int
    left_out: tuple[UnfitRow, ...] = ()

    def document(self) -> dict[str, Any]:
        """All of it for JSON."""
        return {"format": FORMAT, "format_version": 1, **asdict(self)}


def analysis_of(
    rows: Sequence[Row],
    design: TrialsTable,
    adaptive: AdaptiveTable | None = None,
    left_out: Sequence[UnfitRow] = (),
) -> Analysis:
    """Analyse all answers of an experiment, at least one.

    left_out: Rows that are not among `rows`.
    """
    answers = table_of(rows)
    return Analysis(
        design.name, design.question, design.answers,
        {code: len(own) for code, own in answers.groupby("participant")},
        tuple(sorted(answers.bank_sha256.unique())), tuple(sorted(answers.trials_sha256.unique())),
        shares_of(answers), sensitivities_of(answers, design.answers),
        psychometric_of(answers, design.answers, adaptive), confusions_of(answers, design),
        reaction_times_of(answers), onset_errors_of(answers), int(answers.replays.sum()), tuple(left_out),
    )  # fmt: skip


def psychometric_of(
    answers: DataFrame, names: Sequence[str], table: AdaptiveTable | None = None
) -> tuple[Psychometric, ...]:
    """Psychometric functions of each participant: of each adaptive track, or by a factor with at least five levels.

    names: Answers of the design.
    """
    judged = answers[answers.correct.notna()]
    above = {one: judged[judged[one] > 0.0] for one in ("amplitude", "speed_mm_s")}
    # Where the design is not adaptive a factor needs five levels above 0 that do not decide which answer is right.
    plain = [one for one, some in above.items() if some[one].nunique() >= 5 and not _decides(some, one)]
    factor = table.factor if table else next(iter(plain), None)
    if factor is None:
        return ()
    parting = [other for other in factors_of(judged) if other not in (factor, "plays") and not _decides(judged, other)]
    found = []
    for person, own in groups(judged, ("participant",)):
        guess = table.guess_rate if table else _guess(own, names)
        for levels, part in groups(own, ("track",) if table else parting):
            some = part[part[factor] > 0.0]
            falling = table.harder == "higher" if table else _falls(some, factor)
            if (fit := _fit(some, factor, guess, falling=falling)) is None:
                continue
            reversals = _reversals_threshold(some, table) if table and table.method == "up_down" else None
            factors = {} if table else levels
            found.append(Psychometric(person["participant"], levels.get("track", ""), factors, factor, fit, reversals))
    return tuple(found)


def _decides(answers: DataFrame, factor: str) -> bool:
    """The level of the factor decides which answer is right."""
    right = [set(part.answer) for _, part in groups(answers[answers.correct], (factor,))]
    return all(len(some) == 1 for some in right) and len(set().union(*right)) > 1


def _guess(answers: DataFrame, names: Sequence[str]) -> float:
    """Share of wrong answers to catch trials, with the log-linear correction; without these 1 over the answers."""
    catch = answers.correct[answers.amplitude == 0.0]
    return float((~catch).sum() + 0.5) / (len(catch) + 1.0) if len(catch) else 1.0 / max(len(names), 2)


def _falls(answers: DataFrame, factor: str) -> bool:
    """The share of right answers falls with a speed; with an amplitude it never does."""
    if factor == "amplitude":
        return False
    x = np.log10(answers[factor].to_numpy())
    return bool(np.sum((x - x.mean()) * answers.correct.to_numpy(float)) < 0.0)


def _fit(answers: DataFrame, factor: str, guess: float, *, falling: bool) -> PsychometricFit | None:
    parts = [part for _, part in groups(answers, (factor,))]
    if len(parts) < 2:
        return None
    levels = [float(part[factor].iloc[0]) for part in parts]
    right = [int(part.correct.sum()) for part in parts]
    return fit_psychometric(levels, right, [len(part) for part in parts], guess=guess, falling=falling)


def _reversals_threshold(answers: DataFrame, table: AdaptiveTable) -> float | None:
    """Replay the answers through the staircase; levels that were not reached do not change it."""
    levels = sorted(answers[table.factor].unique().tolist(), reverse=table.harder == "lower")
    staircase = UpDown(table, levels)
    for right in answers.sort_values("trial", kind="stable").correct:
        staircase.answered(bool(right))
    return None if staircase.threshold is None else float(10.0**staircase.threshold)
