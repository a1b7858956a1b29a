"""From a rig's configuration to its instruments: which driver opens each."""

import atexit
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

from wavefocus.acquisition.setup import Openers
from wavefocus.config.rig import RigConfig
from wavefocus.config.rig_instruments import DriverTable, ShutterSection, VibrometerSection
from wavefocus.config.run import Virtual
from wavefocus.drivers.daq.nidaqmx import NiDaqmx
from wavefocus.drivers.errors import InstrumentError, MissingPackageError
from wavefocus.drivers.mirror.analog import AnalogMirrorDriver
from wavefocus.drivers.protocols import Clock, Mirror, Player, Recorder, Shutter, WallClock
from wavefocus.drivers.registry import (
    MirrorSettings,
    Outputs,
    VibrometerReading,
)
from wavefocus.drivers.shutter import ShutteredMirror
from wavefocus.drivers.shutter.nidaqmx import NiShutterDriver
from wavefocus.storage.errors import BankBusyError
from wavefocus.storage.ledger.owner import claimed

# A decoder's range is a round number; what differs by more is another range.
SAME_SENSITIVITY = 1e-3


def openers_of(rig: RigConfig, virtual: Virtual | None = None, *, realtime: bool = False, outputs: int = 0) -> Openers:
    """Find the driver of each instrument; nothing is opened yet.

    realtime: A virtual rig's seconds last as long as the wall's; by default they take no time.
    outputs: Outputs of the player to open, where more are needed than the rig file wires.
    """
    if rig.is_virtual:
        from wavefocus.rig.virtual_bench import virtual_rig  # a real rig needs none of what stands in for one

        bench = virtual_rig(rig, virtual, realtime=realtime, outputs=outputs)
        return Openers(
            rig, bench.clock, lambda: _with_shutter(rig, bench.mirror, bench.clock), lambda: bench.recorder,
            lambda: bench.player, lambda: _vibrometer(rig), bench.patch_bay.connect, bench.sensors,
        )  # fmt: skip
    clock, watched = WallClock(), WatchedVibrometer(rig.vibrometer)
    sensors = {} if rig.vibrometer.port is None else {"light": watched.light, "range": watched.sensitivity}
    return Openers(
        rig, clock, lambda: _with_shutter(rig, _mirror(rig, clock), clock), lambda: _recorder(rig),
        lambda: _player(rig, outputs), lambda: _vibrometer(rig), sensors=sensors,
    )  # fmt: skip


def _mirror(rig: RigConfig, clock: Clock) -> Mirror:
    mirror = rig.mirror
    driver = mirror.make_driver()
    with _reporting_missing_packages("mirror", mirror.driver):
        settings = MirrorSettings(
            port=mirror.port or "", baud=mirror.baud, identity=mirror.identity, settle_s=mirror.settle_s,
            limit_mrad=mirror.limit_mrad, park_mrad=mirror.park_mrad, clock=clock,
        )  # fmt: skip
        opened: Mirror = _of_role(driver.open(settings), Mirror)
        return opened


def _with_shutter(rig: RigConfig, mirror: Mirror, clock: Clock) -> Mirror:
    """The mirror behind the rig's shutter, which is closed; the mirror itself where there is none."""
    if rig.shutter is None:
        return mirror
    try:
        return ShutteredMirror(mirror, open_shutter(rig.shutter), rig.shutter.opens_s, clock)
    except BaseException:
        mirror.close()
        raise


def open_shutter(section: ShutterSection) -> Shutter:
    """Open a rig's shutter alone; it stays as it is. Raises InstrumentError."""
    if section.driver == "virtual":
        from wavefocus.mocks.virtual.mirror import VirtualShutter  # a real rig needs none of it

        return VirtualShutter()
    with _reporting_missing_packages("shutter", section.driver):
        shutter: Shutter = section.make_driver().open()
        return shutter


def _recorder(rig: RigConfig) -> Recorder:
    driver = rig.recorder.make_driver()
    with _reporting_missing_packages("recorder", rig.recorder.driver):
        if isinstance(driver, NiDaqmx):
            name = _task_name(driver.device, driver.address)
            return driver.open(shared=_outputs_in_use(rig), task_name=name)
        opened: Recorder = _of_role(driver.open(), Recorder)
        return opened


# Names that this process holds until it ends.
_held_names = ExitStack()
atexit.register(_held_names.close)


@cache
def _task_name(device: str, address: str | None) -> str:
    """A name for the tasks on a server that no other living process of this computer uses; empty where one does."""
    if address is None:
        return ""
    try:
        _held_names.enter_context(claimed(f"tasks of {device} at {address}"))
    except (BankBusyError, OSError):
        return ""
    return re.sub(r"\W", "_", f"wavefocus_{socket.gethostname()}_{device}")


