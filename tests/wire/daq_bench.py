"""A recorder on a server, and a player whose sound is on its inputs in real time."""

import threading
import time
from contextlib import ExitStack, contextmanager

import numpy as np

from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.protocols import RecordLabel, RecordRequest
from wavefocus.mocks.wire.ni_server import NiServer

RATE_HZ = 10_000.0
RANGE_V = (1.0, 10.0)
TAKE = RecordLabel(12, 1, 3)
SAMPLES = 500


class Wires:
    """A cable from the player's channel 0 to ai0 and from 1 to ai1; implements `SignalSource`."""

    latency_s = 0.004

    def __init__(self, noise_v=1e-4):
        self.asked = []
        self._plays = []
        self._noise_v = noise_v
        self._generator = np.random.default_rng(1)
        self._lock = threading.Lock()

    def play(self, signals_v, sample_rate_hz):
        start_ns = time.monotonic_ns() + round(self.latency_s * 1e9)
        with self._lock:
            self._plays += [(start_ns, f"ai{channel}", signal, sample_rate_hz) for channel, signal in signals_v.items()]

    def wait(self, timeout_s):
        with self._lock:
            ends = [start_ns + round(len(signal) / rate * 1e9) for start_ns, _, signal, rate in self._plays]
        time.sleep(min(timeout_s, max(0, max(ends) - time.monotonic_ns()) * 1e-9))

    def record(self, start_ns, samples, rate_hz, inputs, channel_delay_s):
        with self._lock:
            self.asked.append((start_ns, samples, rate_hz, inputs, channel_delay_s))
            volts = self._noise_v * self._generator.standard_normal((len(inputs), samples))
            for row, name in enumerate(inputs):
                at_s = np.arange(samples) / rate_hz + row * channel_delay_s
                for played_ns, channel, signal, sample_rate_hz in self._plays:
                    if channel == name:
                        place = (at_s + (start_ns - played_ns) * 1e-9) * sample_rate_hz
                        volts[row] += np.interp(place, np.arange(len(signal)), signal, left=0.0, right=0.0)
        return volts

    def close(self):
        pass


class Tone:
    """A tone at every input that knows no time: every record is the same but for its noise."""

    def __init__(self, amplitude_v=0.5, noise_v=1e-4):
        self._amplitude_v = amplitude_v
        self._noise_v = noise_v
        self._generator = np.random.default_rng(1)

    def record(self, start_ns, samples, rate_hz, inputs, channel_delay_s):
        at_s = np.arange(samples) / rate_hz + channel_delay_s * np.arange(len(inputs))[:, np.newaxis]
        noise = self._generator.standard_normal((len(inputs), samples))
        return self._amplitude_v * np.sin(2 * np.pi * 200 * at_s) + self._noise_v * noise


class DaqBench:
    """One server and the recorders on it."""

    def __init__(self, server, opened):
        self.server = server
        self._opened = opened

    def recorder(self, device="Dev1", **changes):
        wiring = {
            "address": self.server.address,
            "reference_input": "ai0",
            "response_input": "ai1",
            "terminal": "differential",
            "trigger": None,
            **changes,
        }
        recorder = NiRecorder(device, **wiring)
        self._opened.callback(recorder.close)
        return recorder

    def calls(self, name):
        return self.server.log.count(name)

    def until_under_way(self, name):
        """Wait until a call is being answered."""
        until_s = time.monotonic() + 30
        while name not in self.server.under_way:
            assert time.monotonic() < until_s, f"{name} never came"
            time.sleep(0.001)


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
