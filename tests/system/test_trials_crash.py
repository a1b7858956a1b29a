"""Trials whose process is killed: no answer that was acknowledged is lost, and the order stays as it was."""

import json
import random
import sys
import time

import pytest

from tests.system.crash.processes import How, Order, Processes
from tests.system.test_trials import TRIALS
from wavefocus.trials.answers import read_answers
from wavefocus.trials.design import load_trials
from wavefocus.trials.order import order_of

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD and /proc are Linux's"),
    pytest.mark.may_skip("what is loaded before the program sees the calls of Linux"),
]
ANSWERS = ("left", "right")


class Killed:
    """An experiment whose participants' sessions are killed and resumed."""

    def __init__(self, lab, bank, says):
        (lab / "trials.toml").write_text(TRIALS, encoding="utf-8")
        self.out = lab / "out"
        self._common = [lab / "trials.toml", "--bank", bank, "--rig", lab / "rig.toml", "--out", self.out]
        self._design = load_trials(lab / "trials.toml")
        says.mkdir()
        self.processes = Processes(says, self.out)
        self.processes.warm_up(["trials", *self._common, "--prepare"])
        self.kills, self._number = 0, 0
        self._begin()

    def session(self, lifetime_s=1000000000.0, order=None):
        """Carry on with the participant until the end or the kill, look at what is stored, and take the next one."""
        command = ["trials", *self._common, "--participant", self._participant, "--lines", "--fast"]
        ended = self.processes.converse(_answer, *command, order=order, lifetime_s=lifetime_s)
        assert "Traceback" not in ended.err
        assert ended.killed or ended.code in (0, 2), ended.err
        self.kills += ended.killed
        acknowledged = [event["trial"] for event in _events(ended.out) if event["event"] == "stored"]
        rows = [row for row in read_answers(self.out) if row.participant == self._participant]
        assert [(row.trial, row.stimulus, row.answer) for row in rows] == self._expected[: len(rows)]
        stored = max([self._stored, *acknowledged])
        assert stored <= len(rows) <= stored + 1  # one may have been stored, and the kill come before it was said
        self._stored = len(rows)
        if len(rows) == len(self._expected):
            self._begin()
        return ended

    def _begin(self):
        self._number, self._stored = self._number + 1, 0
        self._participant = f"P{self._number}"
        order = order_of(self._design, self._participant)
        self._expected = []
        while (trial := order.next_trial()) is not None:
            self._expected.append((trial.number, trial.stimulus, ANSWERS[trial.number % 2]))
            order.answered(ANSWERS[trial.number % 2])


def _events(text):
    return [json.loads(line) for line in text.split("\n")[:-1]]


def _answer(line):
    event = json.loads(line)
    match event["event"], event.get("waiting"):
        case "state", "go_on":
            return '{"order": "go_on"}'
        case "state", "answer":
            return json.dumps({"order": "answer", "choice": ANSWERS[event["trial"] % 2]})
    return ""


@pytest.fixture
def killed(lab, bank):
    one = Killed(lab, bank, lab / "says")
    yield one
    one.processes.close()


def kill(killed, at_random, at_calls, full):
    """Kill so many sessions at any moment, and so many before or within one of their calls on files.

    So many more find the disk full from one of their calls on, or fail at it once.
    """
    chance = random.Random(1)
    started_s = time.monotonic()
    calls = killed.session().calls or 0
    longest_s = time.monotonic() - started_s
    while killed.kills < at_random:
        killed.session(chance.uniform(0, longest_s))
    while killed.kills < at_random + at_calls:
        part = chance.choice((0, 1, 50, 300))
        killed.session(order=Order(chance.choice((How.KILL_BEFORE, How.KILL_WITHIN)), chance.randint(1, calls), part))
    for _ in range(full):
        ended = killed.session(order=Order(chance.choice((How.FAIL_ON, How.FAIL_ONCE)), chance.randint(1, calls)))
        assert ended.code == 0 or ended.err.strip().splitlines()[-1].startswith("wavefocus: "), ended.err


def test_given_sessions_that_are_killed_then_no_answer_is_lost_and_the_order_stays(killed):
    kill(killed, 2, 3, 2)


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_hundreds_of_kills_and_full_disks_then_no_answer_is_lost_and_the_order_stays(killed):
    kill(killed, 100, 100, 100)
