"""A rig operated by hand: orders are checked against the rig's limits and carried out one by one."""

import time
from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np
from msgspec.structs import replace

from wavefocus.acquisition.manual import ManualMeasurements, excitation_of
from wavefocus.acquisition.setup import SETTLE_S, Sensor, Setup, names_of, naming_role, silence
from wavefocus.config.messages import Message, MessageError, Refused, tag
from wavefocus.config.messages.operate import (
    ORDERS,
    SWEEP_BAND_HZ,
    End,
    Faulted,
    InputLevels,
    Jog,
    LevelMeasured,
    LevelsSwitched,
    MirrorMoved,
    Mute,
    Muted,
    Park,
    Ready,
    Reconnect,
    Reconnected,
    ReportState,
    RigOrder,
    ShowLevel,
    SurfaceSize,
    Sweeping,
    TakeSweep,
)
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.timeouts import BoundedPlayer, ShutError
from wavefocus.json_lines import read_order, wrong_order
from wavefocus.storage.errors import InputError

SAMPLE_RATE_HZ = 10_000.0
# Below the least step of any converter nothing would be played.
MIN_LEVEL_V = 1e-6
# No coordinate comes near it, and its square is finite.
_LARGEST = 1e9

Publish = Callable[[Message], None]


def order_of(content: Mapping[str, object], rig: RigConfig) -> RigOrder:
    """Read an order within the rig's limits; a level that is not given becomes the default.

    Raises InputError: a key or value is wrong, or the order asks for more than the rig may do.
    """
    order = read_order(content, ORDERS)
    try:
        match order:
            case Jog():
                _check_jog(order)
            case ShowLevel():
                _require("every_s", order.every_s, 0.1, 60.0)
                order = replace(order, level_v=_level_v(order.level_v, rig))
                if order.actuator is not None:
                    _require("actuator", order.actuator, 0, len(rig.player.channels) - 1)
            case TakeSweep():
                _require("actuator", order.actuator, 0, len(rig.player.channels) - 1)
                _require("start_hz", order.start_hz, 1.0, SAMPLE_RATE_HZ / 2)
                _require("stop_hz", order.stop_hz, 1.0, SAMPLE_RATE_HZ / 2)
                _require("duration_s", order.duration_s, 0.05, 10.0)
                order = replace(order, level_v=_level_v(order.level_v, rig))
                excitation_of(order, SAMPLE_RATE_HZ)  # refuses a band that no sweep has
    except MessageError as wrong:
        raise wrong_order(tag(order), wrong) from None
    return order


def _check_jog(order: Jog) -> None:
    given = {"mm": (order.x_mm, order.y_mm), "mrad": (order.x_mrad, order.y_mrad)}
    units = [unit for unit, numbers in given.items() if numbers != (None, None)]
    if len(units) != 1:
        raise MessageError("needs x_mm and y_mm, or x_mrad and y_mrad, and not both")
    for axis, value in zip("xy", given[units[0]], strict=True):
        _require(f"{axis}_{units[0]}", value, -_LARGEST, _LARGEST)


def _require(key: str, value: float | None, low: float, high: float) -> None:
    if value is None or not low <= value <= high:
        raise MessageError(f"{key} is {value}; allowed: {low:g} to {high:g}")


def largest_level_v(rig: RigConfig) -> float:
    """Largest peak of a sweep: within the actuators' limits and what the loopback's output can put out."""
    player = rig.player
    return min(player.largest_sine_v, player.output_full_scale_v[player.loopback_channel])


def _default_level_v(rig: RigConfig) -> float:
    return min(rig.safe_amplitude_v, largest_level_v(rig))


def _level_v(level_v: float | None, rig: RigConfig) -> float:
    largest_v = largest_level_v(rig)
    if level_v is None:
        return _default_level_v(rig)
    if not MIN_LEVEL_V <= level_v <= largest_v * (1 + 1e-9):
        raise MessageError(
            f"level_v is {level_v:g} V; allowed: {MIN_LEVEL_V:g} V to at most {largest_v:.4g} V, what the "
            "rig file lets an actuator have (player.limit_v, limit_rms_v, limit_power_w)"
        )
    return level_v


