"""One participant's session: familiarisation, trials with their answers, breaks; goes on where the answers end."""

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from enum import Enum
from typing import Any, Protocol

from msgspec.structs import replace

from wavefocus.config.messages import Message, Refused, tag
from wavefocus.config.messages.trials import (
    Answer,
    AnswerStored,
    EndTrials,
    GoOn,
    Phase,
    Presented,
    Replay,
    TrialsState,
    Waiting,
    Welcome,
)
from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import ANSWERS, AnswersFile, Row, check_participant
from wavefocus.trials.design import FACTS_OF_A_STIMULUS, TrialsDesign
from wavefocus.trials.order import Trial, resume_sequence
from wavefocus.trials.presentation import Onset
from wavefocus.trials.stimuli import Prepared

# An answer's instant may lie so far in the future of this process: clocks are read one after the other.
AHEAD_S = 0.05


class _Presenter(Protocol):
    """Lets a participant feel stimuli."""

    def present(self, stimulus: str, trial: int, note: Callable[[str], object]) -> Onset:
        """Present a stimulus to its end; `note` receives a sentence about each presentation that is repeated."""

    def mute(self) -> None:
        """Silence all outputs."""


class Orders(Protocol):
    """Orders of a participant or a program, in turn."""

    def next(self, timeout_s: float | None) -> Message | None:
        """The next order; None at their end. Raises TimeoutError: none came in time. InputError: it is wrong."""


class _SessionStep(Enum):
    """Where a session stands: its phase, and what it waits for."""

    value: tuple[Phase, Waiting]
    WELCOME = ("welcome", "go_on")
    FAMILIARISATION = ("familiarisation", "go_on")
    FAMILIARISING = ("familiarisation", "playing")
    READY = ("trial", "go_on")
    PLAYING = ("trial", "playing")
    ASKING = ("trial", "answer")
    BREAK = ("break", "go_on")
    DONE = ("done", "nothing")


class _EndedError(Exception):
    """The orders have ended, or one of them says so."""


