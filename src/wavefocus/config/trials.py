"""The trials file: stimuli by table, their order, the question and its answers, breaks and masking noise."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from wavefocus.config.fields import Finite, NonNegative, Positive, Switch, Table, Text, Whole, default, like, mistake
from wavefocus.config.scene import WITHOUT_SPEED, Output, PathTable, QuietTable, Regularisation, SignalTable

Count = Annotated[Whole, Field(ge=1, le=10_000)]
Pause = Annotated[NonNegative, Field(le=600)]
CONTROL = r"\x00-\x1f\x7f-\x9f\u2028\u2029"  # in a pattern's [...]; line ends too; other spaces and joiners are text
Words = Annotated[
    Text, Field(max_length=60),
    like(f"[^{CONTROL}]+", "must be one line of text without tabs or other control characters"),
]  # fmt: skip
Name = Annotated[str, like(r"[A-Za-z0-9_-]{1,40}", "must be 1 to 40 letters, digits, - and _; files are named by it")]
Key = Annotated[
    str, like(r"[A-Za-z0-9]|Left|Right|Up|Down|Space", "must be a letter, a digit, Left, Right, Up, Down or Space")
]
Factor = Literal["path", "signal", "speed_mm_s", "amplitude"]


def _listed(value: Any) -> Any:
    """A single level is a list of one."""
    return value if isinstance(value, list | tuple) else (value,)


Names = Annotated[tuple[Name, ...], BeforeValidator(_listed), Field(min_length=1)]
Speeds = Annotated[tuple[Positive, ...], BeforeValidator(_listed)]
Amplitudes = Annotated[tuple[Finite, ...], BeforeValidator(_listed), Field(min_length=1)]


class TrialsTable(Table):
    """The question, its answers, and the order and number of trials."""

    name: Name = default("trials", "Name of the experiment, for files and pages")
    instruction: str = default("", "Text of the first page: what participants feel and do")
    question: Text = Field(description="Question asked after each stimulus")
    answers: tuple[Words, ...] = Field(
        description="Choices, from left to right on the screen", min_length=2, max_length=9
    )
    keys: tuple[Key, ...] = default(
        (), "Key of each answer: a letter, a digit, Left, Right, Up, Down or Space; empty: 1, 2, ..."
    )
    correct: Factor | None = default(
        None, "Factor whose level decides the right answer; without it no answer is right or wrong"
    )
    correct_levels: dict[str, Words] = default(
        {}, "Right answer for each level of that factor; a level that is not listed is an answer itself"
    )
    repetitions: Count = default(10, "Trials with each stimulus, all blocks together")
    blocks: Count = default(1, "Parts of the session; each holds every stimulus equally often")
    most_alike: Whole = default(2, "Most trials in a row with one level of alike; 0: any number", ge=0, le=100)
    alike: Factor | Literal["stimulus"] | None = default(
        None, "Factor that most_alike is about; by default correct, else stimulus"
    )
    seed: Whole = default(1, "Seed of the orders; with the participant's code it gives each order", ge=0)
    familiarise: Switch = default(True, "Whether every stimulus is felt once first, without a question")
    replays: Whole = default(0, "Times that a participant may ask for the stimulus of a trial again", ge=0, le=100)
    break_every: Whole = default(0, "Trials between breaks; 0: breaks only between blocks", ge=0, le=10_000)
    waits: Switch = default(False, "Whether the participant starts each trial")
    before_s: Pause = default(0.5, "Pause before each stimulus")
    pause_s: Pause = default(1.0, "Pause between the plays of one stimulus")

    @model_validator(mode="after")
    def _one_key_each(self) -> TrialsTable:
        if len(set(self.answers)) < len(self.answers):
            raise mistake("answers", self.answers, "must differ")
        if self.keys and len({key.upper() for key in self.keys}) != len(self.answers):
            raise mistake("keys", self.keys, f"must be {len(self.answers)} different keys, one for each answer")
        return self

    @model_validator(mode="after")
    def _blocks_are_alike(self) -> TrialsTable:
        if self.repetitions % self.blocks:
            raise mistake("repetitions", self.repetitions, f"must be a multiple of blocks, {self.blocks}")
        if self.correct_levels and self.correct is None:
            raise mistake("correct", None, "is needed with correct_levels: the factor of these levels")
        return self


class _StimuliTable(Table):
    """Stimuli: all combinations of the levels listed; a single level needs no brackets."""

    path: Names = Field(description="Names of tables [path.NAME]")
    signal: Names = Field(description="Names of tables [signal.NAME]")
    speed_mm_s: Speeds = default((), "Speeds along the path; none for a point or a trajectory")
    amplitude: Amplitudes = default((1.0,), "Amplitudes as of a scene's source; 0: no stimulus")
    step_mm: Positive | None = default(None, "Distance between path points, as of a scene's source")
    emission: Literal["per_point", "continuous"] = default("continuous", "Emission as of a scene's source")
    repeat: Switch = default(False, "Whether a continuous signal repeats, as of a scene's source")
    quiet: Annotated[tuple[Name, ...], BeforeValidator(_listed)] = default(
        (), "Names of tables [quiet.NAME]: places that stay quiet; that of the stimulus' own path is left out"
    )
    plays: Whole = default(1, "Times that a stimulus is played in one trial", ge=1, le=100)


class AdaptiveTable(Table):
    """Levels of one factor that follow the answers, in place of repetitions."""

    method: Literal["up_down", "quest_plus"] = Field(
        description="Transformed up-down staircase, or QUEST+ (Watson 2017)"
    )
    factor: Literal["amplitude", "speed_mm_s"] = Field(description="Factor whose levels in [[stimuli]] are the ladder")
    harder: Literal["lower", "higher"] = default("lower", "Levels of that factor that are harder to answer rightly")
    trials: Count = default(40, "Trials of each track at most")
    right: Whole = default(2, "Right answers in a row that make it harder (up_down)", ge=1, le=10)
    wrong: Whole = default(1, "Wrong answers in a row that make it easier (up_down)", ge=1, le=10)
    reversals: Whole = default(10, "Reversals after which a track ends (up_down)", ge=4, le=1000)
    guess_rate: Finite = default(0.5, "Share of right answers where nothing is felt", ge=0, lt=1)
    lapse_rate: Finite = default(0.02, "Share of wrong answers at the easiest levels", ge=0, lt=0.5)

    @model_validator(mode="after")
    def _rises(self) -> AdaptiveTable:
        if self.guess_rate + self.lapse_rate >= 1:
            raise mistake("guess_rate", self.guess_rate, f"must be below 1 - lapse_rate, {1 - self.lapse_rate:g}")
        return self


class MaskingTable(Table):
    """Pink noise that plays with every stimulus on an output of its own, for headphones."""

    output: Annotated[Whole, Field(ge=0, le=1023)] = Field(
        description="Output of the audio interface, from 0; not of an actuator nor of the loopback"
    )
    rms_v: Positive = Field(description="RMS voltage of the noise")
    around_s: Pause = default(0.5, "Time before and after each stimulus in which the noise plays, too")


class TrialsConfig(Table):
    """A validated trials file."""

    trials: TrialsTable
    path: Annotated[dict[Name, PathTable], Field(min_length=1, max_length=1000)]
    signal: Annotated[dict[Name, SignalTable], Field(min_length=1, max_length=1000)]
    quiet: Annotated[dict[Name, QuietTable], Field(default_factory=dict, max_length=1000)]
    stimuli: Annotated[tuple[_StimuliTable, ...], Field(min_length=1, max_length=1000)]
    adaptive: AdaptiveTable | None = None
    masking: MaskingTable | None = None
    regularisation: Regularisation = Regularisation()
    output: Output = Output()

    @model_validator(mode="after")
    def _names_exist_and_paths_have_speeds(self) -> TrialsConfig:
        for number, table in enumerate(self.stimuli):
            named: tuple[tuple[str, dict[str, Any]], ...] = (
                ("path", self.path), ("signal", self.signal), ("quiet", self.quiet)
            )  # fmt: skip
            for key, tables in named:
                for name in getattr(table, key):
                    if name not in tables:
                        allowed = f"must be the name of a table [{key}.NAME]: {', '.join(tables) or 'there is none'}"
                        raise mistake(f"stimuli.[{number}].{key}", name, allowed)
            moving = [name for name in table.path if self.path[name].kind not in WITHOUT_SPEED]
            if moving and not (table.speed_mm_s and table.step_mm):
                key, unit = ("step_mm", "mm") if table.speed_mm_s else ("speed_mm_s", "mm/s")
                raise mistake(f"stimuli.[{number}].{key}", None, f"is needed in {unit} for the path {moving[0]}")
            if table.speed_mm_s and len(moving) < len(table.path):
                allowed = "is for paths that need one; list points and trajectories in a table [[stimuli]] of their own"
                raise mistake(f"stimuli.[{number}].speed_mm_s", table.speed_mm_s, allowed)
        return self

    @model_validator(mode="after")
    def _adaptive_or_repeated(self) -> TrialsConfig:
        if self.adaptive is None:
            return self
        for key in ("repetitions", "blocks"):
            if key in self.trials.model_fields_set:
                raise mistake(f"trials.{key}", getattr(self.trials, key), "must be left out where [adaptive] is given")
        if self.trials.correct is None:
            raise mistake("trials.correct", None, "is needed with [adaptive]: levels follow right and wrong answers")
        return self
