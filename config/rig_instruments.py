"""Mirror, recorder, vibrometer and player of a rig file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from config.drivers import DriverTable, with_drivers
from config.fields import Finite, NonNegative, Positive, Text, Whole, like, mistake
from drivers.daq.nidaqmx import ANALOG_INPUT
from drivers.registry import MIRRORS, PLAYERS, RECORDERS, VIBROMETERS

DEFAULT_DISTANCE_MM = 1000.0
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


class MirrorSection(DriverTable):
    """The scanning mirror and the map from the surface to its angles."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'it, such as "/dev/ttyUSB0", "COM3", "socket://10.0.0.7:4001" or "serial-number:ABC123"',
        "baud": "",
        "identity": "",
    }

    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
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

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
        if self.port is not None:
            check_port("port", self.port)
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


if not TYPE_CHECKING:
    MirrorSection = with_drivers(MirrorSection, MIRRORS.all())


def check_port(key: str, port: str) -> None:
    """Refuse a serial port that is written like a network port or a serial number, but is none.

    Raises PydanticCustomError: A mistake that names the key.
    """
    for beginning, pattern, allowed in (
        ("socket:", r"socket://[^\s/:]+:\d{1,5}", "must be socket://HOST:PORT"),
        ("serial-number:", r"serial-number:\S+", "must be serial-number: and the number itself"),
    ):
        if port.lower().startswith(beginning) and not re.fullmatch(pattern, port):
            raise mistake(key, port, allowed)


AnalogInput = Annotated[Text, like(*ANALOG_INPUT)]


class RecorderSection(DriverTable):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    reference_range_v: Positive = 10.0
    response_range_v: Positive = 10.0
    response_ranges_v: tuple[Positive, ...] | None = None
    reference_gain: Positive = 1.0
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)] = 5e-6
    pre_roll_s: Annotated[NonNegative, Field(le=10)] = 0.02
    post_roll_s: Annotated[NonNegative, Field(le=10)] = 0.1

    @model_validator(mode="before")
    @classmethod
    def _no_trigger(cls, data: Any) -> Any:
        """An empty trigger is none, said outright."""
        return {**data, "trigger": None} if isinstance(data, dict) and data.get("trigger") == "" else data


class VibrometerSection(DriverTable):
    """The laser vibrometer's calibration: typed in, or read from the device."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'the serial port of its controller, such as "COM4"',
        "baud": "",
        "identity": "",
    }

    driver: str = "fixed"
    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
    sensitivity_m_s_per_v: Positive | None = None
    latency_s: Annotated[NonNegative, Field(le=0.001)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _fixed(cls, data: Any) -> Any:
        fixed = isinstance(data, dict) and data.get("driver", "fixed") == "fixed"
        return {"sensitivity_m_s_per_v": 0.125, **data} if fixed else data

    @model_validator(mode="after")
    def _possible(self) -> VibrometerSection:
        if self.port is not None:
            check_port("port", self.port)
        return self


if not TYPE_CHECKING:
    RecorderSection = with_drivers(RecorderSection, RECORDERS.all())
    VibrometerSection = with_drivers(VibrometerSection, VIBROMETERS.all())


Channel = Annotated[Whole, Field(ge=0, le=4095)]


class PlayerSection(DriverTable):
    """The multichannel audio interface that drives the actuators."""

    channels: tuple[Channel, ...]
    loopback_channel: Channel
    interface_rate_hz: Annotated[Whole, Field(ge=8_000, le=768_000)] = 48_000
    full_scale_v: Positive = 5.0
    channel_full_scale_v: tuple[Positive, ...] | None = None
    limit_v: Positive = 5.0
    limit_rms_v: Positive | None = None
    coil_resistance_ohm: Positive | None = None
    limit_power_w: Positive | None = None

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
    def rms_limit(self) -> tuple[str, float] | None:
        """The stricter limit on the rms, with the key that it comes from."""
        limits = []
        if self.limit_rms_v is not None:
            limits.append(("player.limit_rms_v", self.limit_rms_v))
        if self.limit_power_w is not None and self.coil_resistance_ohm is not None:
            limits.append(("player.limit_power_w", (self.limit_power_w * self.coil_resistance_ohm) ** 0.5))
        return min(limits, key=lambda one: one[1], default=None)

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
            raise mistake("coil_resistance_ohm", None, "is needed in ohms beside limit_power_w")
        each = self.channel_full_scale_v
        if each is not None and self.channels and len(each) != self.outputs:
            wanted = f"must have one entry per output from 0 to the highest used, {self.outputs} in all"
            raise mistake("channel_full_scale_v", each, f"{wanted}, has {len(each)}")
        return self


if not TYPE_CHECKING:
    PlayerSection = with_drivers(PlayerSection, PLAYERS.all())