class Operation:
    """Carries out orders on an open rig, and publishes what comes of them."""

    def __init__(
        self, rig: RigConfig, setup: Setup, player: BoundedPlayer, light: Sensor | None, publish: Publish
    ) -> None:
        self._rig, self._setup, self._player, self._light, self._publish = rig, setup, player, light, publish
        self._measurements = ManualMeasurements(setup, SAMPLE_RATE_HZ)
        self._spot = MirrorMoved()
        self._every_s: float | None = None
        self._due_s = 0.0
        self._level: float | None = None
        self._light_due_s = 0.0

    def introduce(self) -> None:
        """Publish which rig this is and what it may do.

        Raises InstrumentError: an instrument does not say who it is.
        """
        rig, setup = self._rig, self._setup
        measured = rig.calibration.measured
        ready = Ready(
            name=rig.rig.name, instruments=names_of(setup),
            surface=SurfaceSize(**rig.surface.model_dump()),
            actuator_mm=tuple((x_mm, y_mm) for x_mm, y_mm in rig.actuator_mm.tolist()),
            mapped=measured is not None and measured.mirror is not None, limit_mrad=rig.mirror.limit_mrad,
            level_v=_default_level_v(rig), largest_level_v=largest_level_v(rig), band_hz=SWEEP_BAND_HZ,
            range_v=setup.range_v,
        )  # fmt: skip
        self._publish(ready)

    def due_s(self) -> float | None:
        """Seconds until `look` has something to do; None while it has nothing."""
        return None if self._every_s is None else max(0.0, self._due_s - time.monotonic())

    def look(self) -> None:
        """Publish the level, where it is streamed and the time has come."""
        if self._every_s is None or time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + self._every_s
        self._attempt(lambda: self._publish(level_measured(self._measurements.level(), self._light_now())))

    def carry_out(self, order: RigOrder) -> bool:
        """Carry out an order that `order_of` has checked; what prevents it is published. True where it was done."""
        return self._attempt(lambda: self._act(order))

    def _act(self, order: RigOrder) -> None:
        match order:
            case Jog():
                self._jog(order)
            case Park():
                with naming_role("mirror"):
                    self._setup.mirror.park()
                self._move_spot(self._rig.mirror.park_mrad, parked=True)
            case ShowLevel():
                self._every_s = order.every_s if order.on else None
                self._due_s = 0.0
                if order.on:
                    self._measurements.sound(order.actuator, order.level_v or 0.0)
                self._publish(LevelsSwitched(order.on, order.actuator if order.on else None))
            case TakeSweep():
                self._publish(Sweeping(order.actuator, order.level_v or 0.0))
                self._publish(self._measurements.sweep(order))
            case Mute() | End():
                self._mute()
            case ReportState():
                self._publish(LevelsSwitched(self._every_s is not None))
                self._publish(self._spot)
            case Reconnect():
                with naming_role(order.instrument):
                    getattr(self._setup, order.instrument).reconnect()
                self._publish(Reconnected(order.instrument))

    def _jog(self, order: Jog) -> None:
        if order.x_mm is not None and order.y_mm is not None:
            x_mrad, y_mrad = (float(one) for one in self._setup.mirror_map.angles_mrad(order.x_mm, order.y_mm))
        else:
            assert order.x_mrad is not None
            assert order.y_mrad is not None
            x_mrad, y_mrad = order.x_mrad, order.y_mrad
        limit_mrad = self._rig.mirror.limit_mrad
        if not (abs(x_mrad) <= limit_mrad * (1 + 1e-9) and abs(y_mrad) <= limit_mrad * (1 + 1e-9)):
            raise InputError(
                f"jog: ({x_mrad:.3f}, {y_mrad:.3f}) mrad is beyond mirror.limit_mrad, {limit_mrad:g}: not moved"
            )
        mirror = self._setup.mirror
        with naming_role("mirror"):
            mirror.move_to(x_mrad, y_mrad)
            mirror.wait_settled(SETTLE_S)
        self._move_spot((x_mrad, y_mrad), parked=False)

    def _mute(self) -> None:
        self._every_s = None
        failures = silence(self._setup)
        self._player.open()
        self._publish(LevelsSwitched(False))
        if failures:
            raise failures[0]
        self._publish(Muted())

    def _move_spot(self, at_mrad: tuple[float, float], *, parked: bool) -> None:
        x_mm: float | None = None
        y_mm: float | None = None
        with suppress(InputError):  # a beam that never meets the surface has no place on it
            x_mm, y_mm = (round(float(one), 4) for one in self._setup.mirror_map.surface_mm(*at_mrad))
        self._spot = MirrorMoved(x_mm, y_mm, round(at_mrad[0], 4), round(at_mrad[1], 4), parked)
        self._publish(self._spot)

    def _light_now(self) -> float | None:
        if self._light is not None and time.monotonic() >= self._light_due_s:
            # It is asked by a serial line, which takes longer than a record.
            self._light_due_s = time.monotonic() + 2.0
            try:
                self._level = self._light()
            except InstrumentError:  # it is no instrument of the level; the level goes on without it
                self._level = None
        return self._level

    def _attempt(self, act: Callable[[], object]) -> bool:
        """Publish what prevents an action, so that the next order can be carried out; defects of the program pass."""
        try:
            act()
        except ShutError:
            self._publish(Muted())
        except InputError as wrong:
            self._publish(Refused(str(wrong)))
        except InstrumentError as failure:
            if not isinstance(failure, TransientInstrumentError):
                self._every_s = None
            self._publish(faulted(failure))
        except (ArithmeticError, np.linalg.LinAlgError, MemoryError) as failure:
            self._every_s = None
            self._publish(Refused(f"cannot be computed: {str(failure) or type(failure).__name__}"))
        else:
            return True
        return False


def level_measured(levels: InputLevels, light: float | None = None) -> LevelMeasured:
    """Levels as a message."""
    return LevelMeasured(levels.reference, levels.response, light)


def faulted(failure: InstrumentError) -> Faulted:
    """An instrument's failure as a message."""
    return Faulted(
        instrument=failure.role or failure.instrument.split(" ")[0], device=failure.instrument,
        operation=failure.operation, cause=failure.cause, remedy=failure.remedy,
        passing=isinstance(failure, TransientInstrumentError), sentence=" ".join(str(failure).split()),
    )  # fmt: skip
