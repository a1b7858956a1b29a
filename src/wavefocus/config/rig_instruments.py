"""Mirror, recorder, vibrometer and player of a rig file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from wavefocus.config.drivers import DriverTable, with_drivers
from wavefocus.config.fields import ALWAYS, DERIVED, FREE, Finite, NonNegative, Positive, Text, Whole, like, mistake
from wavefocus.drivers.daq.nidaqmx import ANALOG_INPUT
from wavefocus.drivers.registry import MIRRORS, PLAYERS, RECORDERS, SHUTTERS, VIBROMETERS

_DEFAULT_DISTANCE_MM = 1000.0
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


class SerialSection(DriverTable):
    """A device at a serial port."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'it, such as "/dev/ttyUSB0", "COM3", "socket://10.0.0.7:4001" or "serial-number:ABC123"',
        "baud": "",
        "identity": "",
    }

    port: Annotated[Text | None, FREE] = Field(
        default=None,
        description='"/dev/ttyUSB0", "COM3", "socket://HOST:PORT" or "serial-number:ABC123" (of its USB adapter)',
    )
    baud: Annotated[Annotated[Whole, Field(ge=300, le=10_000_000)] | None, FREE] = Field(
        default=None, description="Bits per second; by default the driver's own"
    )
    identity: Annotated[Text | None, FREE] = Field(
        default=None, description="Text that the device's own identification, or its decoder's name, must contain"
    )

    @model_validator(mode="after")
    def _of_a_port(self) -> SerialSection:
        """A port that is written like a network port or a serial number is one."""
        for beginning, pattern, allowed in (
            ("socket:", r"socket://[^\s/:]+:\d{1,5}", "must be socket://HOST:PORT"),
            ("serial-number:", r"serial-number:\S+", "must be serial-number: and the number itself"),
        ):
            port = self.port or ""
            if port.lower().startswith(beginning) and not re.fullmatch(pattern, port):
                raise mistake("port", port, allowed)
        return self


class MirrorSection(SerialSection):
    """The scanning mirror and the map from the surface to its angles."""

    distance_mm: Annotated[Positive, DERIVED] = Field(
        default=_DEFAULT_DISTANCE_MM,
        description="Distance from the mirror to the surface's centre, the beam square to it",
    )
    map: Annotated[Matrix | None, DERIVED] = Field(
        default=None, description="In place of distance_mm: H of (tan x, tan y, 1) ~ H (x_mm, y_mm, 1)"
    )
    settle_s: Annotated[NonNegative, FREE] = Field(default=0.005, description="Time that the beam swings after a move")
    limit_mrad: Annotated[Positive, Field(lt=1000 * math.pi / 2), FREE] = Field(
        default=250.0, description="Largest optical angle on either axis"
    )
    park_mrad: Annotated[tuple[Finite, Finite], FREE] = Field(
        default=(-240.0, -240.0),
        description="Safe direction, within limit_mrad: off the plate, and where no eye can be",
    )

    @property
    def matrix(self) -> Matrix:
        """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""
        if self.map is not None:
            return self.map
        return ((1 / self.distance_mm, 0.0, 0.0), (0.0, 1 / self.distance_mm, 0.0), (0.0, 0.0, 1.0))

    def plan_values(self) -> dict[str, Any]:
        """The map is hashed as its matrix, wherever it comes from."""
        return super().plan_values() | {"matrix": self.matrix}

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
        if self.map is not None:
            if self.distance_mm != _DEFAULT_DISTANCE_MM:
                raise mistake("distance_mm", self.distance_mm, "must be left out where map is given")
            rows = np.array(self.map)
            scale = np.linalg.norm(rows, axis=1)
            if not scale.all() or abs(np.linalg.det(rows / scale[:, np.newaxis])) < 1e-12:
                raise mistake("map", self.map, "must be a matrix that can be inverted")
        if max(map(abs, self.park_mrad)) > self.limit_mrad:
            raise mistake("park_mrad", self.park_mrad, f"must be within limit_mrad = {self.limit_mrad:g}")
        return self


if not TYPE_CHECKING:
    MirrorSection = with_drivers(MirrorSection, MIRRORS)


AnalogInput = Annotated[Text, like(*ANALOG_INPUT)]


class RecorderSection(DriverTable):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    reference_range_v: Annotated[Positive, ALWAYS] = Field(default=10.0, description="Input range of the loopback")
    response_range_v: Annotated[Positive, ALWAYS] = Field(default=10.0, description="Input range of the vibrometer")
    response_ranges_v: Annotated[tuple[Positive, ...] | None, FREE] = Field(
        default=None,
        description="Larger ranges for a position that was over response_range_v; by default all that the device has",
    )
    reference_gain: Annotated[Positive, ALWAYS] = Field(
        default=1.0, description="Volts at the reference input per volt of drive"
    )
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001), ALWAYS] = Field(
        default=5e-6,
        description="Delay of the response's sampling after the reference's; from calibrate, or the device",
    )
    pre_roll_s: Annotated[NonNegative, Field(le=10), ALWAYS] = Field(
        default=0.02, description="Recorded before the player starts"
    )
    post_roll_s: Annotated[NonNegative, Field(le=10), ALWAYS] = Field(
        default=0.1, description="Recorded after the player should have ended; covers its latency"
    )

    @model_validator(mode="before")
    @classmethod
    def _no_trigger(cls, data: Any) -> Any:
        """An empty trigger is none, said outright."""
        return {**data, "trigger": None} if isinstance(data, dict) and data.get("trigger") == "" else data


class VibrometerSection(SerialSection):
    """The laser vibrometer's calibration: typed in, or read from the device."""

    driver: Annotated[str, FREE] = "fixed"
    sensitivity_m_s_per_v: Annotated[Positive | None, ALWAYS] = Field(
        default=None,
        description="m/s per volt at the DAQ; optional where a port is given, and must then agree with the device",
    )
    latency_s: Annotated[NonNegative, Field(le=0.001)] | None = Field(
        default=None,
        description="Delay of the voltage after the velocity; by default 0, or read from a polytec-ofv5000",
    )

    @model_validator(mode="before")
    @classmethod
    def _fixed(cls, data: Any) -> Any:
        fixed = isinstance(data, dict) and data.get("driver", "fixed") == "fixed"
        return {"sensitivity_m_s_per_v": 0.125, **data} if fixed else data


