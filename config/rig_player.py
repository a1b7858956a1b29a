"""The multichannel audio interface of a rig file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field, model_validator

from config.drivers import DriverTable, with_drivers
from config.fields import Positive, Whole, mistake
from drivers.registry import PLAYERS

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
