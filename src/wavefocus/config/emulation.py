"""The plate behind a virtual or emulated rig, what `wavefocus emulate` builds, the flaws and the faults of both."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, ValidationInfo, model_validator
from pydantic_core import PydanticCustomError

from wavefocus.config.fields import (
    ALWAYS,
    FREE,
    KEPT,
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
GEL_SPEED_M_S, GEL_PRESSURE_SPEED_M_S = 4.7072696192, 9.4
"""Of waves in the gel (see `mocks.plates.soft`), and twice that: pressure waves of a thin free layer of it."""
_GONE = (
    ("loss", "springpot", 'is gone: the loss of the plate "soft" is nearly the same at all frequencies'),
    ("edge", "infinite", 'is gone: the plate "soft" has no rim'),
)
"""Keys and values of earlier versions, which banks hold, and what serves instead."""


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
        "soft", '"damped" has no effect; "springpot" is of banks of earlier versions'
    )
    rim_admittance: NonNegative | None = _of_plate("stadium", "0 is a free edge, 1 absorbs waves at a right angle")
    quality: Annotated[Positive, Field(le=1e5)] | None = _of_plate("thin", "quality factor of its modes")
    edge: Literal["supported", "infinite"] | None = _of_plate(
        "thin", '"supported" has no effect; "infinite" is of banks of earlier versions'
    )
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

    @property
    def gone(self) -> tuple[str, str, str] | None:
        """Key, value and what serves instead, of a plate that only earlier versions simulated."""
        return next((one for one in _GONE if getattr(self, one[0]) == one[1]), None)

    @model_validator(mode="after")
    def _keys_of_this_plate(self, info: ValidationInfo) -> PlateKeys:
        for key, value in self.plate_keys.items():
            if (plate := _plate_of_key().get(key, self.plate)) != self.plate:
                raise mistake(key, value, f'belongs to plate = "{plate}"')
        if self.gone is not None and info.context is not KEPT:
            raise mistake(*self.gone)
        shear, pressure = self.shear_speed_m_s or GEL_SPEED_M_S, self.pressure_speed_m_s or GEL_PRESSURE_SPEED_M_S
        # The bulk modulus of a solid with slower pressure waves would be negative.
        if not pressure > (slowest := 2 / 3**0.5 * shear) and info.context is not KEPT:
            raise mistake("pressure_speed_m_s", pressure, f"must be above {slowest:.4g}, 2 / sqrt(3) shear_speed_m_s")
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


_WIRE_KINDS = {
    "mirror": ("silent", "late", "truncated", "garbled", "stalled", "refused", "unplugged", "impostor", "restarted"),
    "vibrometer": ("silent", "late", "truncated", "garbled", "stalled", "refused", "unplugged", "impostor"),
    "recorder": (
        "overwritten",
        "read_timeout",
        "unplugged",
        "absent",
        "wrong_name",
        "in_use",
        "usb_aborted",
        "wait_timeout",
        "unknown_code",
        "silent",
        "server_dead",
        "short_read",
        "missing_reference",
        "over_range",
        "warning",
        "internal",
        "exhausted",
    ),
    "player": ("underflow", "lost", "frozen"),
}


class WireFault(Table):
    """One entry of a wire's fault plan.

    role: Whose emulated instrument: a key of `_WIRE_KINDS`.
    kind: What happens: one of `_WIRE_KINDS[role]`.
    operation: The call that meets it: the verb of a serial dialect (``"identify"``, ``"move"``, ``"busy"``,
        ``"where"``...), the name of a remote procedure (``"ReadAnalogF64"``), ``"period"`` of an audio server, or
        ``"any"``.
    at_call: The first call of the operation that meets it, from 1.
    at_s: In its place: the first call this many seconds after the emulated instrument's start.
    count: How many calls in a row, > 0.
    seconds: How long a late answer is late, or a device stays unplugged, >= 0; 0 for good where it is unplugged.
    """

    role: Text
    kind: Text
    operation: Text = "any"
    at_call: Annotated[Whole, Field(ge=1)] | None = None
    at_s: NonNegative | None = None
    count: Annotated[Whole, Field(ge=1)] = 1
    seconds: NonNegative = 0.0

    @model_validator(mode="after")
    def _can_happen(self, info: ValidationInfo) -> WireFault:
        if info.context is KEPT:
            return self
        if self.role not in _WIRE_KINDS:
            raise _impossible(self, f"fault role is {self.role!r}; allowed: {', '.join(_WIRE_KINDS)}")
        if self.kind not in _WIRE_KINDS[self.role]:
            allowed = ", ".join(_WIRE_KINDS[self.role])
            raise _impossible(self, f"fault kind of the {self.role} is {self.kind!r}; allowed: {allowed}")
        if (self.at_call is None) == (self.at_s is None):
            raise _impossible(self, "a fault needs either at_call or at_s")
        return self


_OPERATIONS = {
    "mirror": ("identify", "move_to", "wait_settled", "park", "reconnect"),
    "recorder": ("identify", "start", "read", "reconnect"),
    "player": ("identify", "play", "wait", "mute", "reconnect"),
}
ANYWHERE = ("timeout", "lost", "unplugged", "hang")
CORRUPTING = (
    "missing_reference", "over_range", "dropout", "drift", "dark", "faint_reference",
    "clipped", "lost_sample", "hum", "dead_response",
)  # fmt: skip


class RigFault(Table):
    """One entry of a fault plan: at the given call, or at the given record.

    role: ``"mirror"``, ``"recorder"`` or ``"player"``.
    operation: Method that fails, such as ``"read"``.
    kind: ``"timeout"`` (any), ``"lost"`` (any; it stays lost), ``"unplugged"`` (any but reconnect; once, and then gone
        until it is plugged in again), ``"hang"`` (any; the call never returns, for a record only the first),
        ``"underflow"`` (player wait), ``"short_read"``, ``"missing_reference"``, ``"over_range"``, ``"dropout"``,
        ``"drift"``, ``"dark"`` (no light comes back to the vibrometer in the whole record), ``"faint_reference"``,
        ``"clipped"`` (the response's peaks are cut off before the converter), ``"lost_sample"`` (one sample of the
        response is missing in the middle), ``"hum"`` (50 Hz on the response) or ``"dead_response"`` (the response
        channel is constant; recorder read).
    at_call: The first call of the method that fails, from 1; `count` calls fail in a row.
    position, record, attempt: The record that fails, where no call is given: this position (any, if absent), this
        record of each attempt (every, if absent), from this attempt on (1, if absent) for `count` attempts. A mirror
        has no records.
    purpose: Only records of this purpose; any, if absent.
    count: How often, > 0.
    level_db: What ``"drift"`` does to the response, and ``"faint_reference"`` to the reference; where ``"clipped"``
        cuts the response, in dB of its peak; the level of ``"hum"``, in dB of the response's rms.
    tries: How many times ``reconnect`` fails before one succeeds, where ``"unplugged"``, >= 0.
    spot_mm: Where ``"dark"`` is dark: x, y and radius in mm; everywhere, if absent.
    """

    role: Text
    operation: Text
    kind: Text
    at_call: Annotated[Whole, Field(ge=1)] | None = None
    position: Annotated[Whole, Field(ge=0)] | None = None
    attempt: Annotated[Whole, Field(ge=1)] | None = None
    record: Annotated[Whole, Field(ge=0)] | None = None
    purpose: Literal["capture", "sentinel", "probe", "scan", "presentation", "trial", "crosstalk"] | None = None
    count: Annotated[Whole, Field(ge=1)] = 1
    level_db: Finite = -3.0
    tries: Annotated[Whole, Field(ge=0)] = 1
    spot_mm: tuple[Finite, Finite, Positive] | None = None

    @model_validator(mode="after")
    def _can_happen(self, info: ValidationInfo) -> RigFault:
        if info.context is KEPT:
            return self
        if self.role not in _OPERATIONS:
            raise _impossible(self, f"fault role is {self.role!r}; allowed: {', '.join(_OPERATIONS)}")
        if self.operation not in _OPERATIONS[self.role]:
            allowed = ", ".join(_OPERATIONS[self.role])
            raise _impossible(self, f"fault operation of the {self.role} is {self.operation!r}; allowed: {allowed}")
        allowed_kinds = [kind for kind in ANYWHERE if (self.operation, kind) != ("reconnect", "unplugged")]
        if (self.role, self.operation) == ("player", "wait"):
            allowed_kinds.append("underflow")
        if (self.role, self.operation) == ("recorder", "read"):
            allowed_kinds += ["short_read", *CORRUPTING]
        if self.kind not in allowed_kinds:
            allowed = ", ".join(allowed_kinds)
            raise _impossible(self, f"fault kind of {self.role} {self.operation} is {self.kind!r}; allowed: {allowed}")
        by_take = (self.position, self.attempt, self.record, self.purpose) != (None, None, None, None)
        if (self.at_call is not None) == by_take:
            raise _impossible(self, "a fault needs either at_call or some of position, attempt, record and purpose")
        if by_take and self.role == "mirror":
            raise _impossible(self, "a fault of the mirror needs at_call, for a mirror has no records")
        if self.kind == "unplugged" and self.count != 1:
            raise _impossible(self, f"fault count is {self.count}; an instrument is unplugged once, count 1")
        return self


def _impossible(fault: WireFault | RigFault, reason: str) -> PydanticCustomError:
    return mistake("", fault.model_dump(exclude_defaults=True), reason)


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
    fault_plan: Annotated[tuple[WireFault, ...], FREE] = default(
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
