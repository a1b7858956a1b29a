"""The trials file: stimuli by table, their order, the question and its answers, breaks and masking noise."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from config.fields import Finite, NonNegative, Positive, Switch, Table, Text, Whole, mistake
from config.scene import Output, PathTable, Regularisation, SignalTable

Count = Annotated[Whole, Field(ge=1, le=10_000)]
Name = Annotated[Text, Field(max_length=60)]


class TrialsTable(Table):
    """What is asked, and how often."""

    name: Name = Field(default="trials", title="Name", description="Of the experiment, for files and pages")
    instruction: str = Field(default="", title="Instruction", description="First page: what participants feel and do")
    question: Text = Field(title="Question", description="Asked after each stimulus")
    answers: tuple[Name, ...] = Field(
        title="Answers", description="Choices, from left to right on the screen", min_length=2, max_length=9
    )
    keys: tuple[Name, ...] = Field(
        default=(), title="Keys", description="Key of each answer, as Left or F; empty: 1, 2, ..."
    )
    correct: Name | None = Field(
        default=None,
        title="Correct",
        description="Factor (path, signal, amplitude, ...) whose level is the right answer, or given by correct_levels",
    )
    correct_levels: dict[str, str] = Field(
        default={},
        title="Correct levels",
        description="Answer that is right for each level of that factor, where they are not named alike",
    )
    repetitions: Count = Field(default=10, title="Repetitions", description="Of every stimulus, over the whole session")
    blocks: Count = Field(
        default=1, title="Blocks", description="Each holds every stimulus equally often, so repetitions / blocks times"
    )
    most_alike: Whole = Field(
        default=2,
        title="Most alike",
        description="Trials in a row with one level of alike; 0: any number",
        ge=0,
        le=100,
    )
    alike: Name | None = Field(
        default=None, title="Alike", description="Factor that most_alike counts; by default correct, else the stimulus"
    )
    seed: Whole = Field(default=1, title="Seed", description="Of all orders; each participant has another", ge=0)
    familiarise: Switch = Field(
        default=True, title="Familiarise", description="Present every stimulus once first, without a question"
    )
    replays: Whole = Field(
        default=0, title="Replays", description="How often a participant may ask for a stimulus again", ge=0, le=100
    )
    break_every: Whole = Field(
        default=0, title="Break every", description="Trials between breaks; 0: between blocks", ge=0
    )
    waits: Switch = Field(
        default=False, title="Waits", description="Whether each trial waits for the participant to start it"
    )
    before_s: NonNegative = Field(
        default=0.5, title="Before", description="Pause between an answer and the next stimulus"
    )
    pause_s: NonNegative = Field(default=1.0, title="Pause", description="Between the plays of one stimulus")


class StimuliTable(Table):
    """Stimuli: all combinations of the listed levels; each key whose level differs between stimuli is a factor."""

    path: tuple[Name, ...] = Field(title="Paths", description="Names from the table path", min_length=1)
    signal: tuple[Name, ...] = Field(title="Signals", description="Names from the table signal", min_length=1)
    speed_mm_s: tuple[Positive, ...] = Field(default=(), title="Speeds", description="Along the path; not for points")
    amplitude: tuple[Finite, ...] = Field(
        default=(1.0,),
        title="Amplitudes",
        description="As of a scene's source; 0 is a trial without a stimulus",
        min_length=1,
    )
    step_mm: Positive | None = Field(default=None, title="Step", description="As of a scene's source")
    emission: Literal["per_point", "continuous"] = Field(
        default="continuous", title="Emission", description="As of a scene's source"
    )
    plays: Count = Field(default=1, title="Plays", description="How often one presentation plays it")


class AdaptiveTable(Table):
    """Levels that follow the answers, in place of repetitions."""

    method: Literal["up_down", "quest_plus"] = Field(title="Method", description="Staircase, or QUEST+ (Watson 2017)")
    factor: Literal["amplitude", "speed_mm_s"] = Field(
        title="Factor",
        description="Key of stimuli whose levels are the ladder; each combination of the others is a track",
    )
    trials: Count = Field(default=60, title="Trials", description="Of each track at most")
    down: Count = Field(default=2, title="Down", description="up_down: right answers in a row that lower the level")
    up: Count = Field(default=1, title="Up", description="up_down: wrong answers in a row that raise it")
    reversals: Count = Field(default=10, title="Reversals", description="up_down: a track ends after so many")
    guess_rate: Annotated[Finite, Field(ge=0, lt=1)] = Field(
        default=0.5, title="Guess rate", description="Share of right answers without a stimulus"
    )
    lapse_rate: Annotated[Finite, Field(ge=0, lt=0.5)] = Field(
        default=0.02, title="Lapse rate", description="Share of slips with any stimulus"
    )


class MaskingTable(Table):
    """Pink noise that plays with every stimulus on an output of its own, for headphones."""

    output: Whole = Field(title="Output", description="Of the audio interface, from 0; none of an actuator", ge=0)
    rms_v: Positive = Field(title="Level", description="RMS of the noise in volts")
    around_s: NonNegative = Field(
        default=0.5, title="Around", description="Before and after the stimulus, fades included"
    )


class TrialsConfig(Table):
    """A validated trials file."""

    trials: TrialsTable
    path: dict[Name, PathTable] = Field(min_length=1, max_length=1000)
    signal: dict[Name, SignalTable] = Field(min_length=1, max_length=1000)
    stimuli: Annotated[tuple[StimuliTable, ...], Field(min_length=1, max_length=1000)]
    adaptive: AdaptiveTable | None = None
    masking: MaskingTable | None = None
    regularisation: Regularisation = Regularisation()
    output: Output = Output()

    @model_validator(mode="after")
    def _names_exist(self) -> TrialsConfig:
        for number, table in enumerate(self.stimuli):
            for key, known in (("path", self.path), ("signal", self.signal)):
                for name in getattr(table, key):
                    if name not in known:
                        raise mistake(f"stimuli[{number}].{key}", name, f"must be one of {', '.join(known)}")
        return self
