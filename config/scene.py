"""The scene file: sources that move along paths, how they are regularised and what limits the drive."""

from __future__ import annotations

from typing import Annotated, Literal

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
