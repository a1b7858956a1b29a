"""The calibration file: what `wavefocus calibrate` has measured of a rig, and when, and on which devices."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, model_validator

from config.fields import Finite, NonNegative, PointMm, Positive, Table, Text, Whole, mistake
from config.rig_mirror import Matrix
from drivers.protocols import DeviceIdentity

FORMAT = "wavefocus-calibration"
FORMAT_VERSION = 1
PARTS = ("inputs", "outputs", "mirror", "actuators")
"""What a calibration is made of, in the order of measuring: each uses what those before it have found."""

Polarity = Literal[1, -1]
Index = Annotated[Whole, Field(ge=0, le=4095)]


class Fiducial(Table):
    """A mark on the surface, where the mirror stood when the beam was on it, and by how much the map misses it."""

    place_mm: PointMm
    angles_mrad: tuple[Finite, Finite]
    residual_mm: NonNegative


class MirrorMeasured(Table):
    """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""

    at: AwareDatetime
    device: Text
    identity: DeviceIdentity | None = None
    map: Matrix
    residual_rms_mm: NonNegative
    fiducial: Annotated[tuple[Fiducial, ...], Field(min_length=4, max_length=1000)]


class InputsMeasured(Table):
    """How much later the response input is sampled than the reference input."""

    at: AwareDatetime
    device: Text
    identity: DeviceIdentity | None = None
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)]


class OutputMeasured(Table):
    """One output of the player: latency relative to the loopback output, volts at full scale, sign."""

    channel: Index
    latency_s: Annotated[Finite, Field(ge=-1, le=1)]
    full_scale_v: Positive | None = None
    polarity: Polarity


class OutputsMeasured(Table):
    """The player's outputs, the loopback's own among them."""

    at: AwareDatetime
    device: Text
    identity: DeviceIdentity | None = None
    loopback_channel: Index
    channel: Annotated[tuple[OutputMeasured, ...], Field(min_length=1, max_length=4096)]

    @model_validator(mode="after")
    def _each_once(self) -> OutputsMeasured:
        seen = [one.channel for one in self.channel]
        for index, channel in enumerate(seen):
            if channel in seen[:index]:
                raise mistake(f"channel.[{index}].channel", channel, "is there already")
        return self


class ActuatorMeasured(Table):
    """One actuator: sign and level of its response against the others, at the same distance from each."""

    actuator: Annotated[Whole, Field(ge=0, le=1023)]
    channel: Index
    polarity: Polarity
    level_db: Finite
    verdict: Literal["good", "weak", "dead", "reversed", "unlike"]


class ActuatorsMeasured(Table):
    """The actuators, checked against each other."""

    at: AwareDatetime
    device: Text
    identity: DeviceIdentity | None = None
    distance_mm: Positive
    actuator: Annotated[tuple[ActuatorMeasured, ...], Field(min_length=1, max_length=1024)]


class CalibrationRecord(Table):
    """All that a calibration file holds; what was not measured is left out."""

    format: Literal["wavefocus-calibration"]
    format_version: Literal[1]
    made: AwareDatetime
    software: Text
    rig: Text
    mirror: MirrorMeasured | None = None
    inputs: InputsMeasured | None = None
    outputs: OutputsMeasured | None = None
    actuators: ActuatorsMeasured | None = None
