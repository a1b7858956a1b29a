"""An experiment as its trials file describes it: stimuli, right answers, adaptive tracks; checked as a whole."""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from wavefocus.config.loading import naming_key, parse_toml, printable, read_toml_text, shown, validated
from wavefocus.config.trials import Factor, TrialsConfig
from wavefocus.rendering.scene.model import Scene, Source, build_path, build_quiet, build_signal
from wavefocus.storage.errors import InputError

MAX_STIMULI = 1000
MAX_TRIALS = 10_000
FACTORS: tuple[Factor, ...] = ("path", "speed_mm_s", "signal", "amplitude")
FACTS_OF_A_STIMULUS = ("path", "signal", "speed_mm_s", "amplitude", "plays", "correct", "track")


@dataclass(frozen=True, slots=True)
class Stimulus:
    """A stimulus of an experiment.

    name: Unique, also where small and capital letters are the same: ``right-100mm_s-burst``; names its drive file.
    path, signal: Names of their tables in the trials file.
    speed_mm_s: Speed along the path; None for a point or a trajectory.
    amplitude: That of a scene's source; 0: no stimulus, of the same length.
    plays: Times that it is played in one trial.
    correct: Right answer; None where no answer is right or wrong.
    track: Adaptive track that it belongs to; empty where the design is not adaptive.
    scene: Scene with its one source; None of an experiment that was read from ``trials.json``.
    """

    name: str
    path: str
    signal: str
    speed_mm_s: float | None
    amplitude: float
    plays: int
    correct: str | None
    track: str
    scene: Scene | None

    def level(self, factor: str) -> str:
        """Level of a factor as names write it (empty: it has none); the stimulus' own name for ``stimulus``."""
        return self.name if factor == "stimulus" else written_level(getattr(self, factor))


@dataclass(frozen=True, slots=True)
class TrialsDesign:
    """An experiment, checked as a whole.

    file: Trials file.
    config: Its validated tables.
    sha256: Of the file's bytes, a byte-order mark left out.
    stimuli: By name, in the order of the file.
    """

    file: Path
    config: TrialsConfig
    sha256: str
    stimuli: Mapping[str, Stimulus]

    @property
    def keys(self) -> Mapping[str, str]:
        """Key of each answer, in the order of the answers."""
        answers = self.config.trials.answers
        given = self.config.trials.keys or tuple(str(number) for number in range(1, len(answers) + 1))
        return dict(zip(answers, given, strict=True))

    @property
    def trials(self) -> int | None:
        """Trials of a participant; None where staircases decide their number."""
        adaptive = self.config.adaptive
        if adaptive is None:
            return self.config.trials.repetitions * len(self.stimuli)
        return None if adaptive.method == "up_down" else adaptive.trials * len(self.tracks)

    @property
    def tracks(self) -> tuple[str, ...]:
        """Names of the adaptive tracks; none where the design is not adaptive."""
        return tuple(dict.fromkeys(stimulus.track for stimulus in self.stimuli.values() if stimulus.track))

    @property
    def alike(self) -> str:
        """Factor that `most_alike` is about."""
        return self.config.trials.alike or self.config.trials.correct or "stimulus"

    def wrong(self, key: str, value: object, allowed: str) -> InputError:
        """Make the error about a key of the trials file."""
        return InputError(printable(f"{self.file}: {key} = {shown(value)}: {allowed}"))


def load_trials(path: str | Path) -> TrialsDesign:
    """Read a trials file with all that it names.

    Raises InputError: anything in it is wrong, or no order keeps its constraints; the message names file, key, value
    and what is allowed.
    """
    file = Path(path)
    text = read_toml_text(file, "trials")
    config = validated(TrialsConfig, parse_toml(text, str(file)), str(file))
    stimuli: dict[str, Stimulus] = {}
    design = TrialsDesign(file, config, hashlib.sha256(text.encode()).hexdigest(), stimuli)
    stimuli |= _stimuli(design)
    _check_answers(design)
    if config.adaptive is None:
        _check_order(design)
    else:
        _check_tracks(design)
    return design


def _stimuli(design: TrialsDesign) -> dict[str, Stimulus]:
    file, config = design.file, design.config
    paths, signals = {}, {}
    for name, path_table in config.path.items():
        with naming_key(file, f"path.{name}"):
            paths[name] = build_path(path_table, file, f"path.{name}")
    for name, signal_table in config.signal.items():
        with naming_key(file, f"signal.{name}"):
            signals[name] = build_signal(signal_table, file, f"signal.{name}")
    quiet = {name: build_quiet(table, file, f"quiet.{name}") for name, table in config.quiet.items()}
    amplitudes = {level for table in config.stimuli for level in table.amplitude}
    stimuli: dict[str, Stimulus] = {}
    names: set[str] = set()
    for number, table in enumerate(config.stimuli):
        key = f"stimuli[{number}]"
        for levels in product(table.path, table.speed_mm_s or (None,), table.signal, table.amplitude):
            path, speed_mm_s, signal, amplitude = levels
            written = dict(zip(FACTORS, _parts(*levels), strict=True))
            name = _joined(part for factor, part in written.items() if factor != "amplitude" or len(amplitudes) > 1)
            if name.casefold() in names or len(names) == MAX_STIMULI:
                allowed = (
                    f"is one too many; at most {MAX_STIMULI} stimuli are allowed"
                    if len(names) == MAX_STIMULI
                    else "is there already; each path, speed, signal and amplitude may be combined once"
                )
                raise design.wrong(key, name, allowed)
            names.add(name.casefold())
            with naming_key(file, key):
                source = Source(
                    paths[path], signals[signal], speed_mm_s=speed_mm_s or 0.0, step_mm=table.step_mm or 0.0,
                    amplitude=amplitude, emission=table.emission, repeat=table.repeat,
                )  # fmt: skip
            correct, track = None, ""
            if factor := config.trials.correct:
                level = written_level(dict(zip(FACTORS, levels, strict=True))[factor])
                correct = config.trials.correct_levels.get(level, level)
            if config.adaptive is not None:
                apart = (config.adaptive.factor, config.trials.correct)
                track = _joined(part for factor, part in written.items() if factor not in apart)
            # Where a stimulus is felt, it is not to be quiet.
            places = tuple(quiet[place] for place in dict.fromkeys(table.quiet) if place != path)
            scene = Scene(name, (source,), config.regularisation, config.output, quiet=places)
            stimuli[name] = Stimulus(name, path, signal, speed_mm_s, amplitude, table.plays, correct, track, scene)
    return stimuli


