"""Simulated participants: answers follow a psychometric function that is known, through session, order and analysis."""

import math
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.config.messages.trials import Answer, GoOn, TrialsState
from wavefocus.trials.analysis.results import psychometric_of
from wavefocus.trials.analysis.statistics import table_of
from wavefocus.trials.answers import AnswersFile
from wavefocus.trials.design import load_trials
from wavefocus.trials.order import share_right
from wavefocus.trials.presentation import Onset
from wavefocus.trials.session import TrialsSession
from wavefocus.trials.stimuli import Prepared

PEOPLE = 200
STROKES = """
[path]
left = { kind = "line", start_mm = [8, 0], end_mm = [0, 0] }
right = { kind = "line", start_mm = [0, 0], end_mm = [8, 0] }

[signal]
burst = { kind = "sine", frequency_hz = 200.0, duration_s = 0.02 }

[[stimuli]]
path = ["left", "right"]
signal = "burst"
speed_mm_s = 200
step_mm = 4
"""
"""Tables of a trials file: a stroke of 8 mm to the left, and one to the right."""
WHICH_WAY = """
[trials]
question = "Which way?"
answers = ["left", "right"]
correct = "path"
"""
"""The first keys of a trials file about strokes."""
_TRIALS = f"""{WHICH_WAY}familiarise = false
most_alike = 0
REPETITIONS
{STROKES}amplitude = LEVELS
"""
CONSTANT, UP_DOWN, QUEST = "8 levels, 40 trials each", "up-down, 10 reversals", "QUEST+, 60 trials"
REACTION_S = 0.4


@dataclass(frozen=True, slots=True)
class Observer:
    """The psychometric function of a simulated participant, over one factor of the stimuli.

    threshold, slope: Of log10 of the level, as `wavefocus.trials.order.share_right`.
    """

    factor: str
    threshold: float
    slope: float
    guess: float = 0.5
    lapse: float = 0.02

    def share(self, stimulus):
        """Share of right answers; without a stimulus the share 1 - guess of answers that none was felt."""
        level = getattr(stimulus, self.factor)
        if not level:
            return 1.0 - self.guess
        return float(share_right(math.log10(level), self.threshold, self.slope, self.guess, self.lapse))


class SimulatedParticipant:
    """A participant who feels nothing but answers: presenter, orders and receiver of events of a `TrialsSession`."""

    def __init__(self, design, observer, rng):
        self._design, self._observer, self._rng = design, observer, rng
        self._stimulus = ""
        self._waiting = ""

    def answer(self, name):
        """Answer to a stimulus; a wrong one is any of the others, all alike."""
        stimulus = self._design.stimuli[name]
        answers = self._design.config.trials.answers
        right = stimulus.correct or answers[0]
        if self._rng.random() < self._observer.share(stimulus):
            return right
        return str(self._rng.choice([answer for answer in answers if answer != right]))

    def present(self, stimulus, trial, note):
        self._stimulus = stimulus
        return Onset(time.monotonic() - REACTION_S, 0.0, 0.0, 1)

    def mute(self):
        pass

    def receive(self, event):
        """Take an event of the session."""
        if isinstance(event, TrialsState):
            self._waiting = event.waiting

    def next(self, timeout_s):
        if timeout_s is not None:
            raise TimeoutError
        return Answer(self.answer(self._stimulus)) if self._waiting == "answer" else GoOn()


def simulate(design, participant, observer, folder, seed):
    """Run the session of a simulated participant without instruments.

    folder: Of the answers file.

    Returns the answers that the folder then holds.
    """
    simulated = SimulatedParticipant(design, observer, np.random.default_rng(seed))
    prepared = Prepared(folder, "0" * 64, dict.fromkeys(design.stimuli, "0" * 64))
    with AnswersFile(folder) as answers:
        receive = simulated.receive
        TrialsSession(design, prepared, participant, answers, simulated, simulated, receive, hurried=True).run()
        return answers.rows


def design_of(folder, text):
    """The design of a trials file, written into a folder."""
    file = folder / "trials.toml"
    file.write_text(text, encoding="utf-8")
    return load_trials(file)


def designs(folder):
    """The three designs, read from trials files in a folder."""
    constant = [round(float(one), 6) for one in np.geomspace(0.1, 1.0, 8)]
    ladder = [round(float(one), 6) for one in np.geomspace(10**-1.5, 1.0, 16)]
    found = {}
    for name, levels, method in ((CONSTANT, constant, ""), (UP_DOWN, ladder, "up_down"), (QUEST, ladder, "quest_plus")):
        adaptive = f'[adaptive]\nmethod = "{method}"\nfactor = "amplitude"\ntrials = 60\n' if method else ""
        text = _TRIALS.replace("REPETITIONS", "" if method else "repetitions = 20").replace("LEVELS", str(levels))
        file = folder / f"trials-{method or 'constant'}.toml"
        file.write_text(text + adaptive)
        found[name] = load_trials(file)
    return found


def coverage(design, people, lapse, folder):
    """Of how many people who go through a design the intervals of threshold and slope hold the truth."""
    held = []
    for person in range(people):
        rng = np.random.default_rng((person, people))
        observer = Observer("amplitude", float(rng.uniform(-0.7, -0.4)), float(rng.uniform(6.0, 12.0)), lapse=lapse)
        rows = simulate(design, f"P{person}", observer, Path(tempfile.mkdtemp(dir=folder)), person)
        (found,) = psychometric_of(table_of(rows), design.config.trials.answers, design.config.adaptive)
        ends = ((found.fit.threshold_interval, 10.0**observer.threshold), (found.fit.slope_interval, observer.slope))
        held.append([(low is None or low <= true) and (high is None or true <= high) for (low, high), true in ends])
    return np.sum(held, axis=0)
