"""The far sides of a whole rig, coupled: what real drivers find at their ports when there is no hardware."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType

from mocks.virtual.settings import VirtualSettings
from mocks.wire.audio.jack_server import JackServer
from mocks.wire.bench import WireBench
from mocks.wire.faults import WireFault, WireFaultPlan
from mocks.wire.mirrors import mirror_device
from mocks.wire.mirrors.motion import MirrorMotion
from mocks.wire.ni.ni_server import NiServer
from mocks.wire.serial_far_side import SerialFarSide
from mocks.wire.serial_wires import PtyWire, TcpWire, Wire
from mocks.wire.vibrometer import PolytecDevice

SOCKET = "socket://"
# What a velocity decoder of the emulated controller makes the response late by, where the rig does not say it.
DECODER_LATENCY_S = 8.16e-6


@dataclass(frozen=True, slots=True)
class Wiring:
    """What stands at the far end of each wire, and where it is reached.

    mirror_dialect: A dialect of `drivers.mirror.serial_mirror`.
    mirror_port: Path of a link to make, or ``socket://HOST:PORT`` (port 0: any).
    mirror_full_scale_mrad: Optical angle at full deflection, as of `mirror_device`.
    ni_product, ni_device, ni_address: Model of the NI box, its name, and HOST:PORT of its gRPC Device Server.
    reference_input, response_input: Inputs that the loopback and the patch bay are wired to.
    full_scale_v: Volts at full scale that each output of the audio interface is believed to have.
    interface_rate_hz, period_frames: Of the audio interface.
    vibrometer_port: Where a Polytec OFV-5000 is reached, as `mirror_port`; none, if absent.
    """

    mirror_dialect: str
    mirror_port: str
    ni_product: str
    ni_device: str
    ni_address: str
    full_scale_v: tuple[float, ...]
    mirror_full_scale_mrad: float | None = None
    reference_input: str = "ai0"
    response_input: str = "ai1"
    interface_rate_hz: int = 48_000
    period_frames: int = 4096
    vibrometer_port: str | None = None


class EmulatedRig:
    """Mirror, vibrometer, DAQ and audio interface on their wires, before one plate; a context, or close it.

    Raises ValueError or RuntimeError.

    settings: Plate, noise, clocks, geometry and flaws.

    bench: The analog world, with the patch bay.
    audio: The audio interface; `audio.environment` is what a player's process must have.
    vibrometer: The vibrometer's controller, where it has a port.
    """

    def __init__(self, settings: VirtualSettings, wiring: Wiring, faults: tuple[WireFault, ...] = ()) -> None:
        if wiring.vibrometer_port is not None and not settings.vibrometer_latency_s:
            settings = replace(settings, vibrometer_latency_s=DECODER_LATENCY_S)
        motion = MirrorMotion(settings.park_mrad, settings.settle_s, settings.slew_mrad_s, settings.limit_mrad)
        self.vibrometer: SerialFarSide | None = None
        with ExitStack() as started:
            self.audio = started.enter_context(
                JackServer(
                    period_frames=wiring.period_frames,
                    channels=max(24, len(wiring.full_scale_v)),
                    rate_hz=wiring.interface_rate_hz,
                    faults=faults,
                )
            )
            self.bench = WireBench(
                settings,
                self.audio.played,
                motion,
                full_scale_v=wiring.full_scale_v,
                reference_input=wiring.reference_input,
                response_input=wiring.response_input,
            )
            self.recorder = NiServer(self.bench, wiring.ni_product, wiring.ni_device, wiring.ni_address, faults)
            self.recorder.start()
            started.callback(self.recorder.stop)
            device = mirror_device(wiring.mirror_dialect, motion, wiring.mirror_full_scale_mrad)
            self.mirror = started.enter_context(
                SerialFarSide(device, _wire("mirror", wiring.mirror_port), WireFaultPlan("mirror", faults))
            )
            if wiring.vibrometer_port is not None:
                polytec = PolytecDevice(
                    f"{1000 * settings.sensitivity_m_s_per_v:g}mm/s/V",
                    signal_delay=f"{1e6 * settings.vibrometer_latency_s:g} us",
                )
                wire, plan = _wire("vibrometer", wiring.vibrometer_port), WireFaultPlan("vibrometer", faults)
                self.vibrometer = started.enter_context(SerialFarSide(polytec, wire, plan))
            self._started = started.pop_all()

    def __enter__(self) -> EmulatedRig:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End every far side; twice does no harm."""
        self._started.close()

    def unplug(self, role: str) -> None:
        """Pull the cable of one instrument. Raises ValueError.

        role: ``"mirror"``, ``"recorder"``, ``"player"`` or ``"vibrometer"``.
        """
        match role:
            case "player":
                self.audio.kill()
            case "recorder":
                self.recorder.unplug()
            case _:
                self._serial(role).unplug()

    def plug(self, role: str) -> None:
        """Put it back; arguments and errors as of `unplug`."""
        match role:
            case "player":
                self.audio.restart()
            case "recorder":
                self.recorder.plug()
            case _:
                self._serial(role).plug()

    def _serial(self, role: str) -> SerialFarSide:
        sides = {"mirror": self.mirror, "vibrometer": self.vibrometer}
        side = sides.get(role)
        if side is None:
            there = [name for name in ("mirror", "recorder", "player", "vibrometer") if sides.get(name, self)]
            raise ValueError(f"there is no {role!r} here; there is: {', '.join(there)}")
        return side


def _wire(role: str, port: str) -> Wire:
    """The wire at an address: a TCP port, or a pseudo-terminal behind a link of that path."""
    if not port.startswith(SOCKET):
        return PtyWire(Path(port))
    host, _, number = port.removeprefix(SOCKET).rpartition(":")
    try:
        return TcpWire(host, int(number))
    except OSError as refused:
        raise ValueError(f"{role}.port = {port}: nothing can listen there: {refused.strerror}") from None
