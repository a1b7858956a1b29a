"""A rig operated by hand: orders as JSON objects, carried out one by one, their outcome told as events."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np

from acquisition.manual.level import GatedPlayer, LevelMeter, ShutError
from acquisition.manual.single_sweep import SingleSweeps, SweepOrder, SweepResult, excitation_of
from acquisition.measuring.setup import Setup, asking, instrument_of, names_of, silence
from acquisition.quality.watch import Sensor
from config.rig import RigConfig
from drivers.errors import InstrumentError, TransientInstrumentError
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


# A vibrometer is asked for its light by a serial line, which takes longer than a record.
_LIGHT_EVERY_S = 2.0


class Tell(Protocol):
    """Tells an event and its facts."""

    def __call__(self, event: str, **facts: object) -> None:
        """Tell it."""
        ...


@dataclass(frozen=True, slots=True)
class _Stand:
    """Where the mirror was sent; None before the first move."""

    at_mrad: tuple[float, float]
    parked: bool


class Operation:
    """Carries out orders on an open rig."""

    def __init__(self, rig: RigConfig, setup: Setup, gate: GatedPlayer, light: Sensor | None, tell: Tell) -> None:
        self._rig, self._setup, self._gate, self._light, self._tell = rig, setup, gate, light, tell
        self._meter = LevelMeter(setup, SAMPLE_RATE_HZ)
        self._sweeps = SingleSweeps(setup, SAMPLE_RATE_HZ)
        self._stand: _Stand | None = None
        self._every_s: float | None = None
        self._due_s = 0.0
        self._level: float | None = None
        self._light_due_s = 0.0
        self._acts: Mapping[type, Callable[..., None]] = {
            Jog: self._jog,
            Park: self._park,
            ShowLevel: self._show_level,
            SweepOrder: self._sweep,
            Mute: self._mute,
            TellState: self._tell_state,
            Reconnect: self._reconnect,
            End: self._mute,
        }

    def introduce(self) -> None:
        """Tell which rig this is and what it may do.

        Raises InstrumentError: an instrument does not say who it is.
        """
        rig, setup = self._rig, self._setup
        mirror, recorder, player = names_of(setup.instruments)
        measured = rig.calibration.measured
        self._tell(
            "ready",
            name=rig.rig.name,
            instruments={"mirror": mirror, "recorder": recorder, "player": player},
            surface={"kind": rig.surface.kind, "length_mm": rig.surface.length_mm, "width_mm": rig.surface.width_mm},
            actuator_mm=rig.actuator_mm.tolist(),
            mapped=measured is not None and measured.mirror is not None,
            limit_mrad=rig.mirror.limit_mrad,
            level_v=min(safe_amplitude_v(rig), largest_level_v(rig)),
            largest_level_v=largest_level_v(rig),
            band_hz=list(BAND_HZ),
            range_v=list(setup.range_v),
        )

    def due_s(self) -> float | None:
        """Seconds until `look` has something to do; None while it has nothing."""
        return None if self._every_s is None else max(0.0, self._due_s - time.monotonic())

    def look(self) -> None:
        """Tell the level, where it is to be told and the time has come."""
        if self._every_s is None or time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + self._every_s
        with _Faults(self._tell, self._stop_levels):
            level = self._meter.hear()
            self._tell("level", **asdict(level), light=self._light_now())

    def carry_out(self, order: Order) -> bool:
        """Carry out an order; what prevents it is told. True where it was done."""
        faults = _Faults(self._tell, self._stop_levels)
        with faults:
            self._acts[type(order)](order)
        return not faults.met

    def _jog(self, order: Jog) -> None:
        if order.unit == "mm":
            x_mrad, y_mrad = (float(one) for one in self._setup.mirror_map.angles_mrad(order.x, order.y))
        else:
            x_mrad, y_mrad = order.x, order.y
        limit_mrad = self._rig.mirror.limit_mrad
        if not (abs(x_mrad) <= limit_mrad * (1 + 1e-9) and abs(y_mrad) <= limit_mrad * (1 + 1e-9)):
            raise InputError(
                f"jog: ({x_mrad:.3f}, {y_mrad:.3f}) mrad is beyond mirror.limit_mrad, {limit_mrad:g}: not moved"
            )
        mirror = self._setup.instruments.mirror
        with asking("mirror"):
            mirror.move_to(x_mrad, y_mrad)
            mirror.wait_settled(self._setup.settle_timeout_s)
        self._stand = _Stand((x_mrad, y_mrad), parked=False)
        self._tell_mirror()

    def _park(self, _order: Park) -> None:
        with asking("mirror"):
            self._setup.instruments.mirror.park()
        x_mrad, y_mrad = self._rig.mirror.park_mrad
        self._stand = _Stand((x_mrad, y_mrad), parked=True)
        self._tell_mirror()

    def _show_level(self, order: ShowLevel) -> None:
        self._every_s = order.every_s if order.on else None
        self._due_s = 0.0
        if order.on:
            self._meter.sound(order.actuator, order.level_v)
        self._tell("levels", on=order.on, actuator=order.actuator if order.on else None)

    def _sweep(self, order: SweepOrder) -> None:
        self._tell("sweeping", actuator=order.actuator, level_v=order.amplitude_v)
        self._tell("sweep", **_sweep_facts(order, self._sweeps.take(order)))

    def _mute(self, _order: Mute | End) -> None:
        self._stop_levels()
        failures = silence(self._setup.instruments)
        self._gate.open()
        self._tell("levels", on=False, actuator=None)
        if failures:
            raise failures[0]
        self._tell("muted")

    def _tell_state(self, _order: TellState) -> None:
        self._tell("levels", on=self._every_s is not None, actuator=None)
        self._tell_mirror()

    def _reconnect(self, order: Reconnect) -> None:
        with asking(order.role):  # type: ignore[arg-type]
            instrument_of(self._setup.instruments, order.role).reconnect()
        self._tell("reconnected", instrument=order.role)

    def _tell_mirror(self) -> None:
        if self._stand is None:
            self._tell("mirror", x_mm=None, y_mm=None, x_mrad=None, y_mrad=None, parked=False)
            return
        x_mrad, y_mrad = self._stand.at_mrad
        x_mm: float | None = None
        y_mm: float | None = None
        with suppress(InputError):  # a beam that never meets the surface has no place on it
            x_mm, y_mm = (round(float(one), 4) for one in self._setup.mirror_map.surface_mm(x_mrad, y_mrad))
        self._tell(
            "mirror", x_mm=x_mm, y_mm=y_mm, x_mrad=round(x_mrad, 4), y_mrad=round(y_mrad, 4), parked=self._stand.parked
        )

    def _light_now(self) -> float | None:
        if self._light is not None and time.monotonic() >= self._light_due_s:
            self._light_due_s = time.monotonic() + _LIGHT_EVERY_S
            try:
                self._level = self._light.read()
            except InstrumentError:  # it is no instrument of the level; the level goes on without it
                self._level = None
        return self._level

    def _stop_levels(self) -> None:
        self._every_s = None


class _Faults:
    """Tells what an order fails at, so that the next one can be carried out; defects of the program pass."""

    def __init__(self, tell: Tell, stop_levels: Callable[[], None]) -> None:
        self._tell, self._stop_levels = tell, stop_levels
        self.met = False

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, failure: BaseException | None, trace: object) -> bool:
        if failure is None:
            return False
        self.met = True
        match failure:
            case ShutError():
                self._tell("muted")
            case InputError():
                self._tell("refused", sentence=str(failure))
            case InstrumentError():
                if not isinstance(failure, TransientInstrumentError):
                    self._stop_levels()
                tell_fault(self._tell, failure)
            case ArithmeticError() | np.linalg.LinAlgError() | MemoryError():
                self._stop_levels()
                self._tell("refused", sentence=f"cannot be computed: {str(failure) or type(failure).__name__}")
            case _:
                return False
        return True


def tell_fault(tell: Tell, failure: InstrumentError) -> None:
    """Tell an instrument's failure, part by part and as one sentence."""
    tell(
        "fault",
        instrument=failure.role or failure.instrument.split(" ")[0],
        device=failure.instrument,
        operation=failure.operation,
        cause=failure.cause,
        remedy=failure.remedy,
        passing=isinstance(failure, TransientInstrumentError),
        sentence=" ".join(str(failure).split()),
    )


def _sweep_facts(order: SweepOrder, result: SweepResult) -> dict[str, object]:
    """A sweep for JSON: numbers to the digits that mean something."""
    figures = None
    if result.figures is not None:
        # Silence has ratios that are no numbers; JSON has none for those.
        figures = {
            key: (value if np.isfinite(value) else None) if isinstance(value, float) else value
            for key, value in asdict(result.figures).items()
        }
        figures["defects"] = [{"name": name, "sentence": sentence} for name, sentence in result.figures.defects]
    return {
        "actuator": order.actuator,
        "level_v": order.amplitude_v,
        "start_hz": order.start_hz,
        "stop_hz": order.stop_hz,
        "sample_rate_hz": result.sample_rate_hz,
        "level": asdict(result.level),
        "figures": figures,
        "trouble": result.trouble,
        "reference_v": np.round(result.reference_v.astype(np.float64), 7).tolist(),
        "response_v": np.round(result.response_v.astype(np.float64), 7).tolist(),
        "frequency_hz": np.round(result.frequency_hz, 3).tolist(),
        "response_db": np.round(result.response_db, 2).tolist(),
        "noise_db": np.round(result.noise_db, 2).tolist(),
    }
