"""Simulated participants: answers follow a psychometric function that is known."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.config.messages.codec import Message
from wavefocus.config.messages.trials import Answer, GoOn, TrialsState
from wavefocus.trials.answers import AnswersFile, Row
from wavefocus.trials.design import Stimulus, TrialsDesign
from wavefocus.trials.presentation import Onset
from wavefocus.trials.psychometric import share_right
from wavefocus.trials.resuming import Experiment
from wavefocus.trials.session import TrialsSession

REACTION_S = 0.4


@dataclass(frozen=True, slots=True)
class Observer:
    """The psychometric function of a simulated participant, over one factor of the stimuli.

    threshold, slope: Of log10 of the level, as `wavefocus.trials.psychometric.share_right`.
    """

    factor: str
    threshold: float
    slope: float
    guess: float = 0.5
    lapse: float = 0.02

    def share(self, stimulus: Stimulus) -> float:
        """Share of right answers; without a stimulus the share 1 - guess of answers that none was felt."""
        level = getattr(stimulus, self.factor)
        if not level:
            return 1.0 - self.guess
        return float(share_right(math.log10(level), self.threshold, self.slope, self.guess, self.lapse))


class SimulatedParticipant:
    """A participant who feels nothing but answers: presenter, orders and receiver of events of a `TrialsSession`."""

    def __init__(self, design: TrialsDesign, observer: Observer, rng: np.random.Generator) -> None:
        self._design, self._observer, self._rng = design, observer, rng
        self._stimulus = ""
        self._waiting = ""

    def answer(self, name: str) -> str:
        """Answer to a stimulus; a wrong one is any of the others, all alike."""
        stimulus = self._design.stimuli[name]
        answers = self._design.config.trials.answers
        right = stimulus.correct or answers[0]
        if self._rng.random() < self._observer.share(stimulus):
            return right
        return str(self._rng.choice([answer for answer in answers if answer != right]))

    def present(self, stimulus: str, trial: int, note: Callable[[str], object]) -> Onset:
        self._stimulus = stimulus
        return Onset(time.monotonic() - REACTION_S, 0.0, 0.0, 1)

    def mute(self) -> None:
        pass

    def receive(self, event: Message) -> None:
        """Take an event of the session."""
        if isinstance(event, TrialsState):
            self._waiting = event.waiting

    def next(self, timeout_s: float | None) -> Message | None:
        if timeout_s is not None:
            raise TimeoutError
        return Answer(self.answer(self._stimulus)) if self._waiting == "answer" else GoOn()


def simulate(design: TrialsDesign, participant: str, observer: Observer, folder: Path, seed: int) -> tuple[Row, ...]:
    """Run the session of a simulated participant without instruments.

    folder: Of the answers file.

    Returns the answers that the folder then holds.
    """
    simulated = SimulatedParticipant(design, observer, np.random.default_rng(seed))
    experiment = Experiment(design, dict.fromkeys(design.stimuli, "0" * 64), "0" * 64)
    with AnswersFile(folder) as answers:
        TrialsSession(experiment, participant, answers, simulated, simulated, simulated.receive, hurried=True).run()
        return answers.rows
