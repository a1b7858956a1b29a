"""The scene file: sources that move along paths, how they are regularised and what limits the drive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import Field, model_validator

from wavefocus.config.fields import (
    Finite,
    NonNegative,
    PointMm,
    Positive,
    Switch,
    Table,
    Text,
    Whole,
    default,
    mistake,
    toml_table,
)

INTERPOLATIONS = {
    "nearest": "wavefocus.rendering.greens.interpolation.base:Nearest",
    "bilinear": "wavefocus.rendering.greens.interpolation.base:Bilinear",
    "kernel": "wavefocus.rendering.greens.interpolation.kernel:KernelInterpolation",
    "waves": "wavefocus.rendering.greens.interpolation.waves:WavesInterpolation",
    "auto": "wavefocus.rendering.greens.interpolation.errors:scene_choice",
}
"""Methods of a bank between its positions, by the name that a scene file gives them.

A new method is a class in rendering/greens/interpolation/, an entry here, and a line of the table in
tests/unit/test_interpolation.py.
"""
if TYPE_CHECKING:
    InterpolationName = str
else:
    InterpolationName = Literal[tuple(INTERPOLATIONS)]


class SceneTable(Table):
    """What the scene is called."""

    name: Text = default("scene", "For pictures and reports")


class PointTable(Table):
    """A source that stands still."""

    kind: Literal["point"] = "point"
    at_mm: PointMm = Field(
        description="Position on the surface, x to the right and y up from its centre", examples=[(0.0, 0.0)]
    )


class LineTable(Table):
    """A straight line."""

    kind: Literal["line"] = "line"
    start_mm: PointMm = Field(description="Start of the line", examples=[(-30.0, 0.0)])
    end_mm: PointMm = Field(description="End of the line", examples=[(30.0, 0.0)])


class CircleTable(Table):
    """An arc or several turns of a circle, anticlockwise where turns are positive."""

    kind: Literal["circle"] = "circle"
    centre_mm: PointMm = default((0.0, 0.0), "Centre of the circle")
    radius_mm: NonNegative = Field(description="Radius of the circle", examples=[20.0])
    turns: Finite = default(1.0, "Number of turns; negative: clockwise")
    start_deg: Finite = default(0.0, "Direction of the start from the centre, anticlockwise from x")


class PolylineTable(Table):
    """Straight lines through given points."""

    kind: Literal["polyline"] = "polyline"
    points_mm: tuple[PointMm, ...] = Field(
        description="Corners in order",
        min_length=1,
        max_length=1_000_000,
        examples=[((-20.0, -10.0), (0.0, 20.0), (20.0, -10.0))],
    )
    closed: Switch = default(False, "Whether a last line leads back to the first vertex")


class SvgTable(Table):
    """A path of an SVG file."""

    kind: Literal["svg"] = "svg"
    file: Text = Field(description="SVG file, relative to the scene file", examples=[""])
    path_id: str = default("", "Id of the path in the drawing; empty: the first one")
    scale: Positive = default(1.0, "Millimetres per unit of the drawing")
    origin_mm: PointMm = default((0.0, 0.0), "Position of the drawing's (0, 0) on the surface")


class TextTable(Table):
    """The strokes of a text."""

    kind: Literal["text"] = "text"
    string: Text = Field(description="Letters and signs of DejaVu Sans", examples=["text"])
    height_mm: Positive = Field(
        description="Height of the drawn letters, from lowest to highest point", examples=[20.0]
    )
    centre_mm: PointMm = default((0.0, 0.0), "Centre of the text")


class TrajectoryTable(Table):
    """Places in time, as a finger was: a CSV file of instants, places and amplitudes."""

    kind: Literal["trajectory"] = "trajectory"
    file: Text = Field(
        description="CSV file with the header time_s,x_mm,y_mm or time_s,x_mm,y_mm,amplitude, relative to the scene"
        " file; times count from start_s",
        examples=[""],
    )


class ImpulseTable(Table):
    """One sample of 1."""

    kind: Literal["impulse"] = "impulse"


class SineTable(Table):
    """A sine of amplitude 1 that starts at phase 0."""

    kind: Literal["sine"] = "sine"
    frequency_hz: Positive = Field(
        description="Frequency of the sine, below half the bank's sample rate", examples=[200.0]
    )
    duration_s: Positive = Field(description="Duration of the sine", examples=[0.1])


class NoiseTable(Table):
    """Band-limited noise, scaled to peak 1."""

    kind: Literal["noise"] = "noise"
    band_hz: tuple[NonNegative, Positive] = Field(
        description="Lower and upper edge of the band, up to half the bank's sample rate", examples=[(50.0, 450.0)]
    )
    duration_s: Positive = Field(description="Duration of the noise", examples=[0.015])
    seed: Whole = default(0, "The same seed gives the same noise on every computer", ge=0, le=2**63 - 1, examples=[1])

    @model_validator(mode="after")
    def _band_upwards(self) -> NoiseTable:
        if self.band_hz[0] >= self.band_hz[1]:
            raise mistake("band_hz", self.band_hz, "must be [lower, upper] with lower below upper")
        return self


class FileTable(Table):
    """A sound file, resampled and scaled to peak 1."""

    kind: Literal["file"] = "file"
    path: Text = Field(description="Sound file, relative to the scene file", examples=[""])


# `examples` of a field are what the window begins a new path or signal with.
PathTable = Annotated[
    PointTable | LineTable | CircleTable | PolylineTable | TextTable | SvgTable | TrajectoryTable,
    Field(discriminator="kind"),
]
WITHOUT_SPEED = ("point", "trajectory")
"""Kinds of paths that need neither a speed nor a step."""
SignalTable = Annotated[ImpulseTable | SineTable | NoiseTable | FileTable, Field(discriminator="kind")]


def tables_by_kind(union: Any) -> dict[str, Any]:
    """The tables of `PathTable` or `SignalTable` by their kind."""
    return {table.model_fields["kind"].default: table for table in get_args(get_args(union)[0])}


class SourceTable(Table):
    """One source: what it emits, where it goes and how fast."""

    start_s: NonNegative = default(0.0, "Start time in the scene")
    speed_mm_s: NonNegative | None = default(None, "Speed along the path; not needed for a point or a trajectory")
    step_mm: Positive | None = default(
        None, "Distance d between path points; one is emitted every d / v; not needed for a point or a trajectory"
    )
    amplitude: Finite = default(1.0, "Factor on the signal; with normalisation, response of an impulse at the focus")
    path: PathTable = Field(description="Path of the source")
    signal: SignalTable = Field(description="Signal that the source emits; its peak is 1 before the amplitude")
    emission: Literal["per_point", "continuous"] = default(
        "continuous", "Continuous along the path, or the whole signal anew at every path point"
    )

    repeat: Switch = default(
        False, "Whether the signal of a continuous source begins anew at its end, as long as the source moves"
    )

    @model_validator(mode="after")
    def _moves_somehow(self) -> SourceTable:
        if self.path.kind not in WITHOUT_SPEED:
            for key, unit in (("speed_mm_s", "mm/s"), ("step_mm", "mm")):
                if getattr(self, key) is None:
                    raise mistake(key, None, f"is needed in {unit} for a path of kind {self.path.kind}")
        return self


INDEPENDENT_LEVEL_DB = -30.0
"""Level of sources at one another where they are independent, and of a quiet place that states none."""


class QuietTable(Table):
    """A place where the response is kept low."""

    at_mm: PointMm | None = default(None, "Place on the surface; or a path")
    path: PathTable | None = default(None, "Path of a place that moves from time 0 on")
    speed_mm_s: NonNegative | None = default(None, "Speed along the path; not needed for a point or a trajectory")
    radius_mm: NonNegative = default(0.0, "Radius of a disc, as of a fingertip; 0: a point", le=100)
    level_db: Finite = default(
        INDEPENDENT_LEVEL_DB, "Energy of the response there over that at the loudest focus", lt=0, ge=-200
    )

    @model_validator(mode="after")
    def _is_somewhere(self) -> QuietTable:
        if (self.at_mm is None) == (self.path is None):
            key, value = ("path", "given beside at_mm") if self.path is not None else ("at_mm", None)
            raise mistake(key, value, "a quiet place has either at_mm, or path with speed_mm_s")
        if self.path is not None and self.path.kind not in WITHOUT_SPEED and self.speed_mm_s is None:
            raise mistake("speed_mm_s", None, f"is needed in mm/s for a path of kind {self.path.kind}")
        return self


class Regularisation(Table):
    """How weak and strong actuators are evened out, and whether sources keep quiet at one another."""

    saturation: NonNegative = default(0.0, "C of eq. (14) as a fraction of the bank's median rms; 0: off")
    saturation_absolute: NonNegative = default(0.0, "C of eq. (14) in the unit of the bank; 0: off")
    normalise: Switch = default(True, "Equal response to an impulse at every focus (eq. 15)")
    independent: Switch = default(False, "Whether each source is quiet where the other sources are")

    @model_validator(mode="after")
    def _one_saturation(self) -> Regularisation:
        if self.saturation and self.saturation_absolute:
            allowed = "must be 0 or left out where saturation is given"
            raise mistake("saturation_absolute", self.saturation_absolute, allowed)
        return self


def regularisation_toml(regularisation: Regularisation) -> str:
    """The table as a scene file holds it; a saturation level of 0, which is off, is left out."""
    off = {} if regularisation.saturation_absolute else {"saturation_absolute": None}
    return toml_table("[regularisation]", regularisation, off)


class Output(Table):
    """Between grid points, and at the amplifier."""

    interpolation: InterpolationName = default(
        "auto",
        "Method for Green's functions between the bank's positions; waves works on coarse grids and needs "
        "the actuators' places, auto takes the cheapest whose expected error is below 2 %",
    )
    limit_v: Positive | None = default(
        None, "Largest drive of any actuator; beyond it all drives are scaled down together"
    )
    limit_rms_v: Positive | None = default(
        None, "Largest rms of any actuator's drive over any second; beyond it all are scaled down"
    )
    most_energy: Finite = default(
        10.0,
        "Largest energy of the drives of a scene with quiet places over that of plain time reversal; beyond "
        "it the level that can be reached is taken and reported",
        ge=1,
    )


class SceneConfig(Table):
    """A validated scene file."""

    scene: SceneTable = SceneTable()
    source: Annotated[tuple[SourceTable, ...], Field(min_length=1, max_length=10_000)]
    quiet: Annotated[tuple[QuietTable, ...], Field(max_length=1000)] = ()
    regularisation: Regularisation = Regularisation()
    output: Output = Output()
