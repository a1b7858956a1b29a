"""The plate behind a virtual or emulated rig, and the keys that only some plates have."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, model_validator

from wavefocus.config.fields import ALWAYS, Finite, NonNegative, PointMm, Positive, Table, mistake

FINGER_MM = 3.0
"""Half the width of a finger, and a little."""
_OF_ANY_PLATE = ("speed_per_k", "loss_per_k", "finger")


def of_plate(plate: str, description: str) -> Any:
    """A key that only one plate has: its declaration is all that a new key needs."""
    about: dict[str, JsonValue] = {"plate": plate}
    return Field(default=None, description=f'Of the plate "{plate}": {description}', json_schema_extra=about)


class Finger(Table):
    """A finger that rests on the surface: mass, damper and spring at one place."""

    place_mm: Annotated[PointMm, ALWAYS]
    mass_kg: Annotated[NonNegative, ALWAYS] = 0.0
    damping_n_s_m: Annotated[NonNegative, ALWAYS] = 0.0
    stiffness_n_m: Annotated[NonNegative, ALWAYS] = 0.0


class PlateKeys(Table):
    """The keys of a plate, as tables of run and rig files have them."""

    plate: Literal["soft", "stadium", "thin", "solid"] = Field(
        default="soft",
        description="A gel without a rim, a gel whose rim reflects waves (pip install 'wavefocus[plates]'), glass, "
        "or a gel without a rim that moves in its plane",
    )
    loss: Literal["damped", "springpot"] | None = of_plate(
        "soft", "the same at all frequencies, nearly, or a springpot's, growing with them"
    )
    rim_admittance: NonNegative | None = of_plate("stadium", "0 is a free edge, 1 absorbs waves at a right angle")
    quality: Annotated[Positive, Field(le=1e5)] | None = of_plate("thin", "quality factor of its modes and waves")
    edge: Literal["supported", "infinite"] | None = of_plate("thin", "a rectangle that is simply supported, or none")
    mode_tolerance: Annotated[NonNegative, Field(le=1)] | None = of_plate(
        "thin", "no effect: all modes are summed (earlier versions left some out)"
    )
    shear_speed_m_s: Positive | None = of_plate("solid", "speed of shear waves")
    pressure_speed_m_s: Positive | None = of_plate("solid", "speed of pressure waves, above 1.155 shear_speed_m_s")
    damping_per_s: NonNegative | None = of_plate("solid", "rate of relaxation of its moduli, in 1/s")
    force_deg: Finite | None = of_plate("solid", "direction in which actuators push, from x towards y")
    oscillation_deg: Finite | None = of_plate("solid", "direction of the velocity that is measured")

    finger: Finger | None = Field(
        default=None,
        description="A finger on the surface: { place_mm = [x, y], mass_kg, damping_n_s_m, stiffness_n_m }",
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
