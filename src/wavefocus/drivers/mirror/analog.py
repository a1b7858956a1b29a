"""Galvanometer mirrors that follow a voltage, on two analog outputs of an NI device.

Thorlabs GVS, Cambridge Technology, ScannerMAX; ASI and Optotune in their analogue mode. What a GVS takes (manual
GVS201): ±10 V, 0.5, 0.8 or 1.0 V per mechanical degree by jumper, a step of 0.2 degrees in 0.4 ms. The beam turns by
twice the mirror's angle.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, Mirror
from wavefocus.drivers.registry import MIRRORS, KeyMistakeError, MirrorSettings, rig_key

_ANALOG_OUTPUT = (r"ao\d{1,2}", 'must be "ao0", "ao1" and so on')


@MIRRORS.register
@dataclass(frozen=True, kw_only=True)
class AnalogMirrorDriver:
    """A mirror on two analog outputs of an NI device, which may be the recorder's."""

    device: str = rig_key('the name that NI MAX shows, such as "Dev1"', in_plan="free")
    address: str | None = rig_key(
        "HOST:PORT of NI's gRPC Device Server, if the box is behind one", default=None, in_plan="free"
    )
    x_output: str = rig_key(
        "Analog output of the mirror that moves the beam in x", default="ao0", in_plan="free",
        pattern=_ANALOG_OUTPUT,
    )  # fmt: skip
    y_output: str = rig_key(
        "Analog output of the mirror that moves the beam in y", default="ao1", in_plan="free",
        pattern=_ANALOG_OUTPUT,
    )  # fmt: skip
    volts_per_degree: float = rig_key(
        "Volts per degree of the mirror, of which the beam turns by two; by its jumper",
        default=0.8, in_plan="free", gt=0, le=100,
    )  # fmt: skip
    limit_v: float = rig_key("Largest voltage", default=9.5, in_plan="free", gt=0, le=10)
    slew_v_per_s: float = rig_key("Fastest change of a voltage, in V/s", default=500.0, in_plan="free", gt=0, le=1e6)

    name = "analog"
    without_keys = ("port", "baud", "identity")
    table_defaults: ClassVar[Mapping[str, object]] = {}

    def __post_init__(self) -> None:
        if self.x_output == self.y_output:
            raise KeyMistakeError("y_output", self.y_output, "is already the x_output")

    def open(self, settings: MirrorSettings) -> Mirror:
        """Open the outputs; the mirror does not move yet."""
        return _AnalogMirror(self, settings)


class _AnalogMirror(Mirror):
    """Points the laser by two voltages.

    It is left at the voltages of `park_mrad`, also where this program is killed; the outputs keep them as long as the
    device has power.

    Raises InstrumentLostError or InstrumentError.
    """

    def __init__(self, driver: AnalogMirrorDriver, settings: MirrorSettings) -> None:
        self._driver, self._settings, self._clock = driver, settings, settings.clock
        self._name = f"mirror ({driver.name} at {driver.device})"
        self._settled_s: float | None = None
        for angles in ((settings.limit_mrad, settings.limit_mrad), settings.park_mrad):
            self._volts_at(*angles, "preparing")
        # Loaded where such a mirror is opened: whoever reads a rig file reads every driver's keys.
        from wavefocus.drivers.daq.ni.ni_process import OutputSettings, ProcessOutputs

        names = (driver.x_output, driver.y_output)
        outputs = OutputSettings(
            "mirror",
            "x_output and y_output of [mirror]",
            "analog",
            driver.device,
            driver.address,
            names,
            self._volts_at(*settings.park_mrad, "parking"),
            driver.limit_v,
            driver.slew_v_per_s,
        )
        # 0 V of a device that was just switched on; else the level is unknown.
        self._outputs = ProcessOutputs(self._name, outputs, f"outputs {' and '.join(names)}", (0.0, 0.0))
        self._open("opening")

    @property
    def identity(self) -> DeviceIdentity:
        return self._outputs.identity

    def identify(self) -> str:
        self._outputs.identify()
        driver = self._driver
        return (
            f"{self._name}: {self.identity}, {driver.x_output} and {driver.y_output} at {driver.volts_per_degree:g} V "
            f"per degree, within ±{self._settings.limit_mrad:g} mrad"
        )

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._outputs.require_open(doing)
        limit = self._settings.limit_mrad
        if not (abs(x_mrad) <= limit and abs(y_mrad) <= limit):
            cause = f"({x_mrad:g}, {y_mrad:g}) mrad is beyond the limit of ±{limit:g} mrad"
            raise InstrumentError(self._name, doing, cause, "choose a grid within the mirror's reach")
        self._go(self._volts_at(x_mrad, y_mrad, doing), doing)

    def wait_settled(self, timeout_s: float) -> None:
        self._outputs.require_open("settling")
        if self._settled_s is None:
            cause = "it has been sent nowhere since it was opened, or its last move failed"
            raise TransientInstrumentError(self._name, "settling", cause, "send it there again")
        left_s = self._settled_s - self._clock.now_s()
        if left_s > timeout_s:
            remedy = "allow more time to settle"
            raise TransientInstrumentError(self._name, "settling", f"still moving after {timeout_s:g} s", remedy)
        if left_s > 0:
            self._clock.sleep(left_s)

    def park(self) -> None:
        """Move to the safe direction; a lost device is given one more chance. Does nothing once closed."""
        if self._outputs.closed:
            return
        volts = self._volts_at(*self._settings.park_mrad, "parking")
        try:
            self._go(volts, "parking")
        except InstrumentLostError:
            self._open("parking")
            self._go(volts, "parking")

    def reconnect(self) -> None:
        """Open the outputs of the same device afresh; the device is not reset, for the recorder may have it, too."""
        self._open("reconnecting")

    def close(self) -> None:
        """Park, and release the outputs; twice does no harm."""
        try:
            with suppress(InstrumentLostError):  # its outputs fall to 0 V with its power
                self.park()
        finally:
            self._outputs.close()

    # -- inside --------------------------------------------------------------------------------------

    def _open(self, doing: str) -> None:
        self._settled_s = None
        self._outputs.open(doing)

    def _go(self, volts: Sequence[float], doing: str) -> None:
        self._settled_s = None
        self._outputs.write(volts, doing)
        self._settled_s = self._clock.now_s() + self._settings.settle_s

    def _volts_at(self, x_mrad: float, y_mrad: float, doing: str) -> tuple[float, float]:
        """Voltages for a direction of the beam. Raises InstrumentError: one is beyond the limit."""
        per_mrad = math.degrees(1e-3) / 2 * self._driver.volts_per_degree
        volts = (x_mrad * per_mrad, y_mrad * per_mrad)
        if max(map(abs, volts)) > self._driver.limit_v:
            most_mrad = self._driver.limit_v / per_mrad
            cause = f"({x_mrad:g}, {y_mrad:g}) mrad needs more than limit_v = {self._driver.limit_v:g} V"
            remedy = f"lower limit_mrad and park_mrad of [mirror] to {math.floor(10 * most_mrad) / 10:g} or less"
            raise InstrumentError(self._name, doing, cause, remedy)
        return volts
