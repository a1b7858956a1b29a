"""The NI gRPC Device Server in a process of its own: ``python -m mocks.wire.ni.ni_process --product USB-6211``."""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from mocks.virtual.surroundings import NANOSECONDS
from mocks.wire.ni.ni_products import PRODUCTS
from mocks.wire.ni.ni_server import NiServer


class ToneSource:
    """A tone at every input, the same one, on the clock of `time.monotonic_ns`; implements `SignalSource`.

    Parameters
    ----------
    frequency_hz, amplitude_v : float
        Of the tone.
    noise_v : float
        Noise of each input, volts rms, >= 0.
    seed : int
        Of the noise.
    """

    def __init__(
        self, frequency_hz: float = 200.0, amplitude_v: float = 0.5, noise_v: float = 1e-4, seed: int = 1
    ) -> None:
        self._turns_per_s = 2 * np.pi * frequency_hz
        self._amplitude_v = amplitude_v
        self._noise_v = noise_v
        self._generator = np.random.default_rng(seed)
        self._lock = threading.Lock()

    def record(
        self, start_ns: int, samples: int, rate_hz: float, inputs: tuple[str, ...], channel_delay_s: float
    ) -> NDArray[np.float64]:
        """The tone and fresh noise; does not wait."""
        late_s = channel_delay_s * np.arange(len(inputs))[:, np.newaxis]
        time_s = start_ns / NANOSECONDS + np.arange(samples) / rate_hz + late_s
        with self._lock:
            noise = self._generator.standard_normal((len(inputs), samples))
        return np.asarray(self._amplitude_v * np.sin(self._turns_per_s * time_s) + self._noise_v * noise)


def serve(server: NiServer, announce: Callable[[str], object], until: Callable[[], object]) -> None:
    """Run a server until something returns.

    Parameters
    ----------
    server : NiServer
        Not yet started.
    announce : callable
        Called with the address once it listens.
    until : callable
        Returns when the server is to stop.
    """
    announce(server.start())
    try:
        until()
    finally:
        server.stop()


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve a tone until standard input ends; the first line of output is the address."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--product", default="USB-6211", choices=sorted(PRODUCTS))
    parser.add_argument("--device", default="Dev1")
    parser.add_argument("--address", default="localhost:0")
    parser.add_argument("--tone-hz", type=float, default=200.0)
    parser.add_argument("--tone-v", type=float, default=0.5)
    asked = parser.parse_args(arguments)
    source = ToneSource(asked.tone_hz, asked.tone_v, seed=time.monotonic_ns())

    def announce(address: str) -> None:
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()

    serve(NiServer(source, asked.product, asked.device, asked.address), announce, sys.stdin.read)


if __name__ == "__main__":
    main()
