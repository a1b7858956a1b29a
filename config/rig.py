"""The rig file: surface, actuators and the instruments with their wiring and calibration."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from config.calibration_merge import with_calibration
from config.fields import PointMm, Positive, Table, Text, mistake
from config.rig_care import CalibrationSection, RecoverySection, UsbDevice
from config.rig_emulation import Emulation
from config.rig_messages import MessagesSection
from config.rig_mirror import MirrorSection
from config.rig_player import PlayerSection
from config.rig_recorder import RecorderSection, VibrometerSection
from config.rig_watch import WatchSection
from config.stadium import inside_stadium, stadium_rim

DEFAULT_ACTUATORS = 20
DEFAULT_INSET_MM = 6.0


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


class RigConfig(Table):
    """A validated rig file; with no argument, the built-in virtual rig."""

    rig: RigSection = RigSection()
    surface: Surface = Surface()
    actuators: Actuators
    mirror: MirrorSection = MirrorSection()
    recorder: RecorderSection = RecorderSection()
    player: PlayerSection
    vibrometer: VibrometerSection = VibrometerSection()
    recovery: RecoverySection = RecoverySection()
    watch: WatchSection = WatchSection()
    messages: MessagesSection = MessagesSection()
    calibration: CalibrationSection = CalibrationSection()
    usb: Annotated[tuple[UsbDevice, ...], Field(max_length=64)] = ()
    emulation: Emulation = Emulation()

    @property
    def actuator_mm(self) -> NDArray[np.float64]:
        """Actuator positions in millimetres, shape (actuators, 2)."""
        return np.array(self.actuators.position_mm, dtype=np.float64)

    @property
    def is_virtual(self) -> bool:
        """Whether every instrument is virtual."""
        return self.mirror.driver == "virtual"  # validation has seen to it that the others are like it

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
        return with_calibration(data)

    @model_validator(mode="after")
    def _fits_together(self) -> RigConfig:
        self._check_of_one_kind()
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
        for key in ("dead_actuators", "weak_actuators", "reversed_actuators"):
            for index, actuator in enumerate(getattr(self.emulation, key)):
                if actuator >= len(points):
                    allowed = f"must be below {len(points)}, the number of actuators"
                    raise mistake(f"emulation.{key}.[{index}]", actuator, allowed)
        for index, output in enumerate(self.emulation.reversed_outputs):
            if output >= self.player.outputs:
                allowed = f"must be below {self.player.outputs}, the number of outputs"
                raise mistake(f"emulation.reversed_outputs.[{index}]", output, allowed)
        return self

    def _check_of_one_kind(self) -> None:
        """A virtual plate cannot be heard by a real recorder, nor the other way round."""
        one_world = "a rig's instruments are all virtual or all real"
        for name in ("recorder", "player"):
            driver = getattr(self, name).driver
            if (driver == "virtual") != self.is_virtual:
                raise mistake(f"{name}.driver", driver, f'{one_world}, and mirror.driver is "{self.mirror.driver}"')
        if self.is_virtual and self.vibrometer.driver != "fixed":
            raise mistake("vibrometer.driver", self.vibrometer.driver, f"{one_world}, and these are virtual")
        if self.watch.light is not None and self.vibrometer.port is None and not self.is_virtual:
            raise mistake("watch.light", "...", f"needs a vibrometer that tells it; {self.vibrometer.driver!r} cannot")


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
