"""The scene file: sources that move along paths, how they are regularised and what limits the drive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from config.fields import (
    Finite,
    NonNegative,
    PointMm,
    Positive,
    Switch,
    Table,
    Text,
    Whole,
    mistake,
)
from config.loading import named_file, parse_toml, read_toml, validated
from config.mistakes import printable
from rendering.scene import paths, signals
from rendering.scene.model import Output, Regularisation, Scene, Source
from rendering.scene.paths import TextPath
from rendering.scene.svg import SvgPath
from storage.errors import InputError


class SceneTable(Table):
    """What the scene is called."""

    name: Text = "scene"


class PointTable(Table):
    """A source that stands still."""

    kind: Literal["point"]
    at_mm: PointMm


class LineTable(Table):
    """A straight line."""

    kind: Literal["line"]
    start_mm: PointMm
    end_mm: PointMm


class CircleTable(Table):
    """An arc or several turns of a circle, anticlockwise where turns are positive."""

    kind: Literal["circle"]
    centre_mm: PointMm = (0.0, 0.0)
    radius_mm: NonNegative
    turns: Finite = 1.0
    start_deg: Finite = 0.0


class PolylineTable(Table):
    """Straight lines through given points."""

    kind: Literal["polyline"]
    points_mm: Annotated[tuple[PointMm, ...], Field(min_length=1, max_length=1_000_000)]
    closed: Switch = False


class SvgTable(Table):
    """A path of an SVG file."""

    kind: Literal["svg"]
    file: Text
    path_id: str = ""
    scale: Positive = 1.0
    origin_mm: PointMm = (0.0, 0.0)


class TextTable(Table):
    """The strokes of a text."""

    kind: Literal["text"]
    string: Text
    height_mm: Positive
    centre_mm: PointMm = (0.0, 0.0)


class ImpulseTable(Table):
    """One sample of 1."""

    kind: Literal["impulse"]


class SineTable(Table):
    """A sine of amplitude 1 that starts at phase 0."""

    kind: Literal["sine"]
    frequency_hz: Positive
    duration_s: Positive


class NoiseTable(Table):
    """Band-limited noise, scaled to peak 1."""

    kind: Literal["noise"]
    band_hz: tuple[NonNegative, Positive]
    duration_s: Positive
    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 0

    @model_validator(mode="after")
    def _band_upwards(self) -> NoiseTable:
        if self.band_hz[0] >= self.band_hz[1]:
            raise mistake("band_hz", self.band_hz, "must be [lower, upper] with lower below upper")
        return self


class FileTable(Table):
    """A sound file, resampled and scaled to peak 1."""

    kind: Literal["file"]
    path: Text


PathTable = Annotated[
    PointTable | LineTable | CircleTable | PolylineTable | SvgTable | TextTable, Field(discriminator="kind")
]
SignalTable = Annotated[ImpulseTable | SineTable | NoiseTable | FileTable, Field(discriminator="kind")]


class SourceTable(Table):
    """One source: what it emits, where it goes and how fast."""

    start_s: NonNegative = 0.0
    speed_mm_s: NonNegative | None = None
    step_mm: Positive | None = None
    amplitude: Finite = 1.0
    path: PathTable
    signal: SignalTable
    emission: Literal["per_point", "continuous"] = "continuous"

    @model_validator(mode="after")
    def _moves_somehow(self) -> SourceTable:
        if self.path.kind != "point":
            for key, unit in (("speed_mm_s", "mm/s"), ("step_mm", "mm")):
                if getattr(self, key) is None:
                    raise mistake(key, None, f"is needed in {unit} for a path of kind {self.path.kind}")
        return self


class RegularisationTable(Table):
    """How weak and strong actuators are evened out."""

    saturation: NonNegative = 0.0
    saturation_absolute: NonNegative = 0.0
    normalise: Switch = True

    @model_validator(mode="after")
    def _one_saturation(self) -> RegularisationTable:
        if self.saturation and self.saturation_absolute:
            allowed = "must be 0 or left out where saturation is given"
            raise mistake("saturation_absolute", self.saturation_absolute, allowed)
        return self


class OutputTable(Table):
    """Between grid points, and at the amplifier."""

    interpolation: Literal["nearest", "bilinear", "bicubic", "kernel"] = "nearest"
    limit_v: Positive | None = None
    limit_rms_v: Positive | None = None


class SceneConfig(Table):
    """A validated scene file."""

    scene: SceneTable = SceneTable()
    source: Annotated[tuple[SourceTable, ...], Field(min_length=1, max_length=1000)]
    regularisation: RegularisationTable = RegularisationTable()
    output: OutputTable = OutputTable()

    def build(self, file: Path, *, allow_large: bool = False) -> Scene:
        """Make the scene that rendering works on.

        Parameters
        ----------
        file : Path
            The scene file: what it names is relative to its folder, and messages begin with it.
        allow_large : bool
            Whether it may be larger than the limits of `rendering.scene.size`.

        Raises
        ------
        InputError
            A file that the scene names is missing or cannot be understood.
        """
        built = []
        for index, table in enumerate(self.source):
            key = f"source[{index}]"
            try:
                built.append(
                    Source(
                        path=_path(table.path, file, f"{key}.path", allow_large=allow_large),
                        signal=_signal(table.signal, file, f"{key}.signal"),
                        start_s=table.start_s,
                        speed_mm_s=table.speed_mm_s or 0.0,
                        step_mm=table.step_mm or 0.0,
                        amplitude=table.amplitude,
                        emission=table.emission,
                    )
                )
            except InputError as error:
                told = str(error)
                raise InputError(printable(told if told.startswith(str(file)) else f"{file}: {key}: {told}")) from None
        return Scene(
            name=self.scene.name,
            sources=tuple(built),
            regularisation=Regularisation(**self.regularisation.model_dump()),
            output=Output(**self.output.model_dump()),
            allow_large=allow_large,
        )


def load_scene(path: Path, *, allow_large: bool = False) -> Scene:
    """Read a scene file with all that it names.

    Parameters
    ----------
    path : Path
        The scene file; paths in it are relative to its folder.
    allow_large : bool
        Whether it may be larger than the limits of `rendering.scene.size`.

    Raises
    ------
    InputError
        Anything in the files is wrong.
    """
    return validated(SceneConfig, read_toml(path), str(path)).build(path, allow_large=allow_large)


def read_scene(text: str, path: Path, *, allow_large: bool = False) -> Scene:
    """Make the scene of a text, as `load_scene` would of a file of that text.

    Parameters
    ----------
    text : str
        What the scene file holds, or would hold.
    path : Path
        The scene file, which need not exist; paths in it are relative to its folder.
    allow_large : bool
        As for `load_scene`.

    Raises
    ------
    InputError
        Anything in the text or in the files that it names is wrong.
    """
    return validated(SceneConfig, parse_toml(text, str(path)), str(path)).build(path, allow_large=allow_large)


def read_scene_tables(text: str, path: Path) -> dict[str, Any]:
    """Take the tables of a scene file's text, valid and with all their defaults, without the files that it names.

    Parameters
    ----------
    text : str
        What the scene file holds.
    path : Path
        The scene file, for messages.

    Raises
    ------
    InputError
        Anything in the text is wrong.
    """
    return validated(SceneConfig, parse_toml(text, str(path)), str(path)).model_dump()


def _path(table: PathTable, file: Path, key: str, *, allow_large: bool) -> paths.Path:
    match table:
        case PointTable():
            return paths.Point(table.at_mm)
        case LineTable():
            return paths.Line(table.start_mm, table.end_mm)
        case CircleTable():
            return paths.Circle(table.centre_mm, table.radius_mm, table.turns, table.start_deg)
        case PolylineTable():
            return paths.Polyline(table.points_mm, table.closed)
        case SvgTable():
            drawing = named_file(file, f"{key}.file", table.file)
            return SvgPath(drawing, table.path_id, table.scale, table.origin_mm, allow_large)
        case TextTable():
            return TextPath(table.string, table.height_mm, table.centre_mm, allow_large)


def _signal(table: SignalTable, file: Path, key: str) -> signals.Signal:
    match table:
        case ImpulseTable():
            return signals.Impulse()
        case SineTable():
            return signals.Sine(table.frequency_hz, table.duration_s)
        case NoiseTable():
            return signals.Noise(table.band_hz, table.duration_s, table.seed)
        case FileTable():
            return signals.SoundFile(named_file(file, f"{key}.path", table.path))