if not TYPE_CHECKING:
    RecorderSection = with_drivers(RecorderSection, RECORDERS)
    VibrometerSection = with_drivers(VibrometerSection, VIBROMETERS)


class ShutterSection(DriverTable):
    """What blocks the laser beam while it rests, and whenever something fails; nothing, if absent."""

    opens_s: Annotated[NonNegative, Field(le=10), FREE] = Field(
        default=0.02, description="Time that it takes to open or close"
    )


if not TYPE_CHECKING:
    ShutterSection = with_drivers(ShutterSection, SHUTTERS)


Channel = Annotated[Whole, Field(ge=0, le=4095)]


class PlayerSection(DriverTable):
    """The multichannel audio interface that drives the actuators."""

    channels: Annotated[tuple[Channel, ...], ALWAYS] = Field(
        description="Output of each actuator, from 0, in the order of position_mm"
    )
    loopback_channel: Annotated[Channel, ALWAYS] = Field(
        description="Spare output that is wired to the reference input"
    )
    interface_rate_hz: Annotated[Whole, Field(ge=8_000, le=768_000), FREE] = Field(
        default=48_000, description="Rate of the audio interface"
    )
    full_scale_v: Annotated[Positive, ALWAYS] = Field(default=5.0, description="Volts at full scale, all outputs")
    channel_full_scale_v: tuple[Positive, ...] | None = Field(
        default=None, description="Volts at full scale of each output from 0 to the highest used; from calibrate"
    )
    limit_v: Annotated[Positive, FREE] = Field(
        default=5.0, description="Largest voltage of an actuator, at most full_scale_v"
    )
    limit_rms_v: Annotated[Positive | None, FREE] = Field(
        default=None, description="Largest rms voltage of an actuator over any second"
    )
    coil_resistance_ohm: Annotated[Positive | None, FREE] = Field(
        default=None, description="Resistance of an actuator's coil; needed for limit_power_w"
    )
    limit_power_w: Annotated[Positive | None, FREE] = Field(
        default=None,
        description="Largest mean power of a coil over any second; the stricter of it and limit_rms_v counts",
    )

    @property
    def outputs(self) -> int:
        """How many outputs the rig needs: up to the highest that is wired."""
        return 1 + max((*self.channels, self.loopback_channel))

    @property
    def output_full_scale_v(self) -> tuple[float, ...]:
        """Volts at full scale of every output from 0 to the highest that is wired."""
        return self.channel_full_scale_v or (self.full_scale_v,) * self.outputs

    @property
    def largest_v(self) -> float:
        """Largest voltage that may be asked of any actuator: the limit, or what the weakest output can put out."""
        return min(self.limit_v, *(self.output_full_scale_v[channel] for channel in self.channels))

    @property
    def largest_rms_v(self) -> float | None:
        """Largest rms that any actuator may get over a second: its limit, or what makes the coil's power; None: any."""
        return None if (rms := self.rms_limit) is None else rms[1]

    @property
    def largest_sine_v(self) -> float:
        """Largest peak of a sine or a sweep that any actuator may get for as long as one likes."""
        rms_v = self.largest_rms_v
        return self.largest_v if rms_v is None else min(self.largest_v, 2**0.5 * rms_v)

    @property
    def rms_limit(self) -> tuple[str, float] | None:
        """The stricter limit on the rms, with the key that it comes from."""
        limits = []
        if self.limit_rms_v is not None:
            limits.append(("player.limit_rms_v", self.limit_rms_v))
        if self.limit_power_w is not None and self.coil_resistance_ohm is not None:
            limits.append(("player.limit_power_w", (self.limit_power_w * self.coil_resistance_ohm) ** 0.5))
        return min(limits, key=lambda limit: limit[1], default=None)

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
        if self.limit_power_w is not None and self.coil_resistance_ohm is None:
            raise mistake("coil_resistance_ohm", None, "is needed in ohms with limit_power_w")
        each = self.channel_full_scale_v
        if each is not None and self.channels and len(each) != self.outputs:
            wanted = f"must have one entry per output from 0 to the highest used, {self.outputs} in all"
            raise mistake("channel_full_scale_v", each, f"{wanted}, has {len(each)}")
        return self


if not TYPE_CHECKING:
    PlayerSection = with_drivers(PlayerSection, PLAYERS)
