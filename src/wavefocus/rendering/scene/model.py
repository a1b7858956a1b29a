"""A scene: sources that emit signals along paths, and the bounds of their drives; read from a scene file."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from wavefocus.config.loading import named_file, naming_key, parse_toml, read_toml, validated
from wavefocus.config.scene import (
    INDEPENDENT_LEVEL_DB,
    Output,
    PathTable,
    PointTable,
    QuietTable,
    Regularisation,
    SceneConfig,
    SignalTable,
)
from wavefocus.rendering.scene import paths, signals
from wavefocus.rendering.scene.signals import Signal
from wavefocus.rendering.scene.svg import SvgPath
from wavefocus.rendering.scene.trajectory import TrajectoryPath, read_trajectory
from wavefocus.storage.argument_types import check_fields, checked
from wavefocus.storage.errors import InputError

Emission = Literal["continuous", "per_point"]


@dataclass(frozen=True, slots=True)
class Source:
    """One source that emits `signal` along `path`.

    signal: Its signal, peak 1 before `amplitude`.
    start_s: Start in scene time, >= 0: the drive array has no room before the lead-in.
    speed_mm_s: Speed, > 0 on a path that moves; ignored for a point and a trajectory.
    step_mm: Path sample distance d, > 0 on a path that moves; ignored for a point and a trajectory.
    amplitude: In the bank's response unit when the scene normalises.
    emission, {"continuous", "per_point"}: The signal runs on along the path, or every path point emits all of it anew;
        a trajectory is continuous.
    repeat: A continuous signal begins anew at its end, as long as the source moves.

    Raises InputError where a value is out of range.
    """

    path: paths.Path
    signal: Signal
    start_s: float = 0.0
    speed_mm_s: float = 0.0
    step_mm: float = 0.0
    amplitude: float = 1.0
    emission: Emission = "continuous"
    repeat: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        _check(self.start_s >= 0, "start_s", self.start_s, ", 0 or above")
        _check(True, "amplitude", self.amplitude, "")
        if self.emission not in ("continuous", "per_point"):
            raise InputError(f"emission is {self.emission!r}; allowed are 'continuous' and 'per_point'")
        if self.emission == "per_point" and isinstance(self.path, TrajectoryPath):
            raise InputError("emission is 'per_point'; a trajectory needs 'continuous'")
        if self.repeat and (self.emission == "per_point" or not self.travel_s):
            raise InputError("repeat is true; it needs emission 'continuous' and a path that the source moves along")
        if isinstance(self.path, paths.Point):
            return
        for name in ("speed_mm_s", "step_mm"):
            value = getattr(self, name)
            _check(value >= 0, name, value, " above 0")

    @property
    def travel_s(self) -> float:
        """Seconds from its start to the end of its path; 0 where it stands still or is not given a speed."""
        if isinstance(self.path, TrajectoryPath):
            return float(self.path.time_s[-1])
        return self.path.length_mm / self.speed_mm_s if self.path.length_mm > 0 and self.speed_mm_s > 0 else 0.0

    @property
    def mean_speed_mm_s(self) -> float:
        """Length of its path over the time from its start to the path's end; 0 where it stands still."""
        return self.path.length_mm / self.travel_s if self.travel_s else 0.0


@dataclass(frozen=True, slots=True)
class QuietPlace:
    """A place where the response is kept low, while its path lasts and then at the path's end.

    path: A point, or the path of a place that moves from scene time 0 on.
    speed_mm_s: Speed, > 0 on a path that moves; ignored for a point and a trajectory.
    radius_mm: Radius of a disc, 0 for a point.
    level_db: Energy of the response there over that at the loudest focus, < 0.

    Raises InputError where a value is out of range.
    """

    path: paths.Path
    speed_mm_s: float = 0.0
    radius_mm: float = 0.0
    level_db: float = INDEPENDENT_LEVEL_DB

    def __post_init__(self) -> None:
        check_fields(self)
        _check(self.speed_mm_s >= 0, "speed_mm_s", self.speed_mm_s, ", 0 or above")
        _check(self.radius_mm >= 0, "radius_mm", self.radius_mm, ", 0 or above")
        _check(self.level_db < 0, "level_db", self.level_db, " below 0")


