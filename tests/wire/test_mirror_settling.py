"""How long a mirror takes to settle, from its position signals at two other inputs of the box."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tests.wire.analog_bench import analog_rig
from wavefocus.acquisition.mirror_settling import farthest_apart, measure_settling, settling_s
from wavefocus.acquisition.setup import wired
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Instruments
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.timeouts import bounded
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers

TRUE_S = 0.004


def swing(after_s: np.ndarray) -> np.ndarray:
    """From 1 before a step to 0 after it: a damped swing that is within 1 % from `TRUE_S` on."""
    decay = np.log(100) / TRUE_S
    return np.where(after_s < 0, 1.0, np.exp(-decay * np.maximum(after_s, 0)))


@pytest.mark.parametrize("noise_v", [0.0, 1e-3])
def test_given_a_step_that_swings_then_its_time_is_found(noise_v: float) -> None:
    rate_hz = 20_000.0
    at_s = np.arange(10_000) / rate_hz - 0.2
    generator = np.random.default_rng(1)
    position_v = np.stack([2.0 - 2.5 * swing(at_s), 0.1 * swing(at_s)]) + noise_v * generator.standard_normal(
        (2, 10_000)
    )
    assert settling_s(position_v, rate_hz) == pytest.approx(TRUE_S, rel=0.1)
    assert settling_s(0.0 * position_v, rate_hz) is None
    ends = farthest_apart(np.array([[0.0, 1.0], [5.0, 5.0], [-4.0, -4.0], [1.0, 0.0]]))
    assert ends == ((5.0, 5.0), (-4.0, -4.0))


class Positions:
    """Position signals of a mirror that swings into each voltage that the outputs are put at."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, np.ndarray]] = [(0, np.zeros(2))]

    def changed(self, levels) -> None:
        self.steps.append((time.monotonic_ns(), np.array([levels.get("ao0", 0.0), levels.get("ao1", 0.0)])))

    def record(self, start_ns, samples, rate_hz, inputs, channel_delay_s):
        time.sleep(samples / rate_hz)
        at_s = np.arange(samples) / rate_hz
        volts = np.zeros((2, samples))
        before = np.zeros(2)
        for instant_ns, level in self.steps:
            after_s = at_s - (instant_ns - start_ns) * 1e-9
            volts = np.where(after_s < 0, volts, (level + (before - level) * swing(after_s)[:, None]).T)
            before = level
        return volts if inputs[0] == "ai4" else np.zeros((2, samples))


def test_given_position_signals_then_the_settling_time_is_measured_through_the_real_package(tmp_path: Path) -> None:
    positions = Positions()
    server = NiServer(positions, "USB-6211")
    server.watch_outputs(positions.changed)
    server.start()
    with ExitStack() as opened:
        opened.callback(server.stop)
        rig = analog_rig(tmp_path, server.address)
        ways = openers(rig)
        mirror, recorder = ways.mirror(), ways.recorder()
        opened.callback(mirror.close)
        opened.callback(recorder.close)
        instruments = bounded(Instruments(mirror, recorder, VirtualRig().instruments.player, ways.clock), 20.0)
        setup = wired(rig, instruments, VibrometerReading(1.0, "", None, None, "typed in"))
        ends = ((-20.0, 0.0), (20.0, 5.0))
        found_s = measure_settling(setup, ("ai4", "ai5"), ends)
        assert 0.8 * TRUE_S < found_s < 3 * TRUE_S  # a far move is a ramp of some milliseconds
        with pytest.raises(InstrumentError, match="no move"):
            measure_settling(setup, ("ai6", "ai7"), ends)
