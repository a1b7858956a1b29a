"""Whole experiments through the command, answered by a program: what is stored, refused, repeated and muted."""

import json

import pytest

from tests.system.conftest import with_faults, write_lab
from tests.system.lines import Lines
from tests.unit.trials_files import STROKES
from wavefocus.__main__ import run
from wavefocus.trials.answers import AnswersFile, read_answers, read_facts

TRIALS = f"""
[trials]
question = "Which way?"
answers = ["left", "right"]
keys = ["Left", "Right"]
correct = "path"
repetitions = 4
blocks = 2
{STROKES}emission = "per_point"
amplitude = 0.001
"""

MASKING = "\n[masking]\noutput = 5\nrms_v = 0.2\n"


def arguments(lab):
    """The command line of a lab's experiment for its first participant."""
    files = [lab / "trials.toml", "--bank", lab / "plate.h5", "--rig", lab / "rig.toml", "--out", lab / "out"]
    return ["trials", *map(str, files), "--participant", "P1"]


@pytest.fixture
def experiment(lab, bank):
    """The same, its trials file and bank written."""
    (lab / "trials.toml").write_text(TRIALS, encoding="utf-8")
    return arguments(lab)


def answer(session, choice="right"):
    """Go on and answer until the session ends; its events."""
    events = []
    while True:
        events.append(session.hear("state", "stored", "presented", "ended", "refused"))
        match events[-1]["event"], events[-1].get("waiting"):
            case "state", "go_on":
                session.send(order="go_on")
            case "state", "answer":
                session.send(order="answer", choice=choice)
            case "ended", _:
                return events


def test_a_window_closed_while_a_stimulus_sounds_is_muted_and_resumed(tmp_path, capsys):
    lab = write_lab(tmp_path)
    purpose = 'purpose = "presentation"\n'
    with_faults(
        lab,
        purpose + 'role = "player"\noperation = "wait"\nkind = "unplugged"\nposition = 3',
        purpose + 'role = "recorder"\noperation = "read"\nkind = "missing_reference"\nposition = 5',
    )
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5")]) == 0
    trials = TRIALS.replace("blocks = 2", "blocks = 2\npause_s = 10.0\nfamiliarise = false") + "plays = 2\n"
    (lab / "trials.toml").write_text(trials + MASKING, encoding="utf-8")
    experiment = arguments(lab)
    with Lines(*experiment, "--lines") as session:  # over ten seconds each, in the wall's time
        assert session.hear("state")["phase"] == "welcome"
        session.send(order="go_on")
        assert session.hear("state")["waiting"] == "playing"
        capsys.readouterr()
        assert run([*experiment, "--lines", "--fast"]) == 75
        assert str(session.process.pid) in capsys.readouterr().err
        session.close_input()
        assert session.rest()[-1] == {"event": "ended", "done": 0, "of": 8, "complete": False}
        assert session.end() == 130
        assert any("muted" in line and "resumes" in line for line in session.said)

    with Lines(*experiment, "--lines", "--fast") as session:
        events = answer(session)
        assert session.end() == 0
    assert events[-1] == {"event": "ended", "done": 8, "of": 8, "complete": True}
    rows = read_answers(lab / "out")
    assert [row.attempts for row in rows] == [1, 1, 2, 1, 2, 1, 1, 1]
    assert [row.correct for row in rows] == [row.path == "right" for row in rows]
    assert [one["trial"] for one in events if one["event"] == "stored"] == [row.trial for row in rows]
    assert {one["trial"] for one in events if one["event"] == "state" and one["note"]} == {3, 5}
    assert all(row.onset_error_ms is not None and -25.1 < row.onset_error_ms < 0.1 for row in rows)
    assert all(row.reaction_s > 10.0 for row in rows)
    facts = read_facts(lab / "out")
    manifest = json.loads((lab / "out" / "stimuli" / "manifest.json").read_text(encoding="utf-8"))
    for row in rows:
        assert row.trials_sha256 == facts["trials_sha256"] == manifest["trials_sha256"]
        assert row.bank_sha256 == facts["bank_sha256"] == manifest["bank_sha256"]
        assert row.stimulus_sha256 == manifest["stimuli"][row.stimulus]["sha256"]
    assert run([*experiment, "--lines", "--fast"]) == 2
    assert "complete" in capsys.readouterr().err


def test_given_wrong_input_then_a_sentence_comes_before_anything_sounds(lab, experiment, capsys):
    def refused(*words, trials=TRIALS, options=("--lines",)):
        (lab / "trials.toml").write_text(trials, encoding="utf-8")
        capsys.readouterr()
        assert run([*experiment, *options]) == 2
        told = capsys.readouterr()
        assert told.err.strip().splitlines()[-1].startswith("wavefocus: ")
        assert "Traceback" not in told.err
        assert "welcome" not in told.out
        for word in words:
            assert word in told.err

    refused("masking.output", "actuator", trials=TRIALS + MASKING.replace("5", "1"))
    refused("masking.output", "loopback", trials=TRIALS + MASKING.replace("5", "3"))
    refused("masking.rms_v", trials=TRIALS + MASKING.replace("0.2", "1.2"))
    refused("participant", options=("--lines", "--participant", "Ann Smith"))
    refused("actuator", "amplitude", trials=TRIALS.replace("0.001", "1000"), options=("--prepare",))
    refused("path", trials=TRIALS.replace("[8, 0]", "[80, 0]"), options=("--prepare",))
    (lab / "out" / "trials.csv").write_text("participant\n", encoding="utf-8")
    refused("trials.csv", "line 1")
    assert not list((lab / "out").glob("*.owner"))


@pytest.mark.smoke
def test_given_a_preparation_then_the_stimuli_are_there_and_a_window_is_not_needed(lab, experiment, capsys):
    assert run([*experiment[:-2], "--prepare", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["stimuli"]
    assert sorted(listed) == sorted(one.stem for one in (lab / "out" / "stimuli").glob("*.h5"))
    assert read_answers(lab / "out") == ()
    with AnswersFile(lab / "out") as answers:
        assert answers.rows == ()
