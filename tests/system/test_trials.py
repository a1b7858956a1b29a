"""Whole experiments through the command, answered by a program: what is stored, refused, repeated, muted, analysed."""

import json
import random
import sys
import time

import numpy as np
import pytest
from scipy.stats import binom

from tests.simulated_people import (
    CONSTANT,
    PEOPLE,
    QUEST,
    STROKES,
    UP_DOWN,
    WHICH_WAY,
    Observer,
    SimulatedParticipant,
    coverage,
    designs,
)
from tests.system import captures
from tests.system.captures import wavefocus
from tests.system.conftest import with_faults, write_lab
from tests.system.crash.processes import How, Order, Processes
from tests.system.lines import Lines, in_process
from wavefocus.trials.answers import AnswersFile, read_answers, read_facts
from wavefocus.trials.design import load_trials
from wavefocus.trials.order import order_of

TRIALS = f"""{WHICH_WAY}keys = ["Left", "Right"]
repetitions = 4
blocks = 2
{STROKES}emission = "per_point"
amplitude = 0.001
"""
ADAPTIVE = f"""{WHICH_WAY}name = "felt_or-not"
familiarise = false
{STROKES}emission = "per_point"
amplitude = [0.0001, 0.0002, 0.0004, 0.0006, 0.001]

[adaptive]
method = "up_down"
factor = "amplitude"
trials = 12
"""
MASKING = "\n[masking]\noutput = 5\nrms_v = 0.2\n"
ANSWERS = ("left", "right")


def experiment(lab, trials=TRIALS, participant="P1"):
    """The command line of a lab's experiment, its trials file written."""
    (lab / "trials.toml").write_text(trials, encoding="utf-8")
    files = [lab / "trials.toml", "--bank", lab / "plate.h5", "--rig", lab / "rig.toml", "--out", lab / "out"]
    return ["trials", *map(str, files), "--participant", participant]


def answer(session, choose=lambda stimulus: "right"):
    """Go on and answer until the session ends; its events."""
    events = []
    while True:
        events.append(session.hear("state", "stored", "presented", "ended", "refused"))
        match events[-1]["event"], events[-1].get("waiting"):
            case "state", "go_on":
                session.send(order="go_on")
            case "state", "answer":
                stimulus = [one["stimulus"] for one in events if one["event"] == "presented"][-1]
                session.send(order="answer", choice=choose(stimulus))
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
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    trials = TRIALS.replace("blocks = 2", "blocks = 2\npause_s = 10.0\nfamiliarise = false") + "plays = 2\n"
    command = experiment(lab, trials + MASKING)
    with Lines(*command, "--lines") as session:  # over ten seconds each, in the wall's time
        assert session.hear("state")["phase"] == "welcome"
        session.send(order="go_on")
        assert session.hear("state")["waiting"] == "playing"
        assert str(session.process.pid) in captures.refused(capsys, *command, "--lines", "--fast", code=75)
        session.close_input()
        assert session.rest()[-1] == {"event": "ended", "done": 0, "of": 8, "complete": False}
        assert session.end() == 130
        assert any("muted" in line and "resumes" in line for line in session.said)

    events = []
    assert in_process(lambda session: events.extend(answer(session)), *command, "--lines", "--fast") == 0
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
    assert "complete" in captures.refused(capsys, *command, "--lines", "--fast")


def test_given_wrong_input_then_a_sentence_comes_before_anything_sounds(lab, bank, capsys):
    def refused(*words, trials=TRIALS, options=("--lines",)):
        told = captures.refused(capsys, *experiment(lab, trials), *options)
        for word in words:
            assert word in told

    refused("masking.output", "actuator", trials=TRIALS + MASKING.replace("5", "1"))
    refused("masking.output", "loopback", trials=TRIALS + MASKING.replace("5", "3"))
    refused("masking.rms_v", trials=TRIALS + MASKING.replace("0.2", "1.2"))
    refused("participant", options=("--lines", "--participant", "Ann Smith"))
    refused("actuator", "amplitude", trials=TRIALS.replace("0.001", "1000"), options=("--prepare",))
    (lab / "out" / "trials.csv").write_text("participant\n", encoding="utf-8")
    refused("trials.csv", "line 1")
    assert not list((lab / "out").glob("*.owner"))


@pytest.mark.smoke
def test_given_a_preparation_then_the_stimuli_are_there_and_a_window_is_not_needed(lab, bank, capsys):
    assert "--participant is missing" in captures.refused(capsys, *experiment(lab)[:-2], "--lines")
    listed = captures.answered(capsys, *experiment(lab)[:-2], "--prepare")["stimuli"]
    assert sorted(listed) == sorted(one.stem for one in (lab / "out" / "stimuli").glob("*.h5"))
    assert read_answers(lab / "out") == ()
    with AnswersFile(lab / "out") as answers:
        assert answers.rows == ()