@dataclass(frozen=True, slots=True)
class Scene:
    """Sources that sound together, and places that are kept quiet.

    sources: At least one; their drives add.
    regularisation: Saturation and normalisation, the same for all sources.
    output: Interpolation and limits.
    quiet: Places that are kept quiet.
    """

    name: str
    sources: Sequence[Source]
    regularisation: Regularisation = field(default_factory=Regularisation)
    output: Output = field(default_factory=Output)
    quiet: Sequence[QuietPlace] = ()

    @property
    def of_earlier_versions(self) -> Scene | None:
        """The scene with "nearest", their default; None where the scene names its interpolation."""
        if "interpolation" in self.output.model_fields_set:
            return None
        return replace(self, output=self.output.model_copy(update={"interpolation": "nearest"}))

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "sources", tuple(self.sources))
        object.__setattr__(self, "quiet", tuple(self.quiet))
        if not all(isinstance(place, QuietPlace) for place in self.quiet):
            raise InputError("quiet holds something else than a QuietPlace")
        if not all(isinstance(source, Source) for source in self.sources):
            raise InputError("sources holds something else than a Source")
        if not self.sources:
            raise InputError("the scene has no source; at least one [[source]] is needed")


def _check(allowed: bool, name: str, value: float | None, words: str) -> None:
    if not allowed or not math.isfinite(value or 0.0):
        raise InputError(f"{name} is {value}; it must be a finite number{words}")


@checked
def load_scene(path: str | Path) -> Scene:
    """Read a scene file with all that it names.

    Parameters
    ----------
    path
        A scene file (docs/reference/scene-file.md).

    Returns
    -------
    Scene
        Its sources, regularisation and output; `Scene` and `Source` make one without a file.

    Raises
    ------
    InputError
        Anything in the file or the files that it names is wrong; the message names file, key, value and what is
        allowed.

    Examples
    --------
    >>> import wavefocus as wf
    >>> scene = wf.load_scene("scene.toml")
    >>> scene.name, scene.sources[0].speed_mm_s
    ('stroke', 100.0)
    >>> wf.Scene("tap", (wf.Source(wf.Point((0.0, 0.0)), wf.Sine(200.0, 0.05)),)).sources[0].amplitude
    1.0
    """
    file = Path(path)
    return build_scene(validated(SceneConfig, read_toml(file, "scene"), str(file)), file)


def read_scene(text: str, path: Path) -> Scene:
    """Make the scene of a text, as `load_scene` would of a file of that text.

    Raises InputError: anything in the text or in the files that it names is wrong.
    """
    return build_scene(validated(SceneConfig, parse_toml(text, str(path)), str(path)), path)


def build_scene(config: SceneConfig, file: Path) -> Scene:
    """Make the scene of a validated scene file.

    Raises InputError: a file that the scene names is missing or cannot be understood.
    """
    built = []
    for index, table in enumerate(config.source):
        key = f"source[{index}]"
        with naming_key(file, key):
            built.append(
                Source(
                    path=build_path(table.path, file, f"{key}.path"),
                    signal=build_signal(table.signal, file, f"{key}.signal"),
                    start_s=table.start_s,
                    speed_mm_s=table.speed_mm_s or 0.0,
                    step_mm=table.step_mm or 0.0,
                    amplitude=table.amplitude,
                    emission=table.emission,
                    repeat=table.repeat,
                )
            )
    quiet = [build_quiet(place, file, f"quiet[{index}]") for index, place in enumerate(config.quiet)]
    return Scene(
        name=config.scene.name,
        sources=tuple(built),
        regularisation=config.regularisation,
        output=config.output,
        quiet=tuple(quiet),
    )


def build_quiet(table: QuietTable, file: Path, key: str) -> QuietPlace:
    """Make the quiet place of a validated table; raises InputError: a file that it names cannot be understood."""
    path = PointTable(at_mm=table.at_mm) if table.at_mm is not None else table.path
    assert path is not None  # the table has one of both
    with naming_key(file, key):
        return QuietPlace(
            path=build_path(path, file, f"{key}.path"),
            speed_mm_s=table.speed_mm_s or 0.0,
            radius_mm=table.radius_mm,
            level_db=table.level_db,
        )


PATHS: Mapping[str, Callable[..., paths.Path]] = {
    "point": paths.Point,
    "line": paths.Line,
    "circle": paths.Circle,
    "polyline": paths.Polyline,
    "svg": SvgPath,
    "text": paths.TextPath,
    "trajectory": read_trajectory,
}
"""Paths by the kind of a table, whose keys are their parameters; `signals.SIGNALS` has the signals."""


def build_path(table: PathTable, file: Path, key: str) -> paths.Path:
    """Make the path of a table named `key` in `file`. Raises InputError: a file that it names cannot be used."""
    return PATHS[table.kind](**_parameters(table, file, key))


def build_signal(table: SignalTable, file: Path, key: str) -> Signal:
    """Make the signal of a table named `key` in `file`. Raises InputError: a file that it names is missing."""
    return signals.SIGNALS[table.kind](**_parameters(table, file, key))


def _parameters(table: PathTable | SignalTable, scene_file: Path, key: str) -> dict[str, Any]:
    """Keys of a table, with the files that it names."""
    values = table.model_dump(exclude={"kind"})
    for name in {"file", "path"} & values.keys():
        values[name] = named_file(scene_file, f"{key}.{name}", values[name])
    return values
