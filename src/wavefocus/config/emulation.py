"""What `wavefocus emulate` builds, and what the virtual rig is like beside what its own tables say."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from wavefocus.config.fields import ALWAYS, FREE, Finite, NonNegative, Table, Text, Whole, mistake
from wavefocus.config.plate import PlateKeys
from wavefocus.config.rig_instruments import Matrix

Actuator = Annotated[Whole, Field(ge=0, le=1023)]


class WireFaultTable(Table):
    """A fault of an emulated instrument, so that recovery can be watched."""

    role: Text
    kind: Text
    operation: Text = "any"
    at_call: Whole | None = None
    at_s: Finite | None = None
    count: Whole = 1
    seconds: Finite = 0.0


class Emulation(PlateKeys):
    """What `wavefocus emulate` builds, and what the virtual rig is like; real instruments take no notice of it.

    What is left out is as the rig's own tables say, and without a flaw.
    """

    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1), ALWAYS] = Field(
        default=1,
        description="Seed of the rig's flaws; the run file's virtual.seed is stronger for the noise of records",
    )
    noise_v: Annotated[NonNegative | None, ALWAYS] = Field(
        default=None, description="Rms noise of the vibrometer; the run file's virtual.noise_v is stronger"
    )
    reference_noise_v: Annotated[NonNegative | None, ALWAYS] = Field(
        default=None, description="Rms noise of the reference input"
    )
    noise_per_response: NonNegative = Field(
        default=0.0, description="Rms noise that grows with the response, in V per V"
    )
    cubic_per_v2: Finite = Field(
        default=0.0,
        description="Distortion of the plate: u V come out as u + cubic_per_v2 u^3, in 1/V^2; virtual rigs only",
    )
    crosstalk: Annotated[Finite, Field(ge=-1, le=1)] = Field(
        default=0.0,
        description="Share of the loopback voltage that leaks into the response input; the run file's "
        "virtual.crosstalk is stronger",
    )
    crosstalk_delay_s: Annotated[NonNegative, Field(le=0.01)] = Field(
        default=0.0, description="How much later the leak comes than the loopback's voltage"
    )
    clock_ppm: Annotated[Finite, Field(ge=-1000, le=1000), ALWAYS] = Field(
        default=30.0, description="Rate of the recorder's clock beyond the player's"
    )
    inter_channel_delay_s: Annotated[Annotated[Finite, Field(ge=-0.001, le=0.001)] | None, ALWAYS] = Field(
        default=None, description="True delay between the inputs; virtual rigs only, and by default the recorder's"
    )
    mirror_map: Annotated[Matrix | None, ALWAYS] = Field(
        default=None, description="True map of the mirror; by default the mirror's"
    )
    output_latency_spread_s: Annotated[NonNegative, Field(le=0.001), ALWAYS] = Field(
        default=0.0, description="Largest deviation of an output's latency"
    )
    output_gain_spread_db: Annotated[NonNegative, Field(le=20), ALWAYS] = Field(
        default=0.0, description="Largest deviation of an output's level"
    )
    output_gains_db: tuple[Finite, ...] = Field(default=(), description="Deviation of each output's level, from 0 on")
    output_delays_s: tuple[Annotated[Finite, Field(ge=-0.001, le=0.001)], ...] = Field(
        default=(), description="Deviation of each output's latency, from 0 on"
    )
    swapped_outputs: tuple[tuple[Actuator, Actuator], ...] = Field(
        default=(), description="Pairs of outputs whose cables are exchanged"
    )
    reversed_outputs: Annotated[tuple[Actuator, ...], ALWAYS] = Field(
        default=(), description="Outputs whose wires are crossed"
    )
    dead_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = Field(
        default=(), description="Actuators, from 0, that do nothing"
    )
    weak_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = Field(
        default=(), description="Actuators that move a quarter as much"
    )
    reversed_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = Field(
        default=(), description="Actuators that move the other way"
    )
    room_c: Finite | None = Field(
        default=None,
        description="Temperature of the room in degrees Celsius; the run file's virtual.room_c is stronger",
    )
    period_frames: Annotated[Whole, Field(ge=16, le=65_536), FREE] = Field(
        default=4096, description="Frames per period of the emulated audio server"
    )
    ni_product: Annotated[Text, FREE] = Field(default="USB-6211", description="NI box that is emulated")
    fault_plan: Annotated[tuple[WireFaultTable, ...], FREE] = Field(
        default=(),
        description="Faults of the emulated wires: tables with role, kind, operation, at_call or at_s, count, seconds",
    )

    @property
    def is_flawless(self) -> bool:
        """Whether the rig is just as its own tables say."""
        return self.plan_values() == Emulation().plan_values()

    @model_validator(mode="after")
    def _one_flaw_each(self) -> Emulation:
        flaws: dict[int, str] = {}
        for key in ("dead_actuators", "weak_actuators", "reversed_actuators"):
            for index, actuator in enumerate(getattr(self, key)):
                if actuator in flaws:
                    raise mistake(f"{key}.[{index}]", actuator, f"is already one of {flaws[actuator]}")
                flaws[actuator] = key
        return self


def strength(emulation: Emulation, actuators: int) -> tuple[float, ...] | None:
    """Factor on each actuator's strength, as `VirtualSettings` wants it; None where all are sound."""
    factors = dict.fromkeys(emulation.dead_actuators, 0.0)
    # A weak actuator is 12 dB down, at a quarter of its strength.
    factors |= dict.fromkeys(emulation.weak_actuators, 10 ** (-12 / 20))
    factors |= dict.fromkeys(emulation.reversed_actuators, -1.0)
    return tuple(factors.get(actuator, 1.0) for actuator in range(actuators)) if factors else None
