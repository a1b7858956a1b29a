"""The rig file: surface, actuators and the instruments with their wiring and calibration."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from acquisition.grid import inside_stadium, stadium_rim
from calibration.mirror_map import MirrorMap
from wavefocus.config.fields import Finite, NonNegative, PointMm, Positive, Table, Text, Whole, mistake

Driver = Literal["virtual"]
"""Names of the drivers that this version has; each is a line here and a factory where rigs are composed."""

DEFAULT_ACTUATORS = 20
DEFAULT_INSET_MM = 6.0
DEFAULT_DISTANCE_MM = 1000.0
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


class RigSection(Table):
    """What the rig is called."""

    name: Text = "virtual"


class Surface(Table):
    """The outline of the plate, centred on the origin, long side along x."""

    kind: Literal["stadium"] = "stadium"
    length_mm: Annotated[Positive, Field(le=100_000)] = 250.0
    width_mm: Annotated[Positive, Field(le=100_000)] = 150.0

    @model_validator(mode="after")
    def _longer_than_wide(self) -> Surface:
        if self.width_mm > self.length_mm:
            raise mistake("width_mm", self.width_mm, f"must be at most length_mm = {self.length_mm:g}")
        return self


class Actuators(Table):
    """Where the actuators touch the plate; their order is the bank's."""

    position_mm: Annotated[tuple[PointMm, ...], Field(min_length=1, max_length=1024)]


class MirrorSection(Table):
    """The scanning mirror and the map from the surface to its angles."""

    driver: Driver = "virtual"
    distance_mm: Positive = DEFAULT_DISTANCE_MM
    map: Matrix | None = None
    settle_s: NonNegative = 0.005
    limit_mrad: Annotated[Positive, Field(lt=1000 * math.pi / 2)] = 250.0
    park_mrad: tuple[Finite, Finite] = (-240.0, -240.0)

    @property
    def matrix(self) -> Matrix:
        """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""
        if self.map is not None:
            return self.map
        return ((1 / self.distance_mm, 0.0, 0.0), (0.0, 1 / self.distance_mm, 0.0), (0.0, 0.0, 1.0))

    def angles_mrad(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mirror angles of surface points, as the engine will command them.

        Parameters
        ----------
        points_mm : float64 array, shape (points, 2)
            x and y in millimetres.

        Raises
        ------
        InputError
            A place that no angle can reach.
        """
        return np.column_stack(MirrorMap(self.matrix).angles_mrad(points_mm[:, 0], points_mm[:, 1]))

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
        if self.map is not None:
            if self.distance_mm != DEFAULT_DISTANCE_MM:
                raise mistake("distance_mm", self.distance_mm, "must be left out where map is given")
            rows = np.array(self.map)
            scale = np.linalg.norm(rows, axis=1)
            if not scale.all() or abs(np.linalg.det(rows / scale[:, np.newaxis])) < 1e-12:
                raise mistake("map", self.map, "must be a matrix that can be inverted")
        if max(map(abs, self.park_mrad)) > self.limit_mrad:
            raise mistake("park_mrad", self.park_mrad, f"must be within limit_mrad = {self.limit_mrad:g}")
        return self


class RecorderSection(Table):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    driver: Driver = "virtual"
    reference_range_v: Positive = 10.0
    response_range_v: Positive = 10.0
    reference_gain: Positive = 1.0
    inter_channel_delay_s: Annotated[Finite, Field(ge=0, le=0.001)] = 5e-6
    pre_roll_s: Annotated[NonNegative, Field(le=10)] = 0.02
    post_roll_s: Annotated[NonNegative, Field(le=10)] = 0.1


