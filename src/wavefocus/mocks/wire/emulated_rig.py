"""The emulated instruments of a whole rig before one plate and one clock: what real drivers find without hardware.

Galvanometers follow two analog outputs of the emulated NI box.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavefocus.config.rig import RigConfig
from wavefocus.drivers.protocols import Float32Array, Float64Array
from wavefocus.mocks.virtual import NANOSECONDS, PatchBay
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.mocks.virtual.synthesis import TAIL_S, SignalStore, Synthesis, VirtualPlay
from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire, SerialDevice, TcpWire, Wire
from wavefocus.mocks.wire.jack_server import JackServer, PlayedAudio
from wavefocus.mocks.wire.mirrors import mirror_device
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.mocks.wire.vibrometer import vibrometer_device


def analog_scanner(
    motion: MirrorMotion, outputs: tuple[str, str], volts_per_degree: float = 0.8
) -> Callable[[Mapping[str, float]], None]:
    """A pair of galvanometers, called with the levels of the box's outputs; the beam turns by twice the mirror's angle.

    motion: How the mirror moves.
    outputs: Names of the outputs of x and y.
    volts_per_degree: What its jumper is set to, which need not be what the rig file says.
    """
    mrad_per_v = 2 * 1000 * math.radians(1) / volts_per_degree

    def follow(levels: Mapping[str, float]) -> None:
        x_v, y_v = (levels.get(name, 0.0) for name in outputs)
        motion.start(x_v * mrad_per_v, y_v * mrad_per_v)

    return follow


# What a converter cannot put out is silence: -160 dB of full scale.
_SILENCE = 1e-8


class WireBench:
    """The analog world between the instruments: amplifiers, plate, vibrometer and the loopback cable.

    settings: The rig; its player's latency and clock do not count, the audio server's do, but for the difference
        `clock_ppm` between the two clocks, which is made here.
    played: What the emulated player has put out.
    aimed: Where the emulated mirror has looked.
    full_scale_v: Volts that each output is believed to put out at full scale; what it does put out is this times its
        gain in `settings`.
    reference_input, response_input: Physical inputs that the loopback and the patch bay are wired to.

    patch_bay: What is plugged into the response input; the vibrometer, until somebody plugs in something else.
    onsets: Of the latest records, oldest first: the sample, on the recorder's clock, at which the first sound that
        began within the record began at the loopback output; NaN for a silent record. The truth that drivers and
        estimator are held against.
    """

    def __init__(
        self,
        settings: VirtualSettings,
        played: PlayedAudio,
        aimed: MirrorMotion,
        *,
        full_scale_v: tuple[float, ...],
        reference_input: str = "ai0",
        response_input: str = "ai1",
    ) -> None:
        self._settings = settings
        self._played = played
        self._aimed = aimed
        self._full_scale_v = full_scale_v
        self._inputs = (reference_input, response_input)
        self.patch_bay = PatchBay(settings.channel_of_actuator, settings.channel_of_loopback)
        self.onsets: deque[float] = deque(maxlen=1000)
        # What the vibrometer puts out over what it would in the range of `settings`.
        self.output_scale: Callable[[], float] = lambda: 1.0
        self._store = SignalStore(max(full_scale_v))
        # The plate is made, and refused, before anything is played.
        self._synthesis = {settings.inter_channel_delay_s: Synthesis(settings)}
        self._generator = np.random.default_rng(settings.seed)
        self._lock = threading.Lock()

    def record(
        self, start_ns: int, samples: int, rate_hz: float, inputs: tuple[str, ...], channel_delay_s: float
    ) -> Float64Array:
        """Voltages at some inputs, noise included, once they have been.

        start_ns: Instant of the first sample, of `time.monotonic_ns`.
        rate_hz: Their nominal rate in Hz; the recorder's clock is `clock_ppm` faster.
        inputs: Physical inputs in the order of the task.
        channel_delay_s: How much later each input is sampled than the one before.

        Returns float64 (inputs, samples): in volts, before the converter.
        """
        true_rate_hz = rate_hz * self._settings.clock_ratio
        end_ns = start_ns + round(samples / true_rate_hz * NANOSECONDS)
        plays = self._plays(start_ns, end_ns)
        begun_ns = [play.requested_ns - start_ns for play in plays if play.requested_ns >= start_ns]
        self.onsets.append(min(begun_ns, default=np.nan) / NANOSECONDS * true_rate_hz)
        patched = self.patch_bay.outputs
        with self._lock:
            # Which input is converted first decides which of the two is late.
            order = [inputs.index(name) if name in inputs else 0 for name in self._inputs]
            synthesis = self._with_delay((order[1] - order[0]) * channel_delay_s)
            spots = synthesis.spots(self._aimed.aims(start_ns, end_ns), start_ns, samples, true_rate_hz)
            reference_v, response_v = synthesis.voltages(samples, rate_hz, start_ns, plays, spots, patched)
            for spot in spots:
                if spot.place_mm is None and patched is None:
                    lost_v = self._settings.lost_signal_v * self._generator.standard_normal(spot.stop - spot.first)
                    response_v[spot.first : spot.stop] = lost_v
            synthesis.add_crosstalk(response_v, rate_hz, start_ns, plays)
            noise_v = self._generator.standard_normal((len(inputs), samples))
        if patched is None:
            response_v = response_v * self.output_scale()
        volts = noise_v * self._settings.reference_noise_v
        for row, name in enumerate(inputs):
            if name == self._inputs[0]:
                volts[row] += reference_v
            elif name == self._inputs[1]:
                heard_v = self._settings.noise_v if patched is None else self._settings.reference_noise_v
                volts[row] = noise_v[row] * heard_v + response_v
        return np.asarray(volts)

    def spot_mm(self) -> tuple[float, float] | None:
        """Where the laser meets the surface now; None while it moves or misses it."""
        now_ns = time.monotonic_ns()
        aims = self._aimed.aims(now_ns, now_ns + 1)
        with self._lock:
            (synthesis,) = self._synthesis.values()
        return synthesis.place_mm(aims[-1][1])

    def _plays(self, start_ns: int, end_ns: int) -> list[VirtualPlay]:
        """What sounded in a record or rings on into it, as one play for each stretch between silences."""
        rate_hz = self._played.rate_hz
        zero = self._played.frame_at(start_ns)
        first = int(np.floor(zero - TAIL_S * rate_hz))
        stop = int(np.ceil(zero + (end_ns - start_ns) / NANOSECONDS * rate_hz)) + 1
        frames = self._played.read(first, stop)
        sounding = np.flatnonzero((np.abs(frames) > _SILENCE).any(axis=0))
        if not sounding.size:
            return []
        # Silence on all channels that parts one sound from the next; sweeps of one record become one sound each, which
        # the store of signals then recognises.
        breaks = np.flatnonzero(np.diff(sounding) > 0.01 * rate_hz)
        firsts = sounding[np.concatenate([[0], breaks + 1])]
        lasts = sounding[np.concatenate([breaks, [-1]])]
        return [
            self._play(frames[:, begin : last + 1], (first + begin - zero) / rate_hz, start_ns)
            for begin, last in zip(firsts.tolist(), lasts.tolist(), strict=True)
        ]

    def _play(self, frames: Float32Array, begins_s: float, start_ns: int) -> VirtualPlay:
        signals = {
            channel: self._store.find(volts.astype(np.float64) * self._full_scale_v[channel])
            for channel, volts in enumerate(frames[: len(self._full_scale_v)])
            if (np.abs(volts) > _SILENCE).any()
        }
        begins_ns = round(begins_s * NANOSECONDS)
        rest_s = begins_s - begins_ns / NANOSECONDS
        return VirtualPlay(start_ns + begins_ns, float(self._played.rate_hz), signals, frames.shape[1], rest_s)

    def _with_delay(self, delay_s: float) -> Synthesis:
        """The signal chain with this delay of the response input; a task that is asked again finds it made."""
        if delay_s not in self._synthesis:
            self._synthesis = {delay_s: Synthesis(replace(self._settings, inter_channel_delay_s=delay_s))}
        return self._synthesis[delay_s]


_SOCKET = "socket://"


class EmulatedRig(ExitStack):
    """Mirror, vibrometer, DAQ and audio interface on their wires, before one plate; a context, or close it.

    Raises ValueError or RuntimeError.

    settings: Plate, noise, clocks, geometry and flaws.
    rig: Its drivers find their instruments where it says; its recorder has an address.

    bench: The analog world, with the patch bay.
    audio: The audio interface; `audio.environment` is what a player's process must have.
    """

    def __init__(self, settings: VirtualSettings, rig: RigConfig) -> None:
        super().__init__()
        if rig.vibrometer.driver == "polytec-ofv5000" and not settings.vibrometer_latency_s:
            # What a velocity decoder of the emulated controller makes the response late by, where the rig does not say
            # it.
            settings = replace(settings, vibrometer_latency_s=8.16e-6)
        try:
            self._start(settings, rig)
        except BaseException:
            self.close()
            raise

    def _start(self, settings: VirtualSettings, rig: RigConfig) -> None:
        mirror, recorder, vibrometer = rig.mirror, rig.recorder, rig.vibrometer
        full_scale_v, faults = rig.player.output_full_scale_v, rig.emulation.fault_plan
        motion = MirrorMotion(settings.park_mrad, settings.settle_s, settings.slew_mrad_s, settings.limit_mrad)
        self.audio = self.enter_context(
            JackServer(
                period_frames=rig.emulation.period_frames,
                channels=max(24, len(full_scale_v)),
                rate_hz=rig.player.interface_rate_hz,
                faults=faults,
            )
        )
        self.bench = WireBench(
            settings,
            self.audio.played,
            motion,
            full_scale_v=full_scale_v,
            reference_input=recorder.reference_input,
            response_input=recorder.response_input,
        )
        self.recorder = NiServer(self.bench, rig.emulation.ni_product, recorder.device, recorder.address, faults)
        self.recorder.start()
        self.callback(self.recorder.stop)
        self._plugs: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {
            "recorder": (self.recorder.box.unplug, self.recorder.box.plug),
            "player": (self.audio.kill, self.audio.restart),
        }
        self.mirror: EmulatedSerial | None = None
        if mirror.driver == "analog":
            self.recorder.box.output_changed = analog_scanner(
                motion, (mirror.x_output, mirror.y_output), mirror.volts_per_degree
            )
        else:
            device = mirror_device(mirror.driver, motion, mirror.full_scale_mrad)
            self.mirror = self._serial("mirror", device, mirror.port or "", rig)
            self._plugs["mirror"] = (self.mirror.unplug, self.mirror.plug)
        if vibrometer.port is not None:
            controller = vibrometer_device(
                vibrometer.driver, settings.sensitivity_m_s_per_v, settings.vibrometer_latency_s
            )
            nominal = controller.sensitivity_m_s_per_v
            self.bench.output_scale = lambda: nominal / controller.sensitivity_m_s_per_v
            side = self._serial("vibrometer", controller, vibrometer.port, rig)
            self._plugs["vibrometer"] = (side.unplug, side.plug)

    def unplug(self, role: str) -> None:
        """Pull the cable of one instrument. Raises ValueError.

        role: ``"mirror"``, ``"recorder"``, ``"player"`` or ``"vibrometer"``.
        """
        self._plug_of(role)[0]()

    def plug(self, role: str) -> None:
        """Put it back; arguments and errors: see `unplug`."""
        self._plug_of(role)[1]()

    def _plug_of(self, role: str) -> tuple[Callable[[], None], Callable[[], None]]:
        if role not in self._plugs:
            raise ValueError(f"there is no {role!r} here; there is: {', '.join(self._plugs)}")
        return self._plugs[role]

    def _serial(self, role: str, device: SerialDevice, port: str, rig: RigConfig) -> EmulatedSerial:
        plan = WireFaultPlan(role, rig.emulation.fault_plan)
        return self.enter_context(EmulatedSerial(device, _wire(role, port), plan))


def _wire(role: str, port: str) -> Wire:
    """The wire at an address: a TCP port, or a pseudo-terminal behind a link of that path."""
    if not port.startswith(_SOCKET):
        return PtyWire(Path(port))
    host, _, number = port.removeprefix(_SOCKET).rpartition(":")
    try:
        return TcpWire(host, int(number))
    except OSError as refused:
        raise ValueError(f"{role}.port = {port}: nothing can listen there: {refused.strerror}") from None
