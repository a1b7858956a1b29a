"""One bench per kind of rig; every suite in this folder runs on each of them unchanged.

The virtual rig, the production drivers on emulated wires, and with ``--hardware RIG.toml`` a real rig alone.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import pytest

from tests.threads import threads_end
from tests.wire.analog_bench import analog_rig
from tests.wire.daq_bench import Tone
from tests.wire.emulated import free_port, rig_text
from tests.wire.serial_bench import DIALECTS, LOCAL
from tests.wire.serial_bench import wire as serial_wire
from wavefocus.commands.emulate import wiring_of
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_rig import EmulatedRig
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.mirrors import mirror_device
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.virtual_bench import virtual_settings

Taken = TypeVar("Taken")

# Short enough that what is played starts soon after it was asked for, and long enough to go on on a busy machine.
PERIOD_FRAMES = 4096


class OpenedWhenUsed:
    """The instruments of a rig, each opened when a test first names it: a mirror's test needs no audio server."""

    def __init__(self, openers):
        self._openers = openers

    @property
    def clock(self):
        return self._openers.clock

    @cached_property
    def mirror(self):
        return self._openers.mirror()

    @cached_property
    def recorder(self):
        return self._openers.recorder()

    @cached_property
    def player(self):
        return self._openers.player()

    def rest(self):
        """Leave nothing under way for the next test, and open anew what this one has closed."""
        for role, stop in (("player", "mute"), ("recorder", "abort"), ("mirror", "park")):
            if role in self.__dict__:
                getattr(getattr(self, role), stop)()
                try:
                    getattr(self, role).identify()
                except InstrumentError:
                    del self.__dict__[role]

    def close(self):
        for role in ("player", "recorder", "mirror"):
            if role in self.__dict__:
                getattr(self, role).close()


@dataclass(frozen=True)
class Bench:
    """A rig and what a person knows about it."""

    instruments: OpenedWhenUsed
    reachable_mrad: tuple[float, float]
    unreachable_mrad: tuple[float, float]
    settle_timeout_s: float
    loopback_channel: int
    actuator_channel: int
    sample_rate_hz: float
    range_v: tuple[float, float]
    unknown_range_v: tuple[float, float]
    latency_s: float
    """Longest time from asking for a sound to its first sample, or from muting to silence."""

    def undisturbed(self, take):
        """Do something again, as an attempt is taken again, until no passing fault of a busy machine disturbs it."""
        for _ in range(20):
            try:
                return take()
            except TransientInstrumentError:
                self.instruments.recorder.abort()
                self.instruments.player.mute()
        return take()


def bench_of(rig, latency_s):
    limit_mrad = rig.mirror.limit_mrad
    return Bench(
        instruments=OpenedWhenUsed(openers_of(rig)),
        reachable_mrad=(min(40.0, limit_mrad / 4), -min(25.0, limit_mrad / 6)),
        unreachable_mrad=(2000.0, 0.0),
        settle_timeout_s=max(1.0, 10 * rig.mirror.settle_s),
        loopback_channel=rig.player.loopback_channel,
        actuator_channel=rig.player.channels[0],
        sample_rate_hz=10_000.0,
        range_v=(2.0, 10.0) if rig.is_virtual else (5.0, 10.0),
        unknown_range_v=(2.0, 1000.0),
        latency_s=latency_s,
    )


@pytest.fixture(scope="package", autouse=True)
def nothing_is_left_open():
    """Tests that leave an instrument open fail."""
    yield from threads_end()


@pytest.fixture(scope="package")
def emulated(tmp_path_factory):
    """A rig on emulated wires, started when a test first needs it, and ended early: its sound never rests."""
    started: list[tuple[EmulatedRig, RigConfig]] = []
    with pytest.MonkeyPatch.context() as environment:

        def start():
            if not started:
                folder = tmp_path_factory.mktemp("wires")
                rig_file = folder / "rig.toml"
                rig_file.write_text(rig_text(folder, f"localhost:{free_port()}", period_frames=PERIOD_FRAMES))
                rig = load_rig(rig_file)
                sides = EmulatedRig(virtual_settings(rig), wiring_of(rig, rig_file))
                started.append((sides, rig))
                for name, value in sides.audio.environment.items():
                    environment.setenv(name, value)
            return started[0][1]

        yield start
        for sides, _ in started:
            sides.close()


@pytest.fixture(scope="package")
def wire(emulated):
    """The bench on the emulated rig; to open an audio stream takes a second."""
    made: list[Bench] = []

    def bench():
        if not made:
            made.append(bench_of(emulated(), latency_s=0.5))
        return made[0]

    yield bench
    for one in made:
        one.instruments.close()


@pytest.fixture
def mirror_side(tmp_path):
    """A rig of which only the mirror is there, in the dialect that is asked for."""
    started: list[EmulatedSerial | NiServer] = []

    def start(dialect):
        if dialect == "analog":
            server = NiServer(Tone(), "USB-6211")
            server.start()
            started.append(server)
            return analog_rig(tmp_path, server.address)
        motion = MirrorMotion((-240.0, -240.0), 0.005, math.inf, 250.0)
        started.append(EmulatedSerial(mirror_device(dialect, motion, 260.0), serial_wire(LOCAL, tmp_path)).start())
        rig_file = tmp_path / "rig.toml"
        rig_file.write_text(rig_text(tmp_path, "localhost:1", dialect=dialect, mirror=started[0].address))
        return load_rig(rig_file)

    yield start
    for side in started:
        side.stop() if isinstance(side, NiServer) else side.close()


def pytest_generate_tests(metafunc):
    if "bench" not in metafunc.fixturenames:
        return
    hardware = metafunc.config.getoption("--hardware")
    if hardware is not None:
        metafunc.parametrize("bench", ["hardware"], indirect=True)
        return
    of_mirrors = metafunc.module.__name__.endswith("test_mirror_contract")
    kinds = [*DIALECTS, "analog"] if of_mirrors else ["wire"]
    metafunc.parametrize("bench", ["virtual", *kinds], indirect=True)


@pytest.fixture
def bench(request):
    kind = request.param
    if kind == "virtual":
        bench = bench_of(default_rig(), latency_s=0.05)
    elif kind == "wire":
        bench = request.getfixturevalue("wire")()
        yield bench
        bench.instruments.rest()
        return
    elif kind == "hardware":
        bench = bench_of(load_rig(request.config.getoption("--hardware")), latency_s=1.0)
    else:
        bench = bench_of(request.getfixturevalue("mirror_side")(kind), latency_s=1.0)
    yield bench
    bench.instruments.close()
