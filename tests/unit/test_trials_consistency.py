"""Answers that do not fit the experiment are named by line and left out of its statistics; sound ones never are."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from tests.simulated_people import CONSTANT, QUEST, UP_DOWN, Observer, designs, simulate
from wavefocus.trials.analysis.consistency import stored_design, unfit_rows


def facts_of(design, rows):
    """What ``trials.json`` says, as it is read from the file."""
    stimuli = {
        name: {
            key: getattr(one, key)
            for key in ("path", "signal", "speed_mm_s", "amplitude", "plays", "correct", "track")
        } | {"sha256": "0" * 64}
        for name, one in design.stimuli.items()
    }  # fmt: skip
    tables = design.config.model_dump(mode="json", exclude_none=True)
    facts = {"design": tables, "stimuli": stimuli, "trials_sha256": design.sha256, "bank_sha256": rows[0].bank_sha256}
    return json.loads(json.dumps(facts))


@pytest.fixture(scope="module", params=[CONSTANT, UP_DOWN, QUEST])
def experiment(request, tmp_path_factory):
    """A design as it is stored, its facts, and the sound answers of two people."""
    folder = tmp_path_factory.mktemp("people")
    design = designs(folder)[request.param]
    for number, person in enumerate(("P01", "P02")):
        rows = simulate(design, person, Observer("amplitude", -0.5, 8.0), folder / "out", number)
    facts = facts_of(design, rows)
    return stored_design(facts, Path("trials.json")), facts, rows


def named(experiment, rows):
    design, facts, _ = experiment
    return [(one.line, one.reason) for one in unfit_rows(rows, design, facts)]


def test_given_sound_answers_then_every_row_fits_also_where_columns_are_lacking(experiment):
    rows = experiment[2]
    assert named(experiment, rows) == []
    assert named(experiment, [replace(row, correct=None, track="") for row in rows]) == []


CHANGES = {
    "participant": "p01", "block": 7, "trial": 999, "stimulus": "elsewhere", "path": "up", "signal": "hum",
    "speed_mm_s": 1.0, "amplitude": 0.7, "plays": 2, "answer": "up", "reaction_s": -1.0, "onset_within_ms": -1.0,
    "by": "nobody", "answered_at": "yesterday", "stimulus_sha256": "1" * 64, "bank_sha256": "1" * 64,
    "trials_sha256": "1" * 64,
}  # fmt: skip


def test_one_cell_that_is_not_experiment_s_then_its_line_is_left_out_and_no_other(experiment):
    for column, wrong in CHANGES.items():
        rows = list(experiment[2])
        rows[5] = replace(rows[5], **{column: wrong})
        (found,) = named(experiment, rows)
        assert found[0] == 7, column
        assert column.split("_")[0] in found[1]


def test_rows_judged_otherwise_double_or_exchanged_are_left_out_and_others_stay(experiment):
    design, facts, rows = experiment
    for instead, lines in (
        ([replace(rows[5], correct=not rows[5].correct)], [7]),
        ([replace(rows[5], correct=None)], [7]),
        ([rows[5], rows[5]], [8]),
        ([], []),
    ):
        assert [line for line, _ in named(experiment, [*rows[:5], *instead, *rows[6:]])] == lines
    # Two answers exchanged in a fixed order are both left out.
    if design.config.adaptive is None:
        other = next(number for number in range(6, 40) if rows[number].stimulus != rows[5].stimulus)
        changed = list(rows)
        for here, there in ((5, other), (other, 5)):
            changed[here] = replace(rows[there], trial=rows[here].trial)
        assert [line for line, _ in named(experiment, changed)] == [7, other + 2]
    # Where an early version's facts have no stimuli, the rest is held against the design.
    design = stored_design({key: value for key, value in facts.items() if key != "stimuli"}, Path("trials.json"))
    changed = [*rows[:5], replace(rows[5], answer="up"), *rows[6:]]
    assert [one.line for one in unfit_rows(changed, design, facts)] == [7]