@pytest.mark.smoke
def test_answers_of_a_simulated_participant_are_analysed_into_one_folder(lab, bank, capsys):
    command, out = experiment(lab, ADAPTIVE, "A-1"), lab / "out"
    design = load_trials(lab / "trials.toml")
    person = SimulatedParticipant(design, Observer("amplitude", -3.5, 8.0), np.random.default_rng(1))
    assert in_process(lambda session: answer(session, person.answer), *command, "--lines", "--fast") == 0

    result = out / "analysis"
    (result / "bids").mkdir(parents=True)
    older = {"format": "wavefocus-trials-analysis", "files": ["analysis.json", "older.png", "bids/older.tsv"]}
    for name in older["files"]:
        (result / name).write_text(json.dumps(older))
    assert "--force" in captures.refused(capsys, "analyse", out)
    printed = captures.answered(capsys, "analyse", out, "--force")
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
    assert not (result / "bids").exists()

    assert "--force" in captures.refused(capsys, "analyse", out)
    (result / "notes.txt").write_text("mine")
    assert "notes.txt" in captures.refused(capsys, "analyse", out, "--force")
    assert (result / "notes.txt").read_text() == "mine"
    captures.refused(capsys, "analyse", out, "--out", out, "--force")
    (out / "trials.json").write_text('{"format": "wavefocus-trials", "design": {"trials": 3}}')
    captures.refused(capsys, "analyse", out, "--out", lab / "other")
    captures.refused(capsys, "analyse", lab)


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("design", [CONSTANT, UP_DOWN, QUEST])
def test_200_simulated_people_of_each_design_then_intervals_hold_truth_in_95_of_100(tmp_path, design):
    found = coverage(designs(tmp_path)[design], PEOPLE, 0.02, tmp_path)
    assert found.min() >= (190 if design == CONSTANT else binom.ppf(0.01, PEOPLE, 0.95))


class Killed:
    """An experiment whose participants' sessions are killed and resumed."""

    def __init__(self, lab, processes):
        *self._command, self._participant = experiment(lab)
        self.out, self.processes = lab / "out", processes
        self._design = load_trials(lab / "trials.toml")
        processes.warm_up([*self._command[:-1], "--prepare"])
        self.kills, self._number = 0, 0
        self._begin()

    def _begin(self):
        """Take the next participant."""
        self._number, self._stored = self._number + 1, 0
        self._participant = f"P{self._number}"
        order = order_of(self._design, self._participant)
        self._expected = []
        while (trial := order.next_trial()) is not None:
            self._expected.append((trial.number, trial.stimulus, ANSWERS[trial.number % 2]))
            order.answered(ANSWERS[trial.number % 2])

    def session(self, lifetime_s=1000000000.0, order=None):
        """Carry on with the participant until the end or the kill, look at what is stored."""
        command = [*self._command, self._participant, "--lines", "--fast"]
        ended = self.processes.converse(_answer, *command, order=order, lifetime_s=lifetime_s)
        assert "Traceback" not in ended.err
        assert ended.killed or ended.code in (0, 2), ended.err
        assert ended.killed or ended.code == 0 or ended.err.strip().splitlines()[-1].startswith("wavefocus: ")
        self.kills += ended.killed
        events = [json.loads(line) for line in ended.out.split("\n")[:-1]]
        acknowledged = [event["trial"] for event in events if event["event"] == "stored"]
        rows = [row for row in read_answers(self.out) if row.participant == self._participant]
        assert [(row.trial, row.stimulus, row.answer) for row in rows] == self._expected[: len(rows)]
        stored = max([self._stored, *acknowledged])
        assert stored <= len(rows) <= stored + 1  # one may have been stored, and the kill come before it was said
        self._stored = len(rows)
        if len(rows) == len(self._expected):
            self._begin()
        return ended


def _answer(line):
    event = json.loads(line)
    match event["event"], event.get("waiting"):
        case "state", "go_on":
            return '{"order": "go_on"}'
        case "state", "answer":
            return json.dumps({"order": "answer", "choice": ANSWERS[event["trial"] % 2]})
    return ""


@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD and /proc are Linux's")
@pytest.mark.may_skip("what is loaded before the program sees the calls of Linux")
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("at_random", "at_calls", "full"), [(2, 3, 2), pytest.param(100, 100, 100, marks=pytest.mark.nightly)]
)
def test_kills_and_full_disks_lose_no_answer_and_leave_the_order_as_it_was(lab, bank, at_random, at_calls, full):
    """Some at any moment, some at a call on files; others find the disk full from a call on, or fail once."""
    (lab / "says").mkdir()
    with Processes(lab / "says", lab / "out") as processes:
        chance, killed, started_s = random.Random(1), Killed(lab, processes), time.monotonic()
        calls = killed.session().calls
        longest_s = time.monotonic() - started_s
        while killed.kills < at_random:
            killed.session(chance.uniform(0, longest_s))
        while killed.kills < at_random + at_calls:
            part, how = chance.choice((0, 1, 50, 300)), chance.choice((How.KILL_BEFORE, How.KILL_WITHIN))
            killed.session(order=Order(how, chance.randint(1, calls), part))
        for _ in range(full):
            killed.session(order=Order(chance.choice((How.FAIL_ON, How.FAIL_ONCE)), chance.randint(1, calls)))
