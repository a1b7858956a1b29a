"""The plate behind a virtual or emulated rig, what `wavefocus emulate` builds, and the flaws of both."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, model_validator

from wavefocus.config.fields import (
    ALWAYS,
    FREE,
    Finite,
    Matrix,
    NonNegative,
    PointMm,
    Positive,
    Table,
    Text,
    Whole,
    default,
    mistake,
)

FINGER_MM = 3.0
"""Half the width of a finger, and a little."""
_OF_ANY_PLATE = ("speed_per_k", "loss_per_k", "finger")


def _of_plate(plate: str, description: str) -> Any:
    """A key that only one plate has: its declaration is all that a new key needs."""
    about: dict[str, JsonValue] = {"plate": plate}
    return default(None, f'Of the plate "{plate}": {description}', json_schema_extra=about)


class Finger(Table):
    """A finger that rests on the surface: mass, damper and spring at one place."""

    place_mm: Annotated[PointMm, ALWAYS]
    mass_kg: Annotated[NonNegative, ALWAYS] = 0.0
    damping_n_s_m: Annotated[NonNegative, ALWAYS] = 0.0
    stiffness_n_m: Annotated[NonNegative, ALWAYS] = 0.0


class PlateKeys(Table):
    """The keys of a plate, as tables of run and rig files have them."""

    plate: Literal["soft", "stadium", "thin", "solid"] = default(
        "soft",
        "A gel without a rim, a gel whose rim reflects waves (pip install 'wavefocus[plates]'), glass, or a "
        "gel without a rim that moves in its plane",
    )
    loss: Literal["damped", "springpot"] | None = _of_plate(
        "soft", "the same at all frequencies, nearly, or a springpot's, growing with them"
    )
    rim_admittance: NonNegative | None = _of_plate("stadium", "0 is a free edge, 1 absorbs waves at a right angle")
    quality: Annotated[Positive, Field(le=1e5)] | None = _of_plate("thin", "quality factor of its modes and waves")
    edge: Literal["supported", "infinite"] | None = _of_plate("thin", "a rectangle that is simply supported, or none")
    mode_tolerance: Annotated[NonNegative, Field(le=1)] | None = _of_plate(
        "thin", "no effect: all modes are summed (earlier versions left some out)"
    )
    shear_speed_m_s: Positive | None = _of_plate("solid", "speed of shear waves")
    pressure_speed_m_s: Positive | None = _of_plate("solid", "speed of pressure waves, above 1.155 shear_speed_m_s")
    damping_per_s: NonNegative | None = _of_plate("solid", "rate of relaxation of its moduli, in 1/s")
    force_deg: Finite | None = _of_plate("solid", "direction in which actuators push, from x towards y")
    oscillation_deg: Finite | None = _of_plate("solid", "direction of the velocity that is measured")

    finger: Finger | None = default(
        None, "A finger on the surface: { place_mm = [x, y], mass_kg, damping_n_s_m, stiffness_n_m }"
    )

    @property
    def plate_keys(self) -> dict[str, Any]:
        """The keys of the plate that are given."""
        return self.model_dump(include={*_plate_of_key(), *_OF_ANY_PLATE}, exclude_none=True)

    @property
    def directions_deg(self) -> tuple[float, float] | None:
        """Directions of force and oscillation, from x towards y; None of plates that move along one line."""
        return (self.force_deg or 0.0, self.oscillation_deg or 0.0) if self.plate == "solid" else None

    @model_validator(mode="after")
    def _keys_of_this_plate(self) -> PlateKeys:
        for key, value in self.plate_keys.items():
            if (plate := _plate_of_key().get(key, self.plate)) != self.plate:
                raise mistake(key, value, f'belongs to plate = "{plate}"')
        return self


@cache
def _plate_of_key() -> dict[str, str]:
    """Keys that only one plate has, and which."""
    extra = {name: field.json_schema_extra for name, field in PlateKeys.model_fields.items()}
    return {name: str(about["plate"]) for name, about in extra.items() if isinstance(about, dict) and "plate" in about}


def plate_of(virtual: PlateKeys | None, emulation: PlateKeys) -> PlateKeys:
    """Plate of a virtual rig: the run file's where it asks for any but the default, else the rig file's."""
    asked = virtual is not None and (virtual.plate_keys or virtual.plate != PlateKeys().plate)
    return virtual if virtual is not None and asked else emulation


Actuator = Annotated[Whole, Field(ge=0, le=1023)]


class _WireFaultTable(Table):
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

    seed: Annotated[Whole, ALWAYS] = default(
        1,
        "Seed of the rig's flaws; the run file's virtual.seed is stronger for the noise of records",
        ge=0,
        le=2**63 - 1,
    )
    noise_v: Annotated[NonNegative | None, ALWAYS] = default(
        None, "Rms noise of the vibrometer; the run file's virtual.noise_v is stronger"
    )
    reference_noise_v: Annotated[NonNegative | None, ALWAYS] = default(None, "Rms noise of the reference input")
    noise_per_response: NonNegative = default(0.0, "Rms noise that grows with the response, in V per V")
    cubic_per_v2: Finite = default(
        0.0, "Distortion of the plate: u V come out as u + cubic_per_v2 u^3, in 1/V^2; virtual rigs only"
    )
    crosstalk: Finite = default(
        0.0,
        "Share of the loopback voltage that leaks into the response input; the run file's virtual.crosstalk "
        "is stronger",
        ge=-1,
        le=1,
    )
    crosstalk_delay_s: NonNegative = default(0.0, "How much later the leak comes than the loopback's voltage", le=0.01)
    clock_ppm: Annotated[Finite, ALWAYS] = default(
        30.0, "Rate of the recorder's clock beyond the player's", ge=-1000, le=1000
    )
    inter_channel_delay_s: Annotated[Annotated[Finite, Field(ge=-0.001, le=0.001)] | None, ALWAYS] = default(
        None, "True delay between the inputs; virtual rigs only, and by default the recorder's"
    )
    mirror_map: Annotated[Matrix | None, ALWAYS] = default(None, "True map of the mirror; by default the mirror's")
    output_latency_spread_s: Annotated[NonNegative, ALWAYS] = default(
        0.0, "Largest deviation of an output's latency", le=0.001
    )
    output_gain_spread_db: Annotated[NonNegative, ALWAYS] = default(
        0.0, "Largest deviation of an output's level", le=20
    )
    output_gains_db: tuple[Finite, ...] = default((), "Deviation of each output's level, from 0 on")
    output_delays_s: tuple[Annotated[Finite, Field(ge=-0.001, le=0.001)], ...] = default(
        (), "Deviation of each output's latency, from 0 on"
    )
    swapped_outputs: tuple[tuple[Actuator, Actuator], ...] = default((), "Pairs of outputs whose cables are exchanged")
    reversed_outputs: Annotated[tuple[Actuator, ...], ALWAYS] = default((), "Outputs whose wires are crossed")
    dead_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = default((), "Actuators, from 0, that do nothing")
    weak_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = default((), "Actuators that move a quarter as much")
    reversed_actuators: Annotated[tuple[Actuator, ...], ALWAYS] = default((), "Actuators that move the other way")
    room_c: Finite | None = default(
        None, "Temperature of the room in degrees Celsius; the run file's virtual.room_c is stronger"
    )
    period_frames: Annotated[Whole, FREE] = default(
        4096, "Frames per period of the emulated audio server", ge=16, le=65_536
    )
    ni_product: Annotated[Text, FREE] = default("USB-6211", "NI box that is emulated")
    fault_plan: Annotated[tuple[_WireFaultTable, ...], FREE] = default(
        (), "Faults of the emulated wires: tables with role, kind, operation, at_call or at_s, count, seconds"
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
