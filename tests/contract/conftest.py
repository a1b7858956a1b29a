"""One bench per kind of rig; every suite in this folder runs on each of them unchanged.

The virtual rig, the production drivers on emulated wires, and with ``--hardware RIG.toml`` a real rig alone.
"""

import math
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cache

import pytest

from tests.threads import threads_end
from tests.wire.daq_bench import Tone
from tests.wire.emulated import analog_rig, free_port, rig_text
from tests.wire.serial_bench import DIALECTS, LOCAL
from tests.wire.serial_bench import wire as serial_wire
from wavefocus.config.rig import default_rig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_rig import EmulatedRig
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.mirrors import mirror_device
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.virtual_bench import virtual_settings

# Short enough that what is played starts soon after it was asked for, and long enough to go on on a busy machine.
PERIOD_FRAMES = 4096


class OpenedWhenUsed:
    """The instruments of a rig, each opened when a test first names it: a mirror's test needs no audio server."""

    def __init__(self, openers):
        self._openers, self.clock = openers, openers.clock

    def __getattr__(self, role):
        self.__dict__[role] = opened = getattr(self._openers, role)()
        return opened

    def rest(self):
        """Leave nothing under way for the next test, and open anew what this one has closed."""
        for role, stop in (("player", "mute"), ("recorder", "abort"), ("mirror", "park")):
            if role in self.__dict__:
                try:
                    getattr(getattr(self, role), stop)()
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

    @staticmethod
    def check_sentence(error, role):
        """A refusal says who, what, why and what to do."""
        assert role in error.instrument
        assert all(text.strip() for text in (error.operation, error.cause, error.remedy))


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


def emulated_rig(folder, stack):
    """A rig on emulated wires, its audio interface named in the environment."""
    rig_file = folder / "rig.toml"
    rig_file.write_text(rig_text(folder, f"localhost:{free_port()}", period_frames=PERIOD_FRAMES))
    rig = load_rig(rig_file)
    sides = stack.enter_context(closing(EmulatedRig(virtual_settings(rig), rig)))
    environment = stack.enter_context(pytest.MonkeyPatch.context())
    for name, value in sides.audio.environment.items():
        environment.setenv(name, value)
    return rig


def mirror_rig(kind, folder, stack):
    """A rig of which only the mirror is there; the analog one has a shutter."""
    if kind == "analog":
        server = NiServer(Tone(), "USB-6211")
        server.start()
        stack.callback(server.stop)
        return analog_rig(folder, server.address, "opens_s = 0.0\n")
    motion = MirrorMotion((-240.0, -240.0), 0.005, math.inf, 250.0)
    side = stack.enter_context(EmulatedSerial(mirror_device(kind, motion, 260.0), serial_wire(LOCAL, folder)))
    rig_file = folder / "rig.toml"
    rig_file.write_text(rig_text(folder, "localhost:1", dialect=kind, mirror=side.address))
    return load_rig(rig_file)


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


@pytest.fixture(scope="package")
def benches(request, tmp_path_factory):
    """Makes the bench of a kind when a test first needs it; to open an audio stream takes a second."""
    with ExitStack() as stack:

        @cache
        def bench(kind):
            folder = tmp_path_factory.mktemp(kind)
            match kind:
                case "hardware":
                    made = bench_of(load_rig(request.config.getoption("--hardware")), latency_s=1.0)
                case "wire":
                    made = bench_of(emulated_rig(folder, stack), latency_s=0.5)
                case _:
                    made = bench_of(mirror_rig(kind, folder, stack), latency_s=1.0)
            stack.callback(made.instruments.close)
            return made

        yield bench


@pytest.fixture
def bench(request, benches):
    # A virtual instrument that was closed stays so.
    bench = bench_of(default_rig(), latency_s=0.05) if request.param == "virtual" else benches(request.param)
    yield bench
    bench.instruments.rest()