class TrialsSession:
    """A session of one participant.

    prepared: The design's stimuli.
    participant: The code.
    answers: File that gets an answer before it counts.
    publish: Receives every event.
    hurried: Leave out the pauses before stimuli, where a program answers.

    Raises InputError: the participant is complete, or has answered trials of another trials file, bank or order.
    """

    def __init__(
        self,
        design: TrialsDesign,
        prepared: Prepared,
        participant: str,
        answers: AnswersFile,
        presenter: _Presenter,
        orders: Orders,
        publish: Callable[[Message], object],
        *,
        hurried: bool = False,
    ) -> None:
        self._prepared, self._participant, self._answers = prepared, check_participant(participant), answers
        self._presenter, self._orders, self._publish, self._hurried = presenter, orders, publish, hurried
        self._design, self._table = design, design.config.trials
        self._order, self.done = resume_sequence(design, participant, answers.rows, prepared)
        self._resumed_at = self.done
        self._state = _SessionStep.WELCOME
        self._trial = self._order.next_trial()
        self._shown = (self.done + 1, self.of)

    @property
    def of(self) -> int | None:
        """Trials in all; None where answers decide their number."""
        return self._design.trials

    def run(self) -> bool:
        """Carry the session out until it is complete (True), or ended by an order or the end of the orders.

        Raises InstrumentError: an instrument failed for good. InputError: an answer cannot be stored. Answers that were
        stored stay in either case, and the outputs are muted.
        """
        try:
            self._welcome()
            if self._table.familiarise and not self._resumed_at:
                self._familiarise()
            while self._trial is not None:
                self._carry_out(self._trial)
        except _EndedError:
            return False
        finally:
            self._presenter.mute()
        return True

    def _welcome(self) -> None:
        table, folder = self._table, self._answers.path.parent
        self._publish(
            Welcome(
                name=table.name,
                participant=self._participant,
                instruction=table.instruction,
                question=table.question,
                stored=(
                    f"Under the code {self._participant} each trial is stored: the stimulus, your answer, when, how"
                    " fast and by which input you gave it, and how often you asked to feel the stimulus again.",
                    "No name and nothing else about you is stored.",
                    f"All is stored on this computer, in {folder / ANSWERS}.",
                    "You can end at any time, without giving a reason.",
                ),
                done=self.done,
                of=self.of,
                resumed=self._resumed_at > 0,
                answers=self._design.keys,
                replay_allowed=table.replays > 0,
            )
        )
        of = "" if self.of is None else f" of {self.of}"
        self._publish_state(f"resumes at trial {self.done + 1}{of}" if self._resumed_at else "")
        self._expect(GoOn)

    def _familiarise(self) -> None:
        felt = [stimulus.name for stimulus in self._design.stimuli.values() if stimulus.amplitude]
        if not felt:
            return
        self._shown = 1, len(felt)
        self._enter(_SessionStep.FAMILIARISATION)
        self._expect(GoOn)
        for number, name in enumerate(felt, 1):
            self._shown = number, len(felt)
            self._present(_SessionStep.FAMILIARISING, name, 0)

    def _carry_out(self, trial: Trial) -> None:
        self._shown = trial.number, self.of
        if self._table.waits or self._state is _SessionStep.FAMILIARISING:
            self._enter(_SessionStep.READY)
            self._expect(GoOn)
        onset = self._present(_SessionStep.PLAYING, trial.stimulus, trial.number)
        attempts, replays = onset.attempts, 0
        while isinstance(asked := self._ask(onset, replays), Replay):
            onset = self._present(_SessionStep.PLAYING, trial.stimulus, trial.number)
            attempts, replays = attempts + onset.attempts - 1, replays + 1
        row = self._row(trial, asked, onset, replays, attempts)
        self._answers.append(row)
        self._publish(AnswerStored(trial.number, row.answer, row.correct, row.reaction_s))
        self._order.answered(row.answer)
        self.done += 1
        self._trial = self._order.next_trial()
        if self._trial is None:
            self._enter(_SessionStep.DONE)
        elif self._is_break_due(trial, self._trial):
            self._shown = self._trial.number, self.of
            self._enter(_SessionStep.BREAK)
            self._expect(GoOn)

    def _is_break_due(self, last: Trial, following: Trial) -> bool:
        every = self._table.break_every
        return self.done % every == 0 if every else following.block != last.block

    def _present(self, state: _SessionStep, stimulus: str, number: int) -> Onset:
        self._enter(state)
        if not self._hurried:
            self._refuse_orders(self._table.before_s)
        onset = self._presenter.present(stimulus, number, self._publish_state)
        self._refuse_orders(0.0)
        self._publish(Presented(number, stimulus, onset.at_s, onset.error_ms, onset.within_ms))
        return onset

    def _ask(self, onset: Onset, replays: int) -> Answer | Replay:
        """Wait for an answer that the design knows, or a replay that it allows."""
        self._enter(_SessionStep.ASKING)
        while True:
            order: Answer | Replay = self._expect(Answer, Replay)
            if isinstance(order, Replay):
                if replays < self._table.replays:
                    return order
                self._refuse(f"replay: {replays} of {self._table.replays} replays of this trial are used")
                continue
            now_s = time.monotonic()
            at_s = now_s if order.at_s is None else order.at_s
            if order.choice not in self._table.answers:
                self._refuse(f"choice is {order.choice!r}; allowed: {', '.join(self._table.answers)}")
            elif not onset.at_s <= at_s <= now_s + AHEAD_S:
                allowed = f"from the onset, {onset.at_s:.3f}, to now, {now_s:.3f}, of this machine's monotonic clock"
                self._refuse(f"at_s is {at_s:.9g}; allowed: {allowed}")
            else:
                return replace(order, at_s=at_s)

    def _row(self, trial: Trial, answer: Answer, onset: Onset, replays: int, attempts: int) -> Row:
        stimulus = self._design.stimuli[trial.stimulus]
        assert answer.at_s is not None
        of_stimulus = {key: getattr(stimulus, key) for key in FACTS_OF_A_STIMULUS if key not in ("correct", "track")}
        return Row(
            participant=self._participant, block=trial.block, trial=trial.number, track=trial.track,
            stimulus=stimulus.name, **of_stimulus,
            answer=answer.choice, correct=None if stimulus.correct is None else answer.choice == stimulus.correct,
            reaction_s=answer.at_s - onset.at_s, onset_error_ms=onset.error_ms, onset_within_ms=onset.within_ms,
            replays=replays, attempts=attempts, by=answer.by,
            answered_at=datetime.now(UTC).astimezone().isoformat(timespec="milliseconds"),
            stimulus_sha256=self._prepared.sha256[stimulus.name], bank_sha256=self._prepared.bank_sha256,
            trials_sha256=self._design.sha256,
        )  # fmt: skip

    def _expect(self, *kinds: type[Message]) -> Any:
        """Wait for an order of one of some kinds; others are refused. Raises _EndedError."""
        while True:
            order = self._next(None)
            if isinstance(order, kinds):
                return order
            if order is not None:
                allowed = ", ".join([*map(tag, kinds), tag(EndTrials)])
                self._refuse(f"{tag(order)} is not for now; allowed: {allowed}")

    def _refuse_orders(self, seconds: float) -> None:
        """Let time pass in which nothing may be ordered but the end."""
        until_s = time.monotonic() + seconds
        with suppress(TimeoutError):
            while True:
                order = self._next(max(0.0, until_s - time.monotonic()))
                if order is not None:
                    self._refuse(f"{tag(order)} is not for now: the stimulus comes first; allowed: end")

    def _next(self, timeout_s: float | None) -> Message | None:
        """The next order; None where it was wrong. Raises TimeoutError, _EndedError."""
        try:
            order = self._orders.next(timeout_s)
        except InputError as wrong:
            self._refuse(str(wrong))
            return None
        if order is None or isinstance(order, EndTrials):
            raise _EndedError
        return order

    def _refuse(self, sentence: str) -> None:
        self._publish(Refused(sentence))

    def _enter(self, state: _SessionStep) -> None:
        """Change the state, and publish it."""
        self._state = state
        self._publish_state()

    def _publish_state(self, note: str = "") -> None:
        number, of = self._shown
        block = self._table.blocks if self._trial is None else self._trial.block
        phase, waiting = self._state.value
        self._publish(TrialsState(phase, waiting, number, of, block, self._table.blocks, note))
