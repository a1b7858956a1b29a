"""A recorder on a server with a tone at its inputs."""

from contextlib import ExitStack, contextmanager

import numpy as np

from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.protocols import RecordLabel, RecordRequest
from wavefocus.mocks.wire.ni_server import NiServer

RATE_HZ = 10_000.0
RANGE_V = (1.0, 10.0)
TAKE = RecordLabel(12, 1, 3)
SAMPLES = 500


class Tone:
    """A tone at every input that knows no time: every record is the same but for its noise."""

    def __init__(self, amplitude_v=0.5, noise_v=1e-4):
        self._amplitude_v = amplitude_v
        self._noise_v = noise_v
        self._generator = np.random.default_rng(1)
        self.asked = []

    def record(self, start_ns, samples, rate_hz, inputs, channel_delay_s):
        self.asked.append((inputs, channel_delay_s))
        at_s = np.arange(samples) / rate_hz + channel_delay_s * np.arange(len(inputs))[:, np.newaxis]
        noise = self._generator.standard_normal((len(inputs), samples))
        return self._amplitude_v * np.sin(2 * np.pi * 200 * at_s) + self._noise_v * noise


class DaqBench:
    """One server and the recorders on it."""

    def __init__(self, server, opened):
        self.server = server
        self._opened = opened

    def recorder(self, device="Dev1", **changes):
        wiring = {"reference_input": "ai0", "response_input": "ai1", "terminal": "differential", "trigger": None}
        recorder = NiRecorder(device, **({"address": self.server.address} | wiring | changes))
        self._opened.callback(recorder.close)
        return recorder

    def calls(self, name):
        return self.server.log.count(name)


@contextmanager
def daq_bench(source=None, product="USB-6211", **settings):
    server = NiServer(source or Tone(), product, **settings)
    server.start()
    with ExitStack() as opened:
        opened.callback(server.stop)
        yield DaqBench(server, opened)


def ask(samples=SAMPLES, rate_hz=RATE_HZ, range_v=RANGE_V, take=TAKE):
    return RecordRequest(samples, rate_hz, range_v, take)


def take_one(recorder, *arguments, timeout_s=10.0, **changes):
    recorder.start(ask(*arguments, **changes))
    return recorder.read(timeout_s)


def check_tone(recording, samples=SAMPLES):
    """A recording is whole and is what `Tone` puts out."""
    assert recording.volts.shape == (2, samples)
    np.testing.assert_allclose(np.std(recording.volts, axis=1), 0.5 / np.sqrt(2), rtol=0.01)
    assert recording.over_range == (False, False)
