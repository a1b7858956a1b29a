"""Which answer was given where which was right: the confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from wavefocus.config.trials import TrialsTable
from wavefocus.trials.analysis.shares import groups
from wavefocus.trials.design import written_level

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, slots=True)
class Confusion:
    """Answers of a participant; of all together where `participant` is empty.

    counts: Of each right answer, in the order of the design's answers, how often each answer was given, in that order.
    """

    participant: str
    counts: tuple[tuple[int, ...], ...]

    @property
    def right(self) -> int:
        """Right answers."""
        return sum(row[index] for index, row in enumerate(self.counts))


def confusions_of(answers: DataFrame, design: TrialsTable) -> tuple[Confusion, ...]:
    """Confusion matrices of all together and of each participant; none where no answer is right or wrong."""
    if design.correct is None:
        return ()
    levels = answers[design.correct].map(written_level)
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
