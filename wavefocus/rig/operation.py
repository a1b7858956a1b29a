"""A rig operated by hand: orders carried out one after the other, what comes of them told as events."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np

from acquisition.manual.level import GatedPlayer, LevelMeter, ShutError
from acquisition.manual.single_sweep import SingleSweeps, SweepOrder, SweepResult
from acquisition.measuring.setup import Setup, asking, instrument_of, names_of, silence
from acquisition.quality.watch import Sensor
from config.rig import RigConfig
from drivers.errors import InstrumentError, TransientInstrumentError
from storage.errors import InputError
from wavefocus.rig.limits import safe_amplitude_v
from wavefocus.rig.operation_orders import (
    BAND_HZ,
    SAMPLE_RATE_HZ,
    End,
    Jog,
    Mute,
    Order,
    Park,
    Reconnect,
    ShowLevel,
    TellState,
    largest_level_v,
)

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