class PlayerSection(Table):
    """The multichannel audio interface that drives the actuators."""

    driver: Driver = "virtual"
    channels: tuple[Annotated[Whole, Field(ge=0, le=4095)], ...]
    loopback_channel: Annotated[Whole, Field(ge=0, le=4095)]
    interface_rate_hz: Annotated[Whole, Field(ge=8_000, le=768_000)] = 48_000
    full_scale_v: Positive = 5.0
    limit_v: Positive = 5.0

    @model_validator(mode="after")
    def _wired_once(self) -> PlayerSection:
        for actuator, channel in enumerate(self.channels):
            if channel in self.channels[:actuator]:
                other = self.channels.index(channel)
                raise mistake(f"channels.[{actuator}]", channel, f"is already the channel of actuator {other}")
        if self.loopback_channel in self.channels:
            other = self.channels.index(self.loopback_channel)
            raise mistake("loopback_channel", self.loopback_channel, f"is already the channel of actuator {other}")
        if self.limit_v > self.full_scale_v:
            raise mistake("limit_v", self.limit_v, f"must be at most full_scale_v = {self.full_scale_v:g}")
        return self


class VibrometerSection(Table):
    """The laser vibrometer's calibration."""

    sensitivity_m_s_per_v: Positive = 0.125


class RigConfig(Table):
    """A validated rig file; with no argument, the built-in virtual rig."""

    rig: RigSection = RigSection()
    surface: Surface = Surface()
    actuators: Actuators
    mirror: MirrorSection = MirrorSection()
    recorder: RecorderSection = RecorderSection()
    player: PlayerSection
    vibrometer: VibrometerSection = VibrometerSection()

    @property
    def actuator_mm(self) -> NDArray[np.float64]:
        """Actuator positions in millimetres, shape (actuators, 2)."""
        return np.array(self.actuators.position_mm, dtype=np.float64)

    @property
    def is_virtual(self) -> bool:
        """Whether every instrument is virtual."""
        drivers: set[str] = {self.mirror.driver, self.recorder.driver, self.player.driver}
        return drivers == {"virtual"}

    @model_validator(mode="before")
    @classmethod
    def _defaults_that_depend(cls, data: Any) -> Any:
        """Fill in what follows from other tables, so that the validated rig says everything outright."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        actuators, player = data.setdefault("actuators", {}), data.setdefault("player", {})
        if isinstance(actuators, dict) and "position_mm" not in actuators:
            data["actuators"] = {**actuators, "position_mm": _default_actuators(data.get("surface", {}))}
        if isinstance(player, dict):
            position_mm = data["actuators"].get("position_mm") if isinstance(data["actuators"], dict) else None
            count = len(position_mm) if isinstance(position_mm, list | tuple) else DEFAULT_ACTUATORS
            player = {"channels": list(range(count)), **player}
            if isinstance(player["channels"], list | tuple):
                player.setdefault("loopback_channel", len(player["channels"]))
            data["player"] = player
        return data

    @model_validator(mode="after")
    def _fits_together(self) -> RigConfig:
        surface, points = self.surface, self.actuators.position_mm
        outside = np.flatnonzero(~inside_stadium(points, surface.length_mm, surface.width_mm))
        if len(outside):
            size = f"{surface.length_mm:g} x {surface.width_mm:g} mm"
            first = int(outside[0])
            key = f"actuators.position_mm.[{first}]"
            raise mistake(key, points[first], f"must be on the surface of {size} about the origin")
        for index, point in enumerate(points):
            if point in points[:index]:
                key = f"actuators.position_mm.[{index}]"
                raise mistake(key, point, f"is already the place of actuator {points.index(point)}")
        if len(self.player.channels) != len(points):
            allowed = f"must have one entry per actuator, {len(points)} in all, has {len(self.player.channels)}"
            raise mistake("player.channels", self.player.channels, allowed)
        return self


def _default_actuators(surface: Any) -> list[list[float]]:
    """Twenty actuators on the rim, to the micrometre, so that a file can hold exactly the same numbers."""
    try:
        size = Surface.model_validate(surface)
    except ValueError:  # told at the surface itself; any place will do here
        size = Surface()
    inset_mm = min(DEFAULT_INSET_MM, size.width_mm / 4)
    rim_mm = stadium_rim(size.length_mm, size.width_mm, inset_mm, DEFAULT_ACTUATORS)
    return [[float(x_mm), float(y_mm)] for x_mm, y_mm in np.round(rim_mm, 3) + 0.0]


def default_rig() -> RigConfig:
    """The rig that ``rig = "virtual"`` stands for."""
    return RigConfig.model_validate({})
