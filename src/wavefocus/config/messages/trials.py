"""Orders to ``wavefocus trials --lines`` and its events, one JSON object per line; the window uses them."""

from collections.abc import Mapping
from typing import Literal

from wavefocus.config.messages import EventMessage, Number, OrderMessage, Refused

Phase = Literal["welcome", "familiarisation", "trial", "break", "done"]
Waiting = Literal["go_on", "answer", "playing", "nothing"]


class GoOn(OrderMessage, frozen=True, tag="go_on"):
    """Leave the first page, a break, or go to the next trial where trials wait for it."""


class Answer(OrderMessage, frozen=True, tag="answer"):
    """The participant's answer to the trial that waits for one.

    choice: One of the design's answers.
    at_s: Instant on the machine's monotonic clock (`time.monotonic`, shared by its processes); None: when it arrives.
    by: Input it came from.
    """

    choice: str
    at_s: float | None = None
    by: Literal["keyboard", "button", "touch", "program"] = "program"


class Replay(OrderMessage, frozen=True, tag="replay"):
    """Present the same stimulus again; counted, refused where the design does not allow it."""


class EndTrials(OrderMessage, frozen=True, tag="end"):
    """Mute and end; the session goes on with the next trial when the same command is given again."""


ORDERS = (GoOn, Answer, Replay, EndTrials)


class Preparing(EventMessage, frozen=True, tag="preparing"):
    """Stimuli are rendered and checked; the first event, with done = 0, once the input was found right."""

    done: int
    of: int


class Welcome(EventMessage, frozen=True, tag="welcome"):
    """First page.

    stored: Sentences that say what is stored about a participant, and where.
    done, of: Trials with an answer and in all, None where answers decide it; `resumed` where some were answered before.
    answers: Choices with the keys that give them.
    """

    name: str
    participant: str
    instruction: str
    question: str
    stored: tuple[str, ...]
    done: int
    of: int | None
    resumed: bool
    answers: Mapping[str, str]
    replay_allowed: bool


class TrialsState(EventMessage, frozen=True, tag="state"):
    """Where the session stands.

    waiting: What it waits for: an order "go_on", an order "answer", or the end of a stimulus ("playing").
    trial, of: Number of the trial from 1, and of all; None for an adaptive design whose length is open.
    block, blocks: Likewise.
    note: A sentence for the experimenter, as that a trial is repeated since an instrument was lost; else empty.
    """

    phase: Phase
    waiting: Waiting
    trial: int
    of: int | None
    block: int
    blocks: int | None
    note: str = ""


class Presented(EventMessage, frozen=True, tag="presented"):
    """A stimulus has sounded to its end.

    trial: Its number; 0 in the familiarisation.
    onset_s: Onset on the machine's monotonic clock, by the recorder's loopback, known to `onset_within_ms`.
    onset_error_ms: How much later that is than by the request to play and the player's latency; None without one.
    """

    trial: int
    stimulus: str
    onset_s: Number
    onset_error_ms: float | None
    onset_within_ms: Number


class AnswerStored(EventMessage, frozen=True, tag="stored"):
    """The answer is on disk."""

    trial: int
    choice: str
    correct: bool | None
    reaction_s: Number


class TrialsEnded(EventMessage, frozen=True, tag="ended"):
    """The last line; the outputs are muted."""

    done: int
    of: int | None
    complete: bool


EVENTS = (Preparing, Welcome, TrialsState, Presented, AnswerStored, Refused, TrialsEnded)