def _outputs_in_use(rig: RigConfig) -> bool:
    """Whether another instrument of the rig uses outputs of the recorder's box: a reset would put them to 0 V."""
    box = (rig.recorder.device, rig.recorder.address)
    used: list[DriverTable] = [rig.mirror] if rig.mirror.driver == AnalogMirrorDriver.name else []
    used += [rig.shutter] if rig.shutter is not None and rig.shutter.driver == NiShutterDriver.name else []
    return any((section.device, section.address) == box for section in used)


def _player(rig: RigConfig, outputs: int) -> Player:
    driver = rig.player.make_driver()
    wired_v = rig.player.output_full_scale_v
    further_v = (rig.player.full_scale_v,) * (outputs - len(wired_v))
    with _reporting_missing_packages("player", rig.player.driver):
        opened: Player = _of_role(driver.open(Outputs(wired_v + further_v, rig.player.interface_rate_hz)), Player)
        return opened


def _of_role(opened: Any, role: type[Any]) -> Any:
    """What a driver opened. Raises InstrumentError: another distribution's is not derived from its role."""
    if not isinstance(opened, role):
        name = role.__name__
        cause, remedy = f"what its driver opened is no {name}", f"derive it from {name} of wavefocus.drivers.protocols"
        raise InstrumentError(name.lower(), "opening", cause, remedy)
    return opened


@contextmanager
def _reporting_missing_packages(role: str, driver: str) -> Iterator[None]:
    """Report a package that a driver imports and that is not installed, as a fault of that instrument.

    Raises MissingPackageError. InstrumentError: the driver would end this program.
    """
    try:
        yield
    except ImportError as missing:
        package = (missing.name or "").partition(".")[0]
        if package == "wavefocus":
            raise
        cause = f"the Python package {package or 'of its maker'} cannot be imported ({missing})"
        remedy = "install it in the environment of wavefocus, as the driver's documentation says"
        raise MissingPackageError(f"{role} ({driver})", "opening", cause, remedy) from missing
    except SystemExit as ended:  # another distribution's driver, or its maker's library
        cause, remedy = f"its driver ended with {ended.code!r}", "ask its maker; a driver raises InstrumentError"
        raise InstrumentError(f"{role} ({driver})", "opening", cause, remedy) from ended


def read_vibrometer(section: VibrometerSection, *, any_level: bool = False) -> VibrometerReading:
    """Ask a vibrometer's controller for its settings; a signal too weak is an error unless any level will do."""
    with _reporting_missing_packages("vibrometer", section.driver):
        reading: VibrometerReading = section.make_driver().read(
            section.port or "", baud=section.baud, identity=section.identity, any_level=any_level
        )
        return reading


class WatchedVibrometer:
    """Signal level and sensitivity of a Polytec controller; where both are watched, from the same answers."""

    def __init__(self, section: VibrometerSection) -> None:
        self._section = section
        self._reading: VibrometerReading | None = None

    def light(self) -> float:
        """Share of full signal level, 0 to 1."""
        self._reading = None
        self._reading = reading = read_vibrometer(self._section, any_level=True)
        if reading.signal_level is None:
            raise InstrumentError(
                reading.identity, "asking the signal level", "it has none", "leave watch.light out of the rig file"
            )
        return reading.signal_level

    def sensitivity(self) -> float:
        """Metres per second per volt that it is set to."""
        reading, self._reading = self._reading, None
        return (reading or read_vibrometer(self._section, any_level=True)).sensitivity_m_s_per_v


def _vibrometer(rig: RigConfig) -> VibrometerReading:
    """The vibrometer's reading with the rig file's latency; two sensitivities are held against each other."""
    vibrometer = rig.vibrometer
    configured = vibrometer.sensitivity_m_s_per_v
    if vibrometer.port is None:
        name = "vibrometer, its sensitivity typed in"
        return VibrometerReading(configured or 0.0, "", vibrometer.latency_s, None, name)
    reading = read_vibrometer(vibrometer)
    if configured is not None and abs(reading.sensitivity_m_s_per_v / configured - 1) > SAME_SENSITIVITY:
        raise InstrumentError(
            f"vibrometer ({vibrometer.driver} at {vibrometer.port})",
            "reading its sensitivity",
            f"it is set to {reading.range_text}, the rig file says {configured:g} m/s per V",
            "set the range that the campaign needs, or correct vibrometer.sensitivity_m_s_per_v",
        )
    latency_s = reading.latency_s if vibrometer.latency_s is None else vibrometer.latency_s
    return replace(reading, latency_s=latency_s, identity=f"{reading.identity}, {reading.range_text}")
