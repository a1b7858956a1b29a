"""A shutter, or an interlock's input, on a digital output of an NI device, which may be the recorder's."""

from dataclasses import dataclass

from wavefocus.drivers.protocols import DeviceIdentity, Shutter
from wavefocus.drivers.registry import SHUTTERS, rig_key


@SHUTTERS.register
@dataclass(frozen=True, kw_only=True)
class NiShutterDriver:
    """A digital line that opens the shutter."""

    device: str = rig_key('the name that NI MAX shows, such as "Dev1"', in_plan="free")
    address: str | None = rig_key(
        "HOST:PORT of NI's gRPC Device Server, if the box is behind one", default=None, in_plan="free"
    )
    line: str = rig_key(
        "Digital output that the shutter is wired to", default="port1/line0", in_plan="free",
        pattern=(r"port\d{1,2}/line\d{1,2}", 'must be "port1/line0" and so on'),
    )  # fmt: skip
    opens_when_high: bool = rig_key(
        "Whether a high line opens it; if not, it is open while nothing drives the line",
        default=True, in_plan="free",
    )  # fmt: skip

    name = "nidaqmx"

    def open(self) -> Shutter:
        """Open the device; the shutter is as it was."""
        return _NiShutter(self)


class _NiShutter(Shutter):
    """Blocks the beam by a digital line, also where this program is killed.

    Raises InstrumentLostError or InstrumentError; also where the line does not read as it was set.
    """

    def __init__(self, driver: NiShutterDriver) -> None:
        # Loaded where such a shutter is opened: whoever reads a rig file reads every driver's keys.
        from wavefocus.drivers.daq.ni.ni_process import OutputSettings, ProcessOutputs

        self._opens_when_high = driver.opens_when_high
        self._name = f"shutter ({driver.name} at {driver.device}/{driver.line})"
        settings = OutputSettings(
            "shutter", "line of [shutter]", "digital", driver.device, driver.address, (driver.line,), self._level(False)
        )
        self._line = ProcessOutputs(self._name, settings, f"line {driver.line}")
        self._line.open("opening the line")

    @property
    def identity(self) -> DeviceIdentity:
        return self._line.identity

    def identify(self) -> str:
        return f"{self._name}: {self.identity}"

    def open_beam(self) -> None:
        self._line.write(self._level(True), "opening")

    def block_beam(self) -> None:
        self._line.write(self._level(False), "closing")

    def reconnect(self) -> None:
        """Open the line afresh; the device is not reset, for the recorder may have it, too."""
        self._line.open("opening the line")

    def close(self) -> None:
        self._line.close()

    def _level(self, opens: bool) -> tuple[float]:
        return (float(opens is self._opens_when_high),)
