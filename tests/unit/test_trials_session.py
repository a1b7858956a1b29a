"""The session of one participant: its states, its answers, and where it goes on; stimuli are presented in memory."""

import itertools
import time
from dataclasses import replace

import pytest

from tests.simulated_people import STROKES, WHICH_WAY, design_of
from wavefocus.config.messages import Refused
from wavefocus.config.messages.trials import Answer, AnswerStored, EndTrials, GoOn, Replay, TrialsState, Welcome
from wavefocus.drivers.errors import InstrumentLostError
from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import AnswersFile, read_answers
from wavefocus.trials.presentation import Onset
from wavefocus.trials.session import TrialsSession
from wavefocus.trials.stimuli import Prepared

TRIALS = f"""{WHICH_WAY}keys = ["Left", "Right"]
repetitions = 4
blocks = 2
replays = 1
{STROKES}"""


class InMemory:
    """Presents nothing; each onset lies so long before its end."""

    def __init__(self, attempts=(1,), lost=0):
        self.presented, self.muted = [], 0
        self._attempts, self._lost = itertools.cycle(attempts), lost

    def present(self, stimulus, trial, note):
        self.presented.append((stimulus, trial))
        if len(self.presented) == self._lost:
            raise InstrumentLostError("player", "playing", "it is gone", "plug it in")
        return Onset(time.monotonic() - 1.0, 0.25, 0.01, next(self._attempts))

    def mute(self):
        self.muted += 1


class Program:
    """Goes on and answers as the states ask for; `instead` gives other orders for some states of some trials."""

    def __init__(self, instead=None):
        self.events = []
        self._instead = instead or {}

    def __call__(self, event):
        self.events.append(event)

    def next(self, timeout_s):
        state = self.those(TrialsState)[-1]
        trial = state.trial if state.phase in ("trial", "break") else 0
        if orders := self._instead.get((trial, state.waiting)):
            return orders.pop(0)
        if timeout_s is not None:
            raise TimeoutError
        return GoOn() if state.waiting == "go_on" else Answer("right", time.monotonic(), "keyboard")

    def states(self):
        return [(one.phase, one.waiting) for one in self.those(TrialsState)]

    def those(self, kind):
        return [one for one in self.events if isinstance(one, kind)]


@pytest.fixture
def experiment(tmp_path):
    return made(tmp_path, TRIALS)


def made(folder, text):
    design = design_of(folder, text)
    return design, Prepared(folder, "b" * 64, dict.fromkeys(design.stimuli, "a" * 64))


def run(experiment, folder, program, presenter, participant="P1"):
    with AnswersFile(folder) as answers:
        session = TrialsSession(*experiment, participant, answers, presenter, program, program, hurried=True)
        return session.run(), session


def test_a_participant_then_every_stimulus_is_felt_first_and_each_trial_is_answered(experiment, tmp_path):
    program, presenter = Program(), InMemory(attempts=(1, 1, 1, 3))
    complete, session = run(experiment, tmp_path / "out", program, presenter)
    assert complete
    assert (session.done, session.of, presenter.muted) == (8, 8, 1)
    playing, asking, pause = ("trial", "playing"), ("trial", "answer"), ("break", "go_on")
    block = [playing, asking] * 4
    assert program.states() == [
        ("welcome", "go_on"), ("familiarisation", "go_on"), ("familiarisation", "playing"),
        ("familiarisation", "playing"), ("trial", "go_on"), *block, pause, *block, ("done", "nothing"),
    ]  # fmt: skip
    rows = read_answers(tmp_path / "out")
    assert [number for _, number in presenter.presented] == [0, 0, *range(1, 9)]
    assert [row.stimulus for row in rows] == [name for name, _ in presenter.presented[2:]]
    assert [row.attempts for row in rows] == [1, 3, 1, 1, 1, 3, 1, 1]
    assert [row.correct for row in rows] == [row.path == "right" for row in rows]
    assert all(1.0 <= row.reaction_s < 30.0 and row.onset_error_ms == 0.25 for row in rows)
    assert [one.trial for one in program.those(AnswerStored)] == [row.trial for row in rows] == list(range(1, 9))
    (welcome,) = program.those(Welcome)
    assert welcome.answers == {"left": "Left", "right": "Right"}
    assert "P1" in welcome.stored[0]
    assert str(tmp_path / "out" / "trials.csv") in welcome.stored[2]