def _check_answers(design: TrialsDesign) -> None:
    """Refuse right answers that are no answers, and levels that do not exist."""
    trials = design.config.trials
    if trials.correct is None:
        return
    levels = {stimulus.level(trials.correct): stimulus.correct for stimulus in design.stimuli.values()}
    for level in trials.correct_levels:
        if level not in levels:
            allowed = f"{level} is not a level of {trials.correct}; its levels are {', '.join(levels)}"
            raise design.wrong("trials.correct_levels", trials.correct_levels, allowed)
    for level, answer in levels.items():
        if answer not in trials.answers:
            allowed = (
                f"gives {shown(answer)} for its level {shown(level)}, which must be one of {shown(trials.answers)}"
            )
            raise design.wrong("trials.correct", trials.correct, f"{allowed}; see correct_levels")


def _check_order(design: TrialsDesign) -> None:
    """Refuse a design that is too long, or that no order keeps `most_alike` in.

    A block with r trials of other levels than one parts those of this level into r + 1 rows of at most `most_alike`.
    The row in front may be full already from the block before it.
    """
    trials = design.config.trials
    if (count := trials.repetitions * len(design.stimuli)) > MAX_TRIALS:
        allowed = f"makes {count} trials of {len(design.stimuli)} stimuli; at most {MAX_TRIALS} are allowed"
        raise design.wrong("trials.repetitions", trials.repetitions, allowed)
    if not trials.most_alike:
        return
    each = trials.repetitions // trials.blocks
    levels = Counter(stimulus.level(design.alike) for stimulus in design.stimuli.values())
    level, most = levels.most_common(1)[0]
    others = each * (len(design.stimuli) - most)
    if each * most > trials.most_alike * (others + (trials.blocks == 1)):
        allowed = (
            f"cannot be kept: a block has {each * most} trials with {design.alike} = {shown(level)} and {others}"
            " others; raise it, 0 for any number, or name another factor with alike"
        )
        raise design.wrong("trials.most_alike", trials.most_alike, allowed)


def _check_tracks(design: TrialsDesign) -> None:
    """Refuse ladders that are no ladders, and tracks that lack a stimulus."""
    adaptive, trials = design.config.adaptive, design.config.trials
    assert adaptive is not None
    if trials.alike is not None:
        raise design.wrong("trials.alike", trials.alike, "must be left out where [adaptive] is given")
    for track in design.tracks:
        members = [stimulus for stimulus in design.stimuli.values() if stimulus.track == track]
        ladder = {getattr(stimulus, adaptive.factor) for stimulus in members}
        if len(ladder) < 2 or None in ladder or min(ladder) <= 0:
            allowed = f"needs two or more levels above 0 in each track; {track} has {shown(sorted(ladder, key=str))}"
            raise design.wrong("adaptive.factor", adaptive.factor, allowed)
        sides = {stimulus.level(trials.correct or "") for stimulus in members}
        if trials.correct != adaptive.factor and len(members) != len(ladder) * len(sides):
            allowed = f"must have a stimulus at each of its levels for each {trials.correct}; {track} lacks some"
            raise design.wrong("adaptive.factor", adaptive.factor, allowed)
        if trials.correct != adaptive.factor and len(sides) == 1 and trials.most_alike:
            allowed = f"cannot be kept: the track {track} has one level of {trials.correct}; 0 is any number"
            raise design.wrong("trials.most_alike", trials.most_alike, allowed)
    if len(design.tracks) * adaptive.trials > MAX_TRIALS:
        allowed = f"makes {len(design.tracks) * adaptive.trials} trials; at most {MAX_TRIALS} are allowed"
        raise design.wrong("adaptive.trials", adaptive.trials, allowed)


def _parts(path: str, speed_mm_s: float | None, signal: str, amplitude: float) -> tuple[str, str, str, str]:
    """Parts of a stimulus' name by factor."""
    return path, "" if speed_mm_s is None else f"{speed_mm_s:g}mm_s", signal, f"amp{amplitude:g}"


def _joined(parts: Iterable[str]) -> str:
    return "-".join(part for part in parts if part)


def written_level(level: str | float | None) -> str:
    """A level as names of stimuli and `correct_levels` write it."""
    return "" if level is None else level if isinstance(level, str) else f"{level:g}"
