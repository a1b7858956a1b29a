"""Simulated people answer: through the whole command on the virtual rig, and many through session and analysis."""

import csv
import json

import numpy as np
import pytest
from scipy.stats import binom

from tests.simulated_people import CONSTANT, PEOPLE, Observer, SimulatedParticipant, coverage, designs
from tests.system.lines import Lines
from tests.unit.trials_files import STROKES
from wavefocus.__main__ import run
from wavefocus.trials.answers import COLUMNS, read_answers
from wavefocus.trials.design import load_trials

TRIALS = f"""
[trials]
name = "felt_or-not"
question = "Which way?"
answers = ["left", "right"]
correct = "path"
familiarise = false
{STROKES}emission = "per_point"
amplitude = [0.0001, 0.0002, 0.0004, 0.0006, 0.001]

[adaptive]
method = "up_down"
factor = "amplitude"
trials = 12
"""


def test_answers_of_a_simulated_participant_are_analysed_into_one_folder(lab, bank, capsys):
    (lab / "trials.toml").write_text(TRIALS, encoding="utf-8")
    out = lab / "out"
    design = load_trials(lab / "trials.toml")
    person = SimulatedParticipant(design, Observer("amplitude", -3.5, 8.0), np.random.default_rng(1))
    files = [lab / "trials.toml", "--bank", lab / "plate.h5", "--rig", lab / "rig.toml", "--out", out]
    with Lines("trials", *map(str, files), "--participant", "A-1", "--lines", "--fast") as session:
        stimulus = ""
        while (event := session.hear("state", "presented", "ended"))["event"] != "ended":
            if event["event"] == "presented":
                stimulus = event["stimulus"]
            elif event["waiting"] == "go_on":
                session.send(order="go_on")
            elif event["waiting"] == "answer":
                session.send(order="answer", choice=person.answer(stimulus))
        assert session.end() == 0

    capsys.readouterr()
    assert run(["analyse", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    result = out / "analysis"
    written = json.loads((result / "analysis.json").read_text(encoding="utf-8"))
    assert printed == written | {"out": str(result)}
    assert sorted(written["files"]) == sorted(
        path.relative_to(result).as_posix() for path in result.rglob("*") if path.is_file()
    )
    rows = read_answers(out)
    assert written["trials"] == {"A-1": len(rows)} == {"A-1": 12}
    (function,) = written["psychometric"]
    assert (function["factor"], function["track"]) == ("amplitude", rows[0].track)
    assert sum(function["fit"]["right"]) == sum(bool(row.correct) for row in rows)
    assert "report.html" in written["files"]

    place = result / "bids" / "sub-A1" / "beh"
    with (place / "sub-A1_task-feltornot_beh.tsv").open(encoding="utf-8") as file:
        table = list(csv.DictReader(file, delimiter="\t"))
    sidecar = json.loads((place / "sub-A1_task-feltornot_beh.json").read_text(encoding="utf-8"))
    assert list(table[0]) == [name for name in COLUMNS if name != "participant"]
    assert set(table[0]) <= set(sidecar)
    assert [int(one["trial"]) for one in table] == list(range(1, 13))
    assert [float(one["reaction_s"]) for one in table] == [row.reaction_s for row in rows]
    people = (result / "bids" / "participants.tsv").read_text(encoding="utf-8").splitlines()
    assert people == ["participant_id\tcode\ttrials", "sub-A1\tA-1\t12"]
    described = json.loads((result / "bids" / "dataset_description.json").read_text(encoding="utf-8"))
    assert {"Name", "BIDSVersion", "DatasetType"} <= set(described)

    assert run(["analyse", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert run(["analyse", str(out), "--force"]) == 0
    (result / "notes.txt").write_text("mine")
    assert run(["analyse", str(out), "--force"]) == 2
    assert (result / "notes.txt").read_text() == "mine"
    assert run(["analyse", str(out), "--out", str(out), "--force"]) == 2
    (out / "trials.json").write_text('{"format": "wavefocus-trials", "design": {"trials": 3}}')
    assert run(["analyse", str(out), "--out", str(lab / "other")]) == 2
    assert run(["analyse", str(lab)]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.smoke
def test_given_some_simulated_people_then_the_intervals_hold_the_truth_in_most(tmp_path):
    people = 5
    found = coverage(designs(tmp_path)[CONSTANT], people, 0.02, tmp_path)
    # One sound analysis in 10,000 would fail here.
    least = binom.ppf(1e-4, people, 0.95)
    assert found.threshold_held >= least
    assert found.slope_held >= least
    assert 0.5 < found.slope_ratio < 2.0


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_200_simulated_people_of_each_design_then_intervals_hold_truth_in_95_of_100(tmp_path):
    for name, design in designs(tmp_path).items():
        found = coverage(design, PEOPLE, 0.02, tmp_path)
        least = 190 if name == CONSTANT else binom.ppf(0.01, PEOPLE, 0.95)
        assert min(found.threshold_held, found.slope_held) >= least, name
