"""Orders to ``wavefocus operate``: from a JSON object to what is meant, or a sentence about what is wrong with it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from acquisition.manual.single_sweep import SweepOrder, excitation_of
from config.rig import RigConfig
from storage.errors import InputError
from wavefocus.exits import one_line
from wavefocus.rig.limits import largest_sine_v, safe_amplitude_v

SAMPLE_RATE_HZ = 10_000.0
BAND_HZ = (40.0, 400.0)
DURATION_S = 0.5
LONGEST_S = 10.0
EVERY_S = 0.25
# Below the least step of any converter nothing would be played.
LEAST_LEVEL_V = 1e-6
_LARGEST = 1e9
ROLES = ("mirror", "recorder", "player")


@dataclass(frozen=True, slots=True)
class Jog:
    """Move the beam: to a place on the surface, or to angles."""

    x: float
    y: float
    unit: str


@dataclass(frozen=True, slots=True)
class Park:
    """Move the beam to the safe direction."""


@dataclass(frozen=True, slots=True)
class ShowLevel:
    """Stream levels, or stop; while one actuator plays short sweeps, where one is named."""

    on: bool
    every_s: float
    actuator: int | None
    level_v: float


@dataclass(frozen=True, slots=True)
class Mute:
    """Be silent; levels stop too."""


@dataclass(frozen=True, slots=True)
class TellState:
    """Tell where everything stands."""


@dataclass(frozen=True, slots=True)
class Reconnect:
    """Open an instrument afresh."""

    role: str


@dataclass(frozen=True, slots=True)
class End:
    """Put everything to rest and end."""


Order = Jog | Park | ShowLevel | SweepOrder | Mute | TellState | Reconnect | End

# Every key of every order, beside "order" and "id".
KEYS: Mapping[str, tuple[str, ...]] = {
    "jog": ("x_mm", "y_mm", "x_mrad", "y_mrad"),
    "park": (),
    "level": ("on", "every_s", "actuator", "level_v"),
    "sweep": ("actuator", "level_v", "start_hz", "stop_hz", "duration_s"),
    "mute": (),
    "state": (),
    "reconnect": ("instrument",),
    "end": (),
}


def order_of(content: Mapping[str, object], rig: RigConfig) -> Order:
    """Understand an order, within the rig's limits.

    Raises InputError: it is not understood, or asks for more than the rig may do.
    """
    word = content.get("order")
    if not isinstance(word, str) or word not in KEYS:
        raise InputError(f"order {one_line(repr(word), 60)} is not known; allowed: {', '.join(KEYS)}")
    if not isinstance(content.get("id"), str | int | float | None):
        raise InputError(f"{word}: id is {one_line(repr(content['id']), 60)}; allowed: text or a number")
    for key in content:
        if key not in ("order", "id", *KEYS[word]):
            raise InputError(f"{word}: {one_line(key, 60)} is not known; allowed: {', '.join(KEYS[word]) or 'none'}")
    match word:
        case "jog":
            return _jog(content)
        case "level":
            return _level(content, rig)
        case "sweep":
            return _sweep(content, rig)
        case "reconnect":
            role = content.get("instrument")
            if not isinstance(role, str) or role not in ROLES:
                raise InputError(f"reconnect: instrument is {one_line(repr(role), 60)}; allowed: {', '.join(ROLES)}")
            return Reconnect(role)
    simple: dict[str, Order] = {"park": Park(), "mute": Mute(), "state": TellState(), "end": End()}
    return simple[word]


def largest_level_v(rig: RigConfig) -> float:
    """Largest peak of a sweep: within the actuators' limits and what the loopback's output can put out."""
    player = rig.player
    return min(largest_sine_v(player), player.output_full_scale_v[player.loopback_channel])


def _jog(content: Mapping[str, object]) -> Jog:
    for unit in ("mm", "mrad"):
        if f"x_{unit}" in content or f"y_{unit}" in content:
            other = "mrad" if unit == "mm" else "mm"
            if f"x_{other}" in content or f"y_{other}" in content:
                raise InputError("jog: give millimetres or milliradians, not both")
            x, y = (_number(content, f"jog: {axis}_{unit}", f"{axis}_{unit}") for axis in "xy")
            return Jog(x, y, unit)
    raise InputError("jog: x_mm and y_mm, or x_mrad and y_mrad, are missing")


def _level(content: Mapping[str, object], rig: RigConfig) -> ShowLevel:
    on = content.get("on", True)
    if not isinstance(on, bool):
        raise InputError(f"level: on is {one_line(repr(on), 60)}; allowed: true, false")
    every_s = _number(content, "level: every_s", "every_s", EVERY_S, 0.1, 60.0)
    actuator = None if content.get("actuator") is None else _actuator(content, "level", rig)
    return ShowLevel(on, every_s, actuator, _volts(content, "level", rig))


def _sweep(content: Mapping[str, object], rig: RigConfig) -> SweepOrder:
    order = SweepOrder(
        actuator=_actuator(content, "sweep", rig),
        amplitude_v=_volts(content, "sweep", rig),
        start_hz=_number(content, "sweep: start_hz", "start_hz", BAND_HZ[0], 1.0, SAMPLE_RATE_HZ / 2),
        stop_hz=_number(content, "sweep: stop_hz", "stop_hz", BAND_HZ[1], 1.0, SAMPLE_RATE_HZ / 2),
        duration_s=_number(content, "sweep: duration_s", "duration_s", DURATION_S, 0.05, LONGEST_S),
    )
    excitation_of(order, SAMPLE_RATE_HZ)  # refuses a band that no sweep has
    return order


def _actuator(content: Mapping[str, object], word: str, rig: RigConfig) -> int:
    actuator, count = content.get("actuator"), len(rig.player.channels)
    if isinstance(actuator, bool) or not isinstance(actuator, int) or not 0 <= actuator < count:
        raise InputError(f"{word}: actuator is {one_line(repr(actuator), 60)}; allowed: 0 to {count - 1}")
    return actuator


def _volts(content: Mapping[str, object], word: str, rig: RigConfig) -> float:
    largest_v = largest_level_v(rig)
    level_v = _number(content, f"{word}: level_v", "level_v", min(safe_amplitude_v(rig), largest_v))
    if not LEAST_LEVEL_V <= level_v <= largest_v * (1 + 1e-9):
        raise InputError(
            f"{word}: level_v is {level_v:g} V; allowed: {LEAST_LEVEL_V:g} V to at most {largest_v:.4g} V, what the "
            "rig file lets an actuator have (player.limit_v, limit_rms_v, limit_power_w)"
        )
    return level_v


def _number(
    content: Mapping[str, object],
    named: str,
    key: str,
    default: float | None = None,
    low: float = -math.inf,
    high: float = math.inf,
) -> float:
    value = content.get(key, default)
    # No quantity here comes near the limit, and squares and products of what is allowed stay finite.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        raise InputError(f"{named} is {one_line(repr(value), 60)}; allowed: a finite number, at most {_LARGEST:g}")
    if not low <= value <= high:
        raise InputError(f"{named} is {value:g}; allowed: {low:g} to {high:g}")
    return float(value)