def test_an_end_at_any_order_or_a_lost_player_loses_no_answer_and_it_goes_on_alike(experiment, tmp_path):
    whole = InMemory()
    run(experiment, tmp_path / "whole", Program(), whole)
    expected = [row.stimulus for row in read_answers(tmp_path / "whole")]
    for end in (EndTrials(), None):  # an order, and the end of the input
        folder = tmp_path / f"out {end}"
        for trial in range(1, 9):
            waiting = "playing" if trial % 2 else "answer"
            program, presenter = Program({(trial, waiting): [end]}), InMemory()
            complete, session = run(experiment, folder, program, presenter)
            assert (complete, session.done, presenter.muted) == (False, trial - 1, 1)
            assert len(read_answers(folder)) == trial - 1
            following = Program({(trial + 1, "playing"): [end], (trial + 1, "go_on"): [end]})
            complete, session = run(experiment, folder, following, InMemory())
            assert session.done == trial
            if trial > 1:
                assert following.those(TrialsState)[0].note == f"resumes at trial {trial} of 8"
                assert ("familiarisation", "playing") not in following.states()
        assert [row.stimulus for row in read_answers(folder)] == expected
        assert [row.trial for row in read_answers(folder)] == list(range(1, 9))
        with pytest.raises(InputError, match="complete"):
            run(experiment, folder, Program(), InMemory())
    # An instrument that is lost for good.
    presenter = InMemory(lost=5)
    with pytest.raises(InstrumentLostError):
        run(experiment, tmp_path / "lost", Program(), presenter)
    assert (len(read_answers(tmp_path / "lost")), presenter.muted) == (2, 1)


def test_orders_that_are_not_for_now_then_each_is_refused_and_the_next_one_counts(experiment, tmp_path):
    later, before = time.monotonic() + 3600, time.monotonic() - 3600
    untimely = [Answer("right", at_s) for at_s in (later, before, 1e300)]
    wrong = [GoOn(), Answer("up"), *untimely, Replay(), Replay(), Answer("left")]
    program = Program({(1, "playing"): [Answer("right")], (1, "answer"): wrong, (2, "playing"): [EndTrials()]})
    presenter = InMemory(attempts=(2,))
    run(experiment, tmp_path, program, presenter)
    refused = [one.sentence for one in program.those(Refused)]
    assert len(refused) == 7
    assert max(map(len, refused)) < 150
    (row,) = read_answers(tmp_path)
    assert (row.answer, row.replays, row.attempts, row.by) == ("left", 1, 3, "program")
    assert [number for _, number in presenter.presented] == [0, 0, 1, 1, 2]


def test_given_something_else_than_the_participant_began_with_then_it_is_refused(experiment, tmp_path):
    run(experiment, tmp_path, Program({(2, "playing"): [None]}), InMemory())
    design, prepared = experiment
    others = {
        "the bank": (design, replace(prepared, bank_sha256="c" * 64)),
        "stimulus": (design, replace(prepared, sha256=dict.fromkeys(prepared.sha256, "c" * 64))),
        "trials file": made(tmp_path, TRIALS + "\n"),
    }
    for word, other in others.items():
        with pytest.raises(InputError, match=word):
            run(other, tmp_path, Program(), InMemory())
    with pytest.raises(InputError, match="P1 has answers"):
        run(experiment, tmp_path, Program(), InMemory(), "p1")
    assert run(experiment, tmp_path, Program(), InMemory(), "P2")[0]
    assert {row.participant for row in read_answers(tmp_path)} == {"P1", "P2"}


def test_adaptive_levels_follow_the_answers_and_go_on_alike_when_resumed(tmp_path):
    table = '[adaptive]\nmethod = "up_down"\nfactor = "amplitude"\nreversals = 4\ntrials = 12\n'
    text = TRIALS.replace("repetitions = 4\nblocks = 2\n", "").replace("[path]", f"{table}\n[path]")
    experiment = made(tmp_path, text + "amplitude = [0.25, 0.5, 1]\n")
    run(experiment, tmp_path / "whole", Program(), InMemory())
    whole = [(row.stimulus, row.track) for row in read_answers(tmp_path / "whole")]
    for trial in itertools.count(2):
        complete, _ = run(experiment, tmp_path / "parts", Program({(trial, "playing"): [None]}), InMemory())
        if complete:
            break
    assert [(row.stimulus, row.track) for row in read_answers(tmp_path / "parts")] == whole
    assert len(set(whole)) > 2
