"""Answers held against the experiment that ``trials.json`` describes; statistics leave out the rows that do not fit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from wavefocus.config.loading import validated
from wavefocus.config.trials import AdaptiveTable, TrialsConfig, TrialsTable
from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import COLUMNS, DEFAULTS, Row
from wavefocus.trials.design import FACTS_OF_A_STIMULUS, Stimulus, TrialsDesign
from wavefocus.trials.order import Order, order_of


@dataclass(frozen=True, slots=True)
class UnfitRow:
    """A row of ``trials.csv`` that is no answer of the experiment: its line, its participant, and the reason."""

    line: int
    participant: str
    reason: str


def stored_design(facts: Mapping[str, Any], file: Path) -> TrialsDesign:
    """The experiment as ``trials.json`` describes it; its stimuli have no scenes.

    facts: Content of the file. Those of an early version name no stimuli.

    Raises InputError: the file was changed by another program.
    """
    tables = facts.get("design")
    if not isinstance(tables, dict):
        raise InputError(f"{file}: design is {tables!r:.40}; put the file that `wavefocus trials` wrote back")
    trials = validated(TrialsTable, tables.get("trials"), f"{file}: design.trials")
    adaptive = None
    if "adaptive" in tables:
        adaptive = validated(AdaptiveTable, tables["adaptive"], f"{file}: design.adaptive")
    config = TrialsConfig.model_construct(trials=trials, adaptive=adaptive, path={}, signal={}, quiet={}, stimuli=())
    stimuli: dict[str, Stimulus] = {}
    try:
        for name, one in facts.get("stimuli", {}).items():
            known = {key: one[key] for key in FACTS_OF_A_STIMULUS}
            stimuli[name] = Stimulus(name=name, **known, scene=None)
    except (AttributeError, KeyError, TypeError):
        raise InputError(f"{file}: stimuli are damaged; put the file that `wavefocus trials` wrote back") from None
    return TrialsDesign(file, config, str(facts.get("trials_sha256", "")), stimuli)


def unfit_rows(rows: Sequence[Row], design: TrialsDesign, facts: Mapping[str, Any]) -> tuple[UnfitRow, ...]:
    """Rows that are no answers of the experiment, in the file's order.

    A row fits if its stimulus is one of the design's and is described as there, its answer is allowed and judged as the
    design judges it, trials file and bank are the experiment's, and it stands where the participant's own order has it.

    rows: All rows of the file, which begin in line 2.
    """
    # A column that the file lacks has its default in every row and says nothing.
    absent = {name for name, default in DEFAULTS.items() if all(getattr(row, name) == default for row in rows)}
    spelt: dict[str, str] = {}
    of_participant: dict[str, list[tuple[int, Row]]] = {}
    found = []
    for line, row in enumerate(rows, 2):
        first = spelt.setdefault(row.participant.casefold(), row.participant)
        if first == row.participant:
            of_participant.setdefault(first, []).append((line, row))
        else:
            found.append(UnfitRow(line, row.participant, f"participant is {row.participant}; earlier rows say {first}"))
    for participant, own in of_participant.items():
        plan = _Plan(design, participant)
        for (line, row), (_, following) in zip(own, [*own[1:], (0, None)], strict=True):
            reasons = list(_reasons(row, design, facts, absent))
            reasons += plan.reasons(row, following, fits=not reasons)
            found += [UnfitRow(line, participant, reason) for reason in reasons[:1]]
    return tuple(sorted(found, key=lambda unfit: unfit.line))


def _reasons(row: Row, design: TrialsDesign, facts: Mapping[str, Any], absent: set[str]) -> Iterator[str]:
    """What is wrong with a row by itself."""
    for name in ("trials_sha256", "bank_sha256"):
        if name in facts and getattr(row, name) != facts[name]:
            yield f"{name} is not that of the experiment; the answer belongs to another"
    answers = design.config.trials.answers
    if row.answer not in answers:
        yield f"answer is {row.answer!r}; allowed: {', '.join(answers)}"
    if row.reaction_s < 0.0 or row.onset_within_ms < 0.0:
        yield "reaction_s or onset_within_ms is below 0"
    if row.by not in COLUMNS["by"]["Levels"]:
        yield f"by is {row.by!r}; allowed: {', '.join(COLUMNS['by']['Levels'])}"
    try:
        datetime.fromisoformat(row.answered_at)
    except ValueError:
        yield f"answered_at is {row.answered_at!r}; a time by ISO 8601 is needed"
    if not design.stimuli:
        return
    stimulus = design.stimuli.get(row.stimulus)
    if stimulus is None:
        yield f"stimulus is {row.stimulus!r}, which the experiment does not have"
        return
    for name in FACTS_OF_A_STIMULUS:
        if name not in ("correct", *absent) and getattr(row, name) != getattr(stimulus, name):
            yield f"{name} is {getattr(row, name)!r}; the stimulus {row.stimulus} has {getattr(stimulus, name)!r}"
    if row.stimulus_sha256 != facts["stimuli"][row.stimulus].get("sha256", row.stimulus_sha256):
        yield f"stimulus_sha256 is not that of the stimulus {row.stimulus}"
    right = None if stimulus.correct is None else row.answer == stimulus.correct
    if "correct" not in absent and row.correct is not right:
        yield f"correct is {row.correct!r}; the answer {row.answer!r} to {row.stimulus} gives {right!r}"


class _Plan:
    """The order of a participant's trials, followed row by row.

    The levels of an adaptive design follow from the answers: after a row that is missing or does not fit they are
    unknown, and only the numbers of trials are held against the order.
    """

    def __init__(self, design: TrialsDesign, participant: str) -> None:
        self._order: Order | None = order_of(design, participant) if design.stimuli else None
        self._adaptive = design.config.adaptive is not None
        self._due = 1

    def reasons(self, row: Row, following: Row | None, *, fits: bool) -> Iterator[str]:
        """Why a row does not stand where the order has it.

        following: The participant's next row. Where it goes on from this one, rows before this one are missing.
        fits: Whether the row fits by itself.
        """
        goes_on = following is not None and following.trial == row.trial + 1
        if row.trial < self._due or (row.trial > self._due and not goes_on):
            yield f"trial {row.trial} stands where trial {self._due} is due"
            return
        if row.trial > self._due and self._adaptive:
            self._order = None
        while self._order is not None and self._due < row.trial and self._order.next_trial() is not None:
            self._order.answered("")
            self._due += 1
        self._due = row.trial + 1
        if self._order is None:
            return
        trial = self._order.next_trial()
        if trial is None:
            yield f"trial {row.trial} is beyond the last of the experiment"
        elif (trial.block, trial.stimulus) != (row.block, row.stimulus):
            yield f"trial {row.trial} is {trial.stimulus}, block {trial.block}, in the order of {row.participant}"
        if self._adaptive and (trial is None or trial.stimulus != row.stimulus or not fits):
            self._order = None
        elif trial is not None:
            self._order.answered(row.answer)
