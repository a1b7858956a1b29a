"""What stands behind an emulated or virtual rig: the truth that its own tables only believe."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from config.fields import Finite, NonNegative, Table, Text, Whole, mistake
from config.rig_mirror import Matrix

Actuator = Annotated[Whole, Field(ge=0, le=1023)]


class WireFaultTable(Table):
    """A fault for the far side of a wire to show, so that recovery can be watched."""

    role: Text
    kind: Text
    operation: Text = "any"
    at_call: Whole | None = None
    at_s: Finite | None = None
    count: Whole = 1
    seconds: Finite = 0.0


class Emulation(Table):
    """What `wavefocus emulate` builds, and what the virtual rig is like; real instruments take no notice of it.

    What is left out is as the rig's own tables say, and without a flaw.
    """

    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 1
    noise_v: NonNegative | None = None
    reference_noise_v: NonNegative | None = None
    noise_per_response: NonNegative = 0.0
    cubic_per_v2: Finite = 0.0
    clock_ppm: Annotated[Finite, Field(ge=-1000, le=1000)] = 30.0
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)] | None = None
    mirror_map: Matrix | None = None
    output_latency_spread_s: Annotated[NonNegative, Field(le=0.001)] = 0.0
    output_gain_spread_db: Annotated[NonNegative, Field(le=20)] = 0.0
    reversed_outputs: tuple[Actuator, ...] = ()
    dead_actuators: tuple[Actuator, ...] = ()
    weak_actuators: tuple[Actuator, ...] = ()
    reversed_actuators: tuple[Actuator, ...] = ()
    period_frames: Annotated[Whole, Field(ge=16, le=65_536)] = 4096
    ni_product: Text = "USB-6211"
    fault_plan: tuple[WireFaultTable, ...] = ()

    @property
    def is_flawless(self) -> bool:
        """Whether the rig is just as its own tables say."""
        return self.truth() == Emulation().truth()

    def truth(self) -> dict[str, object]:
        """What is measured of the rig depends on this; on faults and on how a wire is emulated it does not."""
        unused = {key for key in ("noise_per_response", "cubic_per_v2") if getattr(self, key) == 0}
        return self.model_dump(exclude={"fault_plan", "period_frames", "ni_product"} | unused)

    @model_validator(mode="after")
    def _one_flaw_each(self) -> Emulation:
        flaws: dict[int, str] = {}
        for key in ("dead_actuators", "weak_actuators", "reversed_actuators"):
            for index, actuator in enumerate(getattr(self, key)):
                if actuator in flaws:
                    raise mistake(f"{key}.[{index}]", actuator, f"is already one of {flaws[actuator]}")
                flaws[actuator] = key
        return self


WEAK_STRENGTH = 10 ** (-12 / 20)
"""What is left of an actuator that is weak: a quarter."""


def strength(emulation: Emulation, actuators: int) -> tuple[float, ...] | None:
    """Factor on each actuator's strength, as `VirtualSettings` wants it; None where all are sound."""
    factors = dict.fromkeys(emulation.dead_actuators, 0.0)
    factors |= dict.fromkeys(emulation.weak_actuators, WEAK_STRENGTH)
    factors |= dict.fromkeys(emulation.reversed_actuators, -1.0)
    return tuple(factors.get(actuator, 1.0) for actuator in range(actuators)) if factors else None
